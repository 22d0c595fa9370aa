"""How much may be imagined, by what is measured.  N rows, K runs."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from coim.governor import EARNED, LEAST_SHARE, UNEARNED, Governor
from coim.models import GaussianEnsemble


def governor(num_runs: int | None = None) -> Governor:
    torch.manual_seed(0)
    return Governor(GaussianEnsemble(3, 2, 2, num_cells=(16,), num_runs=num_runs))


def shares_after(first: float, latest: float | None = None, *, most: float = 0.2) -> float:
    governed = governor()
    governed.observe(torch.tensor([first]), first=True)
    if latest is not None:
        governed.observe(torch.tensor([latest]), first=False)
    return governed.shares(most).item()


def test_nothing_is_imagined_before_anything_was_measured() -> None:
    assert governor(3).shares(0.2).tolist() == [0.0, 0.0, 0.0]
    assert not governor(3).earns()


def test_one_member_disagrees_with_nobody_and_is_refused() -> None:
    with pytest.raises(ValueError, match="the ensemble has one member, and a governor asks how far members disagree"):
        Governor(GaussianEnsemble(3, 2, 2, num_cells=(16,), num_members=1))


def test_the_share_grows_from_a_twentieth_to_the_whole_as_the_error_falls() -> None:
    assert shares_after(1.0) == 0.0  # a model that knows nothing
    assert shares_after(UNEARNED) == 0.0
    assert shares_after(UNEARNED - 1e-6) == pytest.approx(LEAST_SHARE, abs=1e-5)
    assert shares_after(0.4) == pytest.approx(0.125)  # half way from 0.7 to 0.1: half way from 5 % to 20 %
    assert shares_after(EARNED) == pytest.approx(0.2)
    assert shares_after(0.01) == pytest.approx(0.2)
    assert shares_after(0.4, most=0.03) == pytest.approx(0.03)


def test_the_worse_of_the_first_and_the_latest_episode_counts() -> None:
    assert shares_after(0.1, 0.4) == pytest.approx(0.125)
    assert shares_after(0.4, 0.1) == pytest.approx(0.125)  # the body has been learnt from meanwhile
    assert shares_after(0.1, 5.0) == 0.0


@pytest.mark.parametrize("broken", [torch.nan, torch.inf])
def test_an_error_that_is_no_number_earns_nothing(broken: float) -> None:
    assert shares_after(broken) == 0.0
    assert shares_after(0.1, broken) == 0.0


def test_each_run_earns_its_own() -> None:
    governed = governor(3)
    governed.observe(torch.tensor([0.1, 0.9, 0.4]), first=True)
    assert governed.shares(0.2).tolist() == pytest.approx([0.2, 0.0, 0.125])
    assert governed.earns()


def rows_near(centre: float, *batch: int, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def normal(size: int) -> torch.Tensor:
        return centre + torch.randn(*batch, size, generator=generator)

    return TensorDict({"observation": normal(3), "action": normal(2), "design": normal(2)}, batch)


def test_rows_on_which_the_members_disagree_more_than_on_real_ones_are_replaced() -> None:
    governed, real = governor(), rows_near(0.0, 400)
    limit = governed.ensemble.disagreement(*(real[key] for key in ("observation", "action", "design"))).quantile(0.95)
    mixed = torch.cat([rows_near(0.0, 60, seed=1), rows_near(20.0, 40, seed=2)])
    kept = governed.agreeing(mixed, real)
    found = governed.ensemble.disagreement(kept["observation"], kept["action"], kept["design"])
    assert len(kept) == 100
    assert (found <= limit).all()
    own = (kept["observation"] == mixed["observation"]).all(-1)
    agreed = governed.ensemble.disagreement(mixed["observation"], mixed["action"], mixed["design"]) <= limit
    assert torch.equal(own, agreed)
    assert own[:60].float().mean() > 0.8
    assert not own[60:].any()


def test_a_model_that_is_asked_about_what_it_does_not_know_imagines_nothing() -> None:
    governed = governor(2)
    governed.observe(torch.tensor([0.1, 0.1]), first=True)
    real, imagined = rows_near(0.0, 400, 2), rows_near(0.0, 100, 2, seed=1)
    imagined[:, 1] = rows_near(30.0, 100, seed=2)
    kept = governed.agreeing(imagined, real)
    assert (kept[:, 1] == imagined[:, 1]).all()
    assert governed.shares(0.2).tolist() == pytest.approx([0.2, 0.0])


def test_what_was_measured_is_a_state() -> None:
    one, other = governor(2), governor(2)
    one.observe(torch.tensor([0.1, 0.3]), first=True)
    one.observe(torch.tensor([0.2, 0.2]), first=False)
    state = one.state_dict()
    other.load_state_dict(state)
    assert torch.equal(other.shares(0.2), one.shares(0.2))
    state["latest"].fill_(9.0)
    assert other.earns()


def test_a_state_of_another_number_of_runs_is_refused_and_changes_nothing() -> None:
    one, three = governor(1), governor(3)
    one.observe(torch.tensor([0.4]), first=True)
    with pytest.raises(ValueError, match=r"measured of 3 run\(s\), the ensemble has 1"):
        one.load_state_dict(three.state_dict())
    assert one.shares(0.2).tolist() == pytest.approx([0.125])


def test_what_is_told_is_kept_and_the_teller_may_write_over_it() -> None:
    governed, error = governor(2), torch.tensor([0.1, 0.1])
    governed.observe(error, first=True)
    error.fill_(9.0)
    assert governed.shares(0.2).tolist() == pytest.approx([0.2, 0.2])
    with pytest.raises(ValueError, match=r"the errors have shape \[3\], the ensemble 2 runs"):
        governed.observe(torch.zeros(3), first=True)
