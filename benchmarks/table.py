"""The one table, the machine it was measured on, and both as JSON."""

from __future__ import annotations

import datetime
import importlib.util
import json
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from benchmarks.measure import Figure
from coim.experiments.run.machine import available_cores, words_of
from coim.experiments.run.provenance import PACKAGES, git_revision
from coim.products import Choice, chosen

OTHERS = {"stable_baselines3": "stable-baselines3", "sbx": "sbx-rl", "jax": "jax"}
COLUMNS = ("row", "ratio", "(min - max)", "against", "amount", "target", "met", "note")


def machine() -> dict[str, Any]:
    """Processor, cores, threads, load and versions."""
    others = {name: version(name) for module, name in OTHERS.items() if importlib.util.find_spec(module)}
    return {
        "processor": _processor(),
        "cores": available_cores(),
        "threads": torch.get_num_threads(),
        "load before": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "widest instructions": torch.backends.cpu.get_cpu_capability(),
        "products": chosen()._asdict(),
        "system": platform.platform(),
        "versions": {"python": platform.python_version()} | {name: version(name) for name in PACKAGES} | others,
        "revision": git_revision(),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _processor() -> str:
    """Its name where the system tells."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def heading(found: dict[str, Any]) -> str:
    """The machine in two lines."""
    versions = ", ".join(f"{name} {number}" for name, number in found["versions"].items())
    return (
        f"{found['processor']}, {found['cores']} core(s), {found['widest instructions']}, load {found['load before']}; "
        f"products by {words_of(Choice(**found['products']))}, one thread where a row does not say otherwise, freed "
        f"memory is kept as in real runs\n{versions}\n"
        "floor: the matrix products of the same work alone, by torch.mm (MKL) in float32, in the same run"
    )


def text(figures: Sequence[Figure]) -> str:
    """The table in aligned columns."""
    cells = [COLUMNS, *(_cells(figure) for figure in figures)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(COLUMNS) - 1)]
    rule = "-" * (sum(widths) + 2 * len(widths) + len(COLUMNS[-1]))
    lines = ["  ".join([*(cell.ljust(width) for cell, width in zip(row, widths)), row[-1]]).rstrip() for row in cells]
    return "\n".join([lines[0], rule, *lines[1:]])


def _cells(figure: Figure) -> tuple[str, ...]:
    if not figure.ratios:
        return figure.row, "-", "", figure.against, "", _target(figure), "-", figure.note
    amount = f"{figure.amount:,.4g} {figure.unit}" if figure.amounts else ""
    if figure.amount >= 10_000:
        amount = f"{figure.amount:,.0f} {figure.unit}"
    spread = f"({min(figure.ratios):.3g} - {max(figure.ratios):.3g})"
    met = {None: "", True: "yes", False: "NO"}[figure.met]
    return figure.row, f"{figure.ratio:.3g}", spread, figure.against, amount, _target(figure), met, figure.note


def _target(figure: Figure) -> str:
    if figure.target is None:
        return ""
    return str(figure.target) + (f" {figure.unit}" if figure.target.of == "amount" else "")


def write(path: Path, found: dict[str, Any], figures: Sequence[Figure]) -> None:
    """Everything as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"machine": found, "figures": [figure.as_json() for figure in figures]}
    path.write_text(json.dumps(content, indent=2) + "\n")
