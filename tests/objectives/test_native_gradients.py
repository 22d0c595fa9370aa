"""Native gradients: what the written-out ones compute, whatever the sizes and the number of threads."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor

from coim.native import find_compiler, team
from coim.objectives import native_gradients
from coim.objectives.dynamics_gradients import dynamics_gradients
from coim.objectives.gradients import Batch, Network, SACGradients, sac_gradients
from coim.objectives.native_gradients import (
    SOURCE,
    UP_TO,
    UP_TO_IN_ENSEMBLES,
    NativeDynamics,
    NativeSAC,
    pays,
)
from coim.objectives.native_structures import AdamStep, Dynamics, Layer, Sac
from coim.products import kind_of_processor

CLAMPED = (-0.5, 0.5)  # of the log-scale: some are inside, some outside
# Sizes of batch, observation, design, action, hidden layers; number of critics.
SIZES = [
    (256, 17, 7, 6, (64, 64, 64), 2),
    (150, 11, 4, 3, (200, 200), 2),
    (33, 5, 1, 9, (16, 37), 3),
    (7, 3, 2, 1, (5,), 1),
    (1, 1, 1, 1, (), 2),
]
# Sizes of batch, inputs and outputs, hidden layers of a member; one with sums of more products than are taken at once.
MEMBERS = [(256, 30, 34, (64, 64)), (300, 300, 6, (261,)), (100, 9, 10, (129,)), (3, 2, 2, ())]
BOUNDS = (-10.0, 0.5)  # of its log-variance
EXACT = {torch.float64: 1e-11, torch.float32: 2e-4}


def network(rng: torch.Generator, *sizes: int, dtype: torch.dtype) -> Network:
    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64).to(dtype)

    layers = list(pairwise(sizes))
    return Network([random(*layer) / layer[0] ** 0.5 for layer in layers], [random(o) / 10 for _, o in layers])


def unwritten(*networks: Network) -> list[Tensor]:
    """Room for gradients, in which a number that nobody writes is found."""
    parts = (chain(*zip(one.weights, one.biases)) for one in networks)
    return [torch.full_like(part, torch.nan) for part in chain(*parts)]


class Case:
    """Networks and rows of some sizes."""

    def __init__(self, sizes: tuple, dtype: torch.dtype = torch.float64) -> None:
        size, observed, designed, acted, cells, critics = sizes
        rng = torch.Generator().manual_seed(0)
        seen = observed + acted + designed
        self.policy = network(rng, observed + designed, *cells, 2 * acted, dtype=dtype)
        self.critics = [network(rng, seen, *cells, 1, dtype=dtype) for _ in range(critics)]
        self.targets = [network(rng, seen, *cells, 1, dtype=dtype) for _ in range(critics)]
        rows = [(observed,), (designed,), (acted,), (observed,), (), (acted,), (acted,), ()]
        numbers = [torch.randn(size, *shape, generator=rng, dtype=torch.float64).to(dtype) for shape in rows]
        terminated = torch.rand(size, generator=rng) < 0.3
        self.batch = Batch(*numbers[:5], terminated, *numbers[5:])

    def expected(self) -> SACGradients:
        networks = self.policy, self.critics, self.targets
        return sac_gradients(*networks, self.batch, alpha=0.2, gamma=0.9, log_scale_range=CLAMPED)

    def found(self, *, threads: int = 1) -> tuple[list[Tensor], Tensor]:
        gradients = unwritten(self.policy, *self.critics)
        networks = self.policy, self.critics, self.targets
        native = NativeSAC(*networks, gradients, self.batch, log_scale_range=CLAMPED, threads=threads)
        return gradients, native(self.batch, alpha=0.2, gamma=0.9)


@pytest.mark.parametrize("dtype", EXACT)
@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_gradients_and_losses_of_sac_equal_the_written_out_ones(sizes: tuple, dtype: torch.dtype) -> None:
    case = Case(sizes, dtype)
    expected = case.expected()
    gradients, losses = case.found()
    right = [*expected.policy, *chain(*expected.critics)]
    for own, other in zip(gradients, right, strict=True):
        torch.testing.assert_close(own, other, rtol=EXACT[dtype], atol=EXACT[dtype])
    right = torch.stack([expected.loss_actor, expected.loss_qvalue, expected.entropy])
    torch.testing.assert_close(losses, right, rtol=EXACT[dtype], atol=EXACT[dtype])


class Member:
    """A member of an ensemble and rows of some sizes."""

    def __init__(self, sizes: tuple, dtype: torch.dtype = torch.float64) -> None:
        size, features, outputs, cells = sizes
        rng = torch.Generator().manual_seed(0)
        self.network = network(rng, features, *cells, outputs, dtype=dtype)
        self.x, self.target = (torch.randn(size, n, generator=rng, dtype=dtype) for n in (features, outputs // 2))

    def expected(self) -> list[Tensor]:
        """Gradients, and the loss."""
        found = dynamics_gradients(self.network, self.x, self.target, log_var_range=BOUNDS)
        return [*found.parameters, found.loss.reshape(1)]

    def found(self, *, threads: int = 1) -> list[Tensor]:
        gradients, rows = unwritten(self.network), (self.x, self.target)
        native = NativeDynamics(self.network, gradients, *rows, log_var_range=BOUNDS, threads=threads)
        return [*gradients, native(*rows)]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("dtype", EXACT)
@pytest.mark.parametrize("sizes", MEMBERS, ids=str)
def test_gradients_and_loss_of_a_member_equal_the_written_out_ones(
    sizes: tuple, dtype: torch.dtype, threads: int
) -> None:
    member = Member(sizes, dtype)
    for own, other in zip(member.found(threads=threads), member.expected(), strict=True):
        torch.testing.assert_close(own, other, rtol=EXACT[dtype], atol=EXACT[dtype])


@pytest.mark.parametrize("number", [-1e30, -800.0, -90.0, -20.0, 20.0, 90.0, 800.0, 1e30, -torch.inf, torch.inf])
@pytest.mark.parametrize("dtype", EXACT)
@pytest.mark.parametrize("of", ["a sum before SiLU", "a log-variance", "an error"])
def test_numbers_far_outside_give_what_they_give_written_out(of: str, number: float, dtype: torch.dtype) -> None:
    """Where an exponential is zero or infinite, and what follows from it."""
    member = Member(MEMBERS[2], dtype)
    if of == "an error":
        member.target[0, 0] = number
    else:
        member.network.biases[0 if of == "a sum before SiLU" else 1][-1] = number
    for own, other in zip(member.found(), member.expected(), strict=True):
        # The roundings of a sum go by its summands.
        largest = float(other.nan_to_num(0, 0, 0).abs().amax().clamp(min=1))
        torch.testing.assert_close(own, other, rtol=2e-4, atol=2e-4 * largest, equal_nan=True)


@pytest.mark.parametrize("bound", CLAMPED)
def test_a_log_scale_at_its_bound_is_still_within(bound: float) -> None:
    case = Case(SIZES[2])
    acted = case.batch.action.shape[-1]
    case.policy.weights[-1][:, acted] = 0.0
    case.policy.biases[-1][acted] = bound
    gradients, expected = case.found()[0], case.expected().policy
    assert float(expected[-1][acted].abs()) > 0
    for own, other in zip(gradients, expected):
        torch.testing.assert_close(own, other, rtol=1e-11, atol=1e-11)


def test_critics_that_say_the_same_share_the_gradient_of_the_policy() -> None:
    case = Case(SIZES[2])
    case.critics = [case.critics[0]] * 3
    for own, other in zip(case.found()[0], case.expected().policy):
        torch.testing.assert_close(own, other, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("threads", [2, 3, 8])
def test_any_number_of_threads_computes_the_same_bits(threads: int) -> None:
    case = Case(SIZES[0], torch.float32)
    one, several = case.found(), case.found(threads=threads)
    for own, other in zip([*one[0], one[1]], [*several[0], several[1]]):
        assert torch.equal(own, other)
    member = Member(MEMBERS[1], torch.float32)
    right = member.found()
    for _ in range(20):  # what one thread writes over another's is seen now and then
        assert all(map(torch.equal, member.found(threads=threads), right))


def test_torch_lends_its_threads() -> None:
    if not torch.backends.openmp.is_available():
        pytest.skip("this torch has no OpenMP")
    assert team() is not None


@pytest.mark.parametrize("where", ["observation", "reward", "weight of a critic"])
def test_a_number_that_is_not_finite_is_not_lost(where: str) -> None:
    """A run that diverges is found by its losses, whichever function lies between."""
    case = Case(SIZES[0], torch.float32)
    broken = case.critics[1].weights[1] if where == "weight of a critic" else getattr(case.batch, where)
    broken[0] = torch.nan
    gradients, losses = case.found()
    expected = case.expected()
    right = torch.stack([expected.loss_actor, expected.loss_qvalue, expected.entropy])
    assert losses.isnan().tolist() == right.isnan().tolist()
    for own, other in zip(gradients, [*expected.policy, *chain(*expected.critics)]):
        assert torch.equal(own.isnan(), other.isnan())


@pytest.mark.parametrize("where", ["x", "target", "weight"])
def test_nor_is_one_in_a_member(where: str) -> None:
    member = Member(MEMBERS[0], torch.float32)
    broken = member.network.weights[1] if where == "weight" else getattr(member, where)
    broken[0] = torch.nan
    found, expected = member.found(), member.expected()
    assert any(part.isnan().any() for part in expected)
    assert all(torch.equal(own.isnan(), other.isnan()) for own, other in zip(found, expected, strict=True))


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("reward", lambda rows: rows[:, None], r"reward is \(7, 1\) of torch.float64, and \(7,\) of torch.float64"),
        ("noise", lambda rows: rows.float(), r"noise is \(7, 1\) of torch.float32, and \(7, 1\) of torch.float64 is"),
        ("terminated", lambda rows: rows.double(), r"terminated is \(7,\) of torch.float64, and \(7,\) of torch.bool"),
        ("next_observation", lambda rows: rows.mT.contiguous().mT, "next_observation must be contiguous"),
    ],
)
def test_rows_of_other_shapes_or_types_are_refused(name: str, change: object, sentence: str) -> None:
    case = Case(SIZES[3])
    case.batch = case.batch._replace(**{name: change(getattr(case.batch, name))})  # type: ignore[operator]
    with pytest.raises(ValueError, match=sentence):
        case.found()


def test_networks_and_gradients_that_do_not_fit_are_refused() -> None:
    case = Case(SIZES[3])
    with pytest.raises(ValueError, match=r"2 gradients for 8 weights and biases"):
        NativeSAC(case.policy, case.critics, case.targets, case.batch[:2], case.batch, log_scale_range=CLAMPED)
    case.policy = case.policy._replace(weights=case.policy.weights[:1])
    with pytest.raises(ValueError, match="the policy returns 5 numbers, and 2 are wanted"):
        case.found()
    case = Case(SIZES[0])
    case.targets = case.targets[:1]
    with pytest.raises(ValueError, match="1 targets for 2 critics"):
        case.found()
    case = Case(SIZES[0])
    case.critics[1] = Case((1, 17, 7, 6, (64, 64), 1)).critics[0]
    with pytest.raises(ValueError, match=r"a critic has layers .*, the first one .*; give them the same"):
        case.found()
    with pytest.raises(ValueError, match="a batch has no rows"):
        Case((0, *SIZES[0][1:])).found()
    with pytest.raises(ValueError, match="threads is 0, it must be at least 1"):
        Case(SIZES[3]).found(threads=0)
    with pytest.raises(ValueError, match=r"the policy has layers of \[6, 0, 8\] numbers, and each must have at least"):
        Case((33, 5, 1, 4, (0,), 1)).found()
    case = Case(SIZES[3])
    case.policy = case.policy._replace(biases=case.policy.biases[:1])
    with pytest.raises(ValueError, match="1 biases for 2 weights of the policy; give one for each"):
        case.found()
    case = Case(SIZES[3], torch.bfloat16)
    with pytest.raises(TypeError, match=r"native gradients are of float32 or float64, not of torch.bfloat16; set"):
        case.found()


def test_wide_layers_are_left_to_the_libraries() -> None:
    assert pays([torch.zeros(1000, 256), torch.zeros(256)])
    assert not pays([torch.zeros(10, 257), torch.zeros(257)])
    most = UP_TO_IN_ENSEMBLES.get(kind_of_processor(), UP_TO)
    assert pays([torch.zeros(10, most), torch.zeros(most)], of_ensemble=True)
    assert not pays([torch.zeros(10, most + 1), torch.zeros(most + 1)], of_ensemble=True)
    assert not pays([torch.zeros(10, 16, dtype=torch.bfloat16), torch.zeros(16, dtype=torch.bfloat16)])


def test_the_code_for_other_processors_computes_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiler splits vectors that are wider than the processor's, so that the code for AVX-512 runs anywhere."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    path, *headers = (Path(shutil.copy(one, tmp_path)) for one in (SOURCE.path, *SOURCE.headers))
    networks = headers[0].read_text()
    headers[0].write_text(networks.replace("#if defined(__AVX512F__)", "#if !defined(__AVX512F__)"))
    assert headers[0].read_text() != networks
    library = replace(SOURCE, path=path, headers=tuple(headers)).library()
    monkeypatch.setattr(native_gradients, "library", lambda: library)
    for sizes in SIZES:
        test_gradients_and_losses_of_sac_equal_the_written_out_ones(sizes, torch.float32)
    for sizes in MEMBERS:
        for dtype in EXACT:
            test_gradients_and_loss_of_a_member_equal_the_written_out_ones(sizes, dtype, threads=2)


def test_the_structures_are_those_of_the_source(tmp_path: Path) -> None:
    """Names and sizes of all fields, in their order, as the compiler sees them."""
    checks = []
    for structure in (Layer, Sac, Dynamics, AdamStep):
        name = structure.__name__.removesuffix("Step")
        checks.append(f"static_assert(sizeof({name}) == {ctypes.sizeof(structure)});")
        for field, _ in structure._fields_:
            checks.append(f"static_assert(offsetof({name}, {field}) == {getattr(structure, field).offset});")
    assert len(checks) == 4 + 6 + 27 + 11 + 15
    file = tmp_path / "check.cpp"
    file.write_text(f'#include <cstddef>\n#include "{SOURCE.path}"\n' + "\n".join(checks))
    command, _ = SOURCE.command(find_compiler("install one"))
    SOURCE.run([*command, "-fsyntax-only", str(file), "-o", os.devnull])


def test_nothing_is_written_beside_the_gradients() -> None:
    """There are numbers after each gradient that nobody may touch."""
    case = Case(SIZES[2], torch.float32)
    room = {}

    def guarded(x: Tensor) -> Tensor:
        wide = torch.full((x.numel() + 64,), torch.nan, dtype=x.dtype)
        room[id(x)] = wide
        own = wide[: x.numel()].view(x.shape)
        return own.copy_(x)

    gradients = [guarded(part) for part in unwritten(case.policy, *case.critics)]
    guards = list(room.values())
    networks = case.policy, case.critics, case.targets
    NativeSAC(*networks, gradients, case.batch, log_scale_range=CLAMPED)(case.batch, alpha=0.2, gamma=0.9)
    assert all(wide[-64:].isnan().all() and not wide[:-64].isnan().any() for wide in guards)
    for own, right in zip(gradients, case.found()[0]):
        assert torch.equal(own, right)


def test_every_header_that_is_included_is_named() -> None:
    included = [
        SOURCE.path.with_name(name)
        for path in (SOURCE.path, *SOURCE.headers)
        for name in re.findall(r'#include "([^"]+)"', path.read_text())
    ]
    assert included == [*SOURCE.headers]
