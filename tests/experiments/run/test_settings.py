"""Values that no run can have are refused by the name of their setting."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from pydantic import TypeAdapter

from coim import HopperMorph
from coim.experiments.run.build import make_buffers
from coim.experiments.run.command_line import parse
from coim.experiments.run.effect import RULES
from coim.experiments.run.settings import FIELDS, PRESETS, Settings
from coim.experiments.study.definition import PROTOCOLS

WRONG: list[tuple[str, Any, str]] = [
    ("search", "foo", "search is 'foo', it must be 'swarm' or 'gradient'"),
    ("predict", "Delta", "predict is 'Delta', it must be 'delta' or 'next'"),
    ("mix", "sums", "mix is 'sums', it must be 'batch' or 'sum'"),
    ("wandb", "onlin", "wandb is 'onlin', it must be 'off', 'offline' or 'online'"),
    ("episodes", "20", "episodes is '20', it must be a whole number"),
    ("episodes", 2.5, "episodes is 2.5, it must be a whole number"),
    ("episodes", None, "episodes is None, it must be a whole number"),
    ("individual_updates", True, "individual_updates is True, it must be a whole number"),
    ("individual_updates", -1, "individual_updates is -1, it must be at least 0"),
    ("compile", "yes", "compile is 'yes', it must be true or false"),
    ("compile", 1, "compile is 1, it must be true or false"),
    ("device", 0, "device is 0, it must be a string"),
    ("num_cells", 4, "num_cells is 4, it must be a list"),
    ("num_cells", (8, 0), "num_cells has 0, each must be at least 1"),
    ("num_cells", (8, 0.5), "num_cells has 0.5, each must be a whole number"),
    ("num_cells", (), "num_cells is empty; name at least one entry"),
    ("model_cells", (), "model_cells is empty"),
    ("lr", "fast", "lr is 'fast', it must be a finite number"),
    ("lr", True, "lr is True, it must be a finite number"),
    ("lr", float("inf"), "lr is inf, it must be a finite number"),
    ("lr", 10**400, "it must be a finite number"),
    ("lr", 0, "lr is 0, it must be above 0"),
    ("model_lr", -1, "model_lr is -1, it must be above 0"),
    ("gamma", 1.01, "gamma is 1.01, it must be at most 1"),
    ("tau", 0, "tau is 0, it must be above 0"),
    ("imagined_share", -0.1, "imagined_share is -0.1, it must be at least 0"),
    ("individual_mix", 0.999, "a batch of 256 rows is smaller than its parts"),
    ("checkpoint_every", 0, "checkpoint_every is 0, it must be at least 1"),
    ("num_designs", 0, "num_designs is 0, it must be at least 1"),
    ("first_design", (1, -1), "first_design has -1, each must be above 0"),
    ("name", "a/b", "name is 'a/b', the end of a folder's name; leave out the /, or give --out"),
    ("sigma", -1, "sigma is -1, it must be at least 0"),
    ("dream", "simulator", "dream simulator imagines nothing with imagine none; take known, noisy or random"),
]


@pytest.mark.parametrize(("name", "value", "sentence"), WRONG)
def test_a_value_that_no_run_can_have_is_named_with_what_it_must_be(name: str, value: object, sentence: str) -> None:
    fields: dict[str, Any] = {"imagine": "none", name: value}
    for make in (lambda: Settings(**fields), lambda: dataclasses.replace(Settings(imagine="none"), **{name: value})):
        with pytest.raises(ValueError) as refused:  # noqa: PT011
            make()
        assert sentence in str(refused.value)
        assert "\n" not in str(refused.value)


def test_a_name_that_is_no_setting_is_refused() -> None:
    with pytest.raises(ValueError, match="there is no epsiodes; similar names are episodes"):
        Settings(epsiodes=3)  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="there is no designs; it is called imagine now"):
        Settings(designs="none")  # type: ignore[call-arg]


@pytest.mark.parametrize("settings", [*PRESETS.values(), *PROTOCOLS.values()])
def test_presets_and_protocols_are_allowed_once_more(settings: Settings) -> None:
    assert Settings(**vars(settings)) == settings


def test_the_ends_of_what_is_allowed_are_allowed() -> None:
    settings = Settings(gamma=1, tau=1, alpha=0, sigma=0, weight_decay=0, imagined_share=0, individual_mix=1)
    least = dataclasses.replace(settings, individual_updates=0, population_updates=0, model_updates=0, num_cells=[1])
    assert (least.gamma, least.num_cells) == (1.0, (1,))


def test_no_number_is_without_a_limit() -> None:
    kinds = {name: kind.get("items", kind) for name, kind in TypeAdapter(Settings).json_schema()["properties"].items()}
    numbers = {name: kind for name, kind in kinds.items() if kind.get("type") in ("integer", "number")}
    assert {"seed", "sigma", "num_cells", "first_design"} <= numbers.keys()
    assert all({"minimum", "exclusiveMinimum"} & kind.keys() for kind in numbers.values())


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--num-cells", "8", "0"], "error: --num-cells has 0, each must be at least 1\n"),
        (["--individual-imagined-share", "2"], "error: --individual-imagined-share is 2.0, it must be at most 1\n"),
        (
            ["--dream", "simulator", "--imagine", "none"],
            "error: --dream simulator imagines nothing with --imagine none; take known, noisy or random\n",
        ),
        (
            ["--governed", "--mix", "sum"],
            "error: --governed sets the share of imagined rows, and with --mix sum they count as much as all real "
            "ones, whatever their share; take batch, or leave governed out\n",
        ),
        (
            ["--governed", "--num-members", "1"],
            "error: --governed asks how far the members of the model disagree, and --num-members is 1; take 2 or "
            "more\n",
        ),
        (
            ["--dream", "simulator", "--governed"],
            "error: --governed has no errors to go by with --dream simulator, which makes none; leave one of them "
            "out\n",
        ),
        (
            ["--imagine", "none", "--anchored"],
            "error: --anchored has no effect with --imagine none; leave it out\n",
        ),
        (
            ["--search", "gradient", "--num-particles", "700"],
            "error: --num-particles has no effect with --search gradient; leave it out\n",
        ),
        (
            ["--swarm_bounds=nearest", "--bodies", "random"],
            "error: --swarm-bounds has no effect with --bodies random; leave it out\n",
        ),
        (
            ["--bodies", "fixed", "--search", "swarm"],
            "error: --search has no effect with --bodies fixed; leave it out\n",
        ),
        (["--sigma", "0.2"], "error: --sigma has no effect with --imagine known; leave it out\n"),
        (
            ["--imagine", "none", "--model-cells", "8"],
            "error: --model-cells has no effect with --imagine none; leave it out\n",
        ),
        (
            ["--dream", "simulator", "--predict", "next"],
            "error: --predict has no effect with --dream simulator; leave it out\n",
        ),
        (
            ["--imagined-share", "0", "--mix", "sum"],
            "error: --mix has no effect with --imagined-share 0.0; leave it out\n",
        ),
        (["--out", "a", "--name", "b"], "error: --name has no effect with --out a; leave it out\n"),
    ],
)
def test_the_command_line_calls_a_setting_by_its_option(
    capsys: pytest.CaptureFixture, options: list[str], sentence: str
) -> None:
    with pytest.raises(SystemExit) as stop:
        parse("prog", "", options)
    assert stop.value.code == 2
    assert capsys.readouterr().err.endswith(sentence)


def test_what_has_an_effect_is_taken_and_so_is_a_default_that_has_none() -> None:
    assert parse("prog", "", ["--search", "gradient"]).num_particles == 700
    assert parse("prog", "", ["--imagine", "noisy", "--sigma", "0.2"]).sigma == 0.2
    assert parse("prog", "", ["--imagine", "none", "--individual-mix", "0.1"]).individual_mix == 0.1
    assert parse("prog", "", ["--sigma", "0.2"], read=("sigma",)).sigma == 0.2  # a program's own use


def test_the_old_name_of_an_option_is_taken_with_a_warning(capsys: pytest.CaptureFixture) -> None:
    assert parse("prog", "", ["--designs", "noisy", "--sigma", "0.2"]).imagine == "noisy"
    assert parse("prog", "", ["--designs=none"]).imagine == "none"
    warned = "warning: --designs is called --imagine now; the next release knows --imagine alone\n"
    assert capsys.readouterr().err == 2 * warned


def test_rules_are_about_settings() -> None:
    assert {name for names, _, by in RULES for name in (*names, by)} <= FIELDS


def test_the_replay_may_stay_on_the_cpu_whatever_the_device() -> None:
    """A device without memory stands for a GPU."""
    settings = Settings(device="meta", replay_device="cpu", num_designs=1, first_episodes=1, episode_steps=5)
    buffers = make_buffers(HopperMorph(episode_steps=5, seed=0), settings, seed=0)
    assert buffers.pop.storage.device.type == "cpu"
