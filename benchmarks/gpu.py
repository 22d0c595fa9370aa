"""``make gpu``: what holds on a GPU, and how fast it is, in one JSON.

The tests marked ``gpu``, a short fleet whose first episode is compared with the CPU's, the rows "update" and
"iteration" of the benchmarks for fleets of several sizes, and physics by MuJoCo Warp beside those of the host. The
JSON is written after each part, so that whoever is stopped has what there was. ``--rehearse`` takes the same way on a
CPU at tiny sizes.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any
from xml.etree import ElementTree

import torch
import tyro

from benchmarks.effort import SMALL, Effort
from benchmarks.iteration import Iterations
from benchmarks.measure import Figure, interleaved, over
from benchmarks.missing import missing
from benchmarks.parts import replay
from benchmarks.table import machine
from benchmarks.updates import our_updates
from benchmarks.warp import missing as lacks_warp
from benchmarks.warp import physics
from coim import CoAdaptation, EpisodeDone, HopperMorph
from coim.envs import BODIES
from coim.experiments.run.build import build
from coim.experiments.run.machine import available_cores, prepare
from coim.experiments.run.settings import Settings

EFFORT = Effort(repeats=5, long_repeats=2, runs=(1, 16, 64, 256), fleets=(1, 16, 64), updates=100)
TINY = Effort(
    repeats=1,
    long_repeats=1,
    runs=(1, 2),
    fleets=(1, 2),
    batch_size=8,
    num_cells=(8,),
    model_cells=(8,),
    updates=2,
    individual_updates=2,
    population_updates=2,
    model_updates=2,
    episode_steps=8,
    fleet_steps=8,
)
FLEET = Settings(
    num_runs=32,
    first_design=(1.0, 1.0, 1.0, 1.0),
    num_designs=3,
    first_episodes=1,
    episodes=1,
    episode_steps=200,
    individual_updates=20,
    population_updates=10,
    model_updates=10,
    search="gradient",
)
TINY_FLEET = dataclasses.replace(
    FLEET, num_runs=2, episode_steps=8, batch_size=8, num_cells=(8,), model_cells=(8,), individual_updates=2
)
# Rounding grows along a gait: by then to 1e-5, ten times as much fifty steps later.
COMPARED, ALLOWED = 50, 1e-3
TESTS = Path(__file__).parents[1] / "tests"

Result = dict[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Test and measure on a GPU."""

    rehearse: bool = False
    """Take the whole way on the CPU at tiny sizes, without a GPU; its numbers say nothing."""
    minutes: float = 7.0
    """What has not begun by then is left out, and told."""
    out: Path = Path("runs/gpu.json")
    """Where the JSON goes."""


def main(options: Options) -> None:
    """Test, compare, measure and write; ends with 1 if something did not hold, was left out or failed."""
    if not options.rehearse and (lack := missing()):
        sys.exit(lack)
    ends = time.monotonic() + 60 * options.minutes
    device = torch.device("cpu" if options.rehearse else "cuda")
    prepare(available_cores(), device)
    effort, settings = (TINY, TINY_FLEET) if options.rehearse else (EFFORT, FLEET)
    small = effort if options.rehearse else dataclasses.replace(effort, num_cells=SMALL)
    steps: dict[str, Callable[[], Result]] = {
        "tests": lambda: marked_tests(ends - time.monotonic()),
        "fleet": lambda: fleet(settings, device),
        **{f"update, K = {runs}": lambda runs=runs: update(effort, runs, device) for runs in effort.runs},
        **{f"small update, K = {runs}": lambda runs=runs: update(small, runs, device) for runs in effort.runs},
        **{f"iteration, K = {runs}": lambda runs=runs: iteration(effort, runs, device) for runs in effort.fleets},
        **{
            f"physics, {name}, K = {runs}": lambda name=name, runs=runs: stepped(name, runs, effort, device)
            for name in BODIES
            for runs in effort.runs[1:]
        },
    }
    found: Result = {"machine": machine() | described(device), "rehearsal": options.rehearse, "parts": {}}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for name, step in steps.items():
        started = time.monotonic()
        result = done(step) if started < ends else {"holds": False, "error": f"left out after {options.minutes} min"}
        found["parts"][name] = result | {"seconds": round(time.monotonic() - started, 1)}
        options.out.write_text(json.dumps(found, indent=2) + "\n")
        print(f"{name}: {in_words(found['parts'][name])}", flush=True)
    print(f"-> {options.out}")
    if bad := [name for name, result in found["parts"].items() if not result["holds"]]:
        sys.exit(f"not well: {'; '.join(bad)}; see {options.out}")


def done(step: Callable[[], Result]) -> Result:
    """The result of a part, or why it has none: the others go on."""
    try:
        return step()
    except Exception as error:
        return {"holds": False, "error": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}


def described(device: torch.device) -> Result:
    """The GPU, and what torch was built for."""
    if device.type != "cuda":
        return {"gpu": "none"}
    about = torch.cuda.get_device_properties(device)
    return {"gpu": about.name, "gpu memory": f"{about.total_memory / 2**30:.0f} GiB", "cuda": torch.version.cuda}


def in_words(result: Mapping[str, Any]) -> str:
    """A result in one line, figures in a table below it."""
    told = {name: value for name, value in result.items() if name not in ("traceback", "figures", "holds")}
    line = ", ".join(f"{name} {value}" for name, value in told.items())
    figures = [Figure(row=f["row"], against=f["against"], note=line_of(f)) for f in result.get("figures", ())]
    return ("" if result["holds"] else "NOT WELL, ") + line + "".join(f"\n  {f.row}: {f.note}" for f in figures)


def line_of(figure: Mapping[str, Any]) -> str:
    """Ratio and amount of a figure as JSON has it."""
    amount, ratio = figure["amount"]["median"], figure["ratio"]["median"]
    return f"{amount:.4g} {figure['unit']}, {ratio:.3g} x {figure['against']}"


# -- tests -------------------------------------------------------------------------------------------------------------


def marked_tests(seconds: float) -> Result:
    """Run the tests marked ``gpu``; without a GPU all of them are skipped.

    Args:
        seconds: after which they are stopped.
    """
    files = sorted(str(path) for path in TESTS.rglob("test_*.py") if "mark.gpu" in path.read_text())
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        words = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", "-p", "no:cacheprovider", f"--junitxml={report}"]
        ended = subprocess.run(
            [*words, *files], cwd=TESTS.parent, capture_output=True, text=True, timeout=seconds, check=False
        )
        if not report.exists():
            return {"holds": False, "error": ended.stdout[-1000:] + ended.stderr[-1000:]}
        suite = next(ElementTree.parse(report).iter("testsuite"))
    counts = {name: int(suite.get(name, 0)) for name in ("tests", "failures", "errors", "skipped")}
    skipped = torch.cuda.is_available() and counts["skipped"] > 0
    holds = ended.returncode == 0 and not skipped
    return {"holds": holds, **counts} | ({} if holds else {"error": ended.stdout[-4000:]})


# -- a fleet -----------------------------------------------------------------------------------------------------------


def fleet(settings: Settings, device: torch.device) -> Result:
    """Follow Algorithm 1 to its end on the device, its first episode beside that of the CPU."""
    here, there = (
        build(HopperMorph, dataclasses.replace(settings, device=str(where)), threads=available_cores())
        for where in (device, "cpu")
    )
    started = time.perf_counter()
    first, expected = first_episode(here), first_episode(there)
    difference = float((first - expected)[:COMPARED].abs().max())
    returns = [algorithm.buffers.pop[: len(first)]["next", "reward"].sum(0).cpu() for algorithm in (here, there)]
    relative = float(((returns[0] - returns[1]) / returns[1]).abs().max())
    designs = 1 + sum(isinstance(event, EpisodeDone) for event in here)
    return {
        "holds": difference <= ALLOWED and designs == settings.num_designs,
        "runs": settings.num_runs,
        "steps compared": min(COMPARED, len(first)),
        "largest difference of an observation": difference,
        "allowed": ALLOWED,
        "largest relative difference of a return": relative,
        "steps of an episode": settings.episode_steps,
        "designs": designs,
        "seconds of both": round(time.perf_counter() - started, 1),
    }


def first_episode(algorithm: CoAdaptation) -> torch.Tensor:
    """Observations ``[T, K, S]`` of the first episode, on the CPU; the algorithm stands behind it."""
    next(event for event in algorithm if isinstance(event, EpisodeDone))
    return algorithm.buffers.pop[:]["observation"].cpu()


# -- rows of the benchmarks --------------------------------------------------------------------------------------------


def synchronised(action: Callable[[], object], device: torch.device) -> Callable[[], None]:
    """An action that is over when the device has done it."""

    def run() -> None:
        action()
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    return run


def update(effort: Effort, runs: int, device: torch.device) -> Result:
    """Sampling, gradients, Adam and target update, eager and captured, against one run (or one CPU thread)."""

    def action(num_runs: int, where: torch.device, **options: Any) -> Callable[[], None]:
        buffer = replay(num_runs, device=where)
        options = {"num_runs": num_runs, "device": where, "compile": False} | options
        return synchronised(our_updates(buffer, effort, effort.updates, **options), where)

    def candidate(**options: Any) -> Callable[[], None]:
        made = action(runs, device, **options)
        made()  # whatever cannot be compiled or captured fails here
        return made

    wanted: dict[str, dict[str, Any]] = {
        "float32": {},
        "bfloat16": {"precision": "bfloat16"},
        "float32, compiled": {"compile": True},
    }
    candidates, failed = {}, {}
    for name, options in wanted.items():
        try:
            candidates[name] = candidate(**options)
        except Exception as error:  # the others are measured
            failed[name] = f"{type(error).__name__}: {error}"
    alone = action(1, torch.device("cpu") if runs == 1 else device)
    against = "one run on one thread of the CPU" if runs == 1 else "one run on this device"
    times = interleaved({"alone": alone, **candidates}, effort.repeats)
    found = rows(
        Figure(
            row=f"update, K = {runs}, {name}",
            against=against,
            ratios=over(times[name], times["alone"]),
            amounts=tuple(1e3 * seconds / effort.updates for seconds in times[name]),
            unit="ms",
        )
        for name in candidates
    )
    return found | ({"holds": False, "failed": failed} if failed else {})


def iteration(effort: Effort, runs: int, device: torch.device) -> Result:
    """Training episode, refresh, updates, evaluation episode of Half-Cheetah, without and with imagination."""
    on_device = {"num_runs": runs, "device": device, "compile": False, "threads": available_cores()}
    actions = {name: Iterations(effort, imagine=name, **on_device) for name in ("none", "known")}
    times = interleaved({name: synchronised(run, device) for name, run in actions.items()}, effort.long_repeats)
    return rows(
        Figure(
            row=f"iteration, K = {runs}, {'with' if name == 'known' else 'without'} imagination",
            against="the one without",
            ratios=over(times[name], times["none"]),
            amounts=tuple(times[name]),
            unit="s",
            parts=run.parts(),
            note=f"{median(times[name]) / runs:.3g} s per run",
        )
        for name, run in actions.items()
    )


def stepped(name: str, runs: int, effort: Effort, device: torch.device) -> Result:
    """Physics on the device beside that of the host, where MuJoCo Warp is installed."""
    lack = lacks_warp()
    return {"holds": True, "left out": lack} if lack else rows(physics(name, runs, effort, device))


def rows(figures: Any) -> Result:
    """Figures as the JSON has them."""
    return {"holds": True, "figures": [figure.as_json() for figure in figures]}


if __name__ == "__main__":
    main(tyro.cli(Options, prog="python -m benchmarks.gpu", description=__doc__))
