"""Show what this machine has for coim, and what will be slow or missing: ``coim check``."""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from coim.experiments.run.interrupt import on_command_line
from coim.experiments.run.machine import available_cores, check_compiler, folder_of_compiled_code, words_of
from coim.products import fastest, has_bfloat16, kind_of_processor

NEEDED = ("coim", "torch", "torchrl", "tensordict", "mujoco", "gymnasium", "pyswarms", "numpy")
# Packages beside the library: what does not work without them, and how they are installed.
OPTIONAL = {
    "matplotlib": ("no pictures, no report and no figures", "'coim[experiments]'"),
    "scipy": ("no intervals in figures and tables", "'coim[experiments]'"),
    "imageio-ffmpeg": ("no films", "'coim[experiments]'"),
    "ray": ("no studies", "'coim[experiments]'"),
    "botorch": ("no --method returns or grounded, no DesignPosterior", "'coim[posterior]'"),
    "wandb": ("--log wandb has nothing to log with", "'coim[experiments]'"),
    "tensorboard": ("--log tensorboard has nothing to log with", "'coim[tensorboard]'"),
    "trackio": ("--log trackio has nothing to log with", "trackio"),
    "onnxruntime": ("coim export writes no ONNX", "'coim[export]'"),
    "safetensors": ("coim export writes no safetensors, coim watch --pretrained reads none", "'coim[export]'"),
    "minari": ("coim dataset writes nothing", "'coim[export]'"),
    "mjviser": ("no coim watch --live", "'coim[live]'"),
}
SEEN = "/proc/cpuinfo"  # Linux
# Draws one picture in a process of its own: MuJoCo reads MUJOCO_GL once, and a broken driver can end the process.
DRAW = """
from coim.envs import HopperMorph
env = HopperMorph(num_runs=1, seed=0)
env.reset()
env.render(0, width=64, height=48)
"""
DRAWING = 60  # s
REPLAY = 1.4  # GB, of 6.5 million rows: `make bench`, row memory


@dataclass(frozen=True)
class Finding:
    """One line of the check.

    Attributes:
        what: the part of the machine.
        found: what is there.
        lack: what will be slow or missing for that reason, and the way out; empty if nothing will.
    """

    what: str
    found: str
    lack: str = ""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: no options. Ends with 1 if a run cannot be made here."""
    parser = argparse.ArgumentParser(prog="coim check", description="Show what this machine has for coim.")
    parser.parse_args(arguments)
    with on_command_line(own_process=arguments is None):
        findings = [*versions(), processor(), products(), gpu(), compiler(), opengl(), room()]
    width = max(len(finding.what) for finding in findings)
    for finding in findings:
        print(f"{finding.what:{width}}  {finding.found}")
    lacks = [f"- {finding.lack}" for finding in findings if finding.lack]
    print("\n".join(["", "slow or missing:", *lacks] if lacks else ["", "nothing is missing"]))


def versions() -> list[Finding]:
    """Versions of what coim is made of."""
    found = [Finding("python", f"{platform.python_version()}, {sys.executable}")]
    found += [Finding(name, version(name)) for name in NEEDED]
    for name, (lack, installed_by) in OPTIONAL.items():
        try:
            found.append(Finding(name, version(name)))
        except PackageNotFoundError:
            found.append(Finding(name, "not installed", f"{lack} without {name}: pip install {installed_by}"))
    return found


def processor() -> Finding:
    """Name, instructions and cores of the processor."""
    cores = available_cores()
    lack = "" if cores > 1 else "one core: the learners take turns, which takes 1.6 times as long as side by side"
    instructions = torch.backends.cpu.get_cpu_capability()
    return Finding("processor", f"{name_of_processor()}, {instructions}, {cores} core(s) for this process", lack)


def name_of_processor() -> str:
    """The processor's name as the system tells it."""
    try:
        with Path(SEEN).open() as lines:
            names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    except OSError:
        names = []
    return next(iter(names), platform.processor() or platform.machine())


def products() -> Finding:
    """The library that multiplies matrices here."""
    kind, lacks = kind_of_processor(), []
    if not has_bfloat16():
        lacks.append("bfloat16 is emulated: --precision float32 is faster here")
    if kind == "other":
        lacks.append("this kind of processor was not measured: the row libraries of make bench tells")
    return Finding("products", f"by {words_of(fastest())} (row {kind!r} of the table)", "; ".join(lacks))


def gpu() -> Finding:
    """The GPU that torch sees."""
    if torch.cuda.is_available():
        device = torch.cuda.get_device_properties(0)
        return Finding("GPU", f"{device.name}, {device.total_memory / 2**30:.0f} GiB; --device cuda takes it")
    why = "torch is built without CUDA" if torch.version.cuda is None else "torch sees none"
    return Finding("GPU", f"none ({why})", "no GPU: the paper's protocol takes about a day on one core")


def compiler() -> Finding:
    """The C++ compiler of ``--compile`` and ``--native-episodes``."""
    try:
        check_compiler()
    except ValueError as error:
        return Finding("compiler", "none that can be used", f"{error}; updates and episodes take longer then")
    return Finding("compiler", f"found; compiled code goes to {folder_of_compiled_code()}")


def opengl() -> Finding:
    """Whether a picture can be drawn."""
    environment = os.environ.copy()
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*environment}:
        environment.setdefault("MUJOCO_GL", "egl")
    by = environment.get("MUJOCO_GL", "MuJoCo's default")
    try:
        drawn = subprocess.run(
            [sys.executable, "-c", DRAW], env=environment, capture_output=True, text=True, timeout=DRAWING, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding("OpenGL", f"{by}: no picture within {DRAWING} s", "films and drawn bodies may hang")
    if drawn.returncode == 0:
        return Finding("OpenGL", f"draws ({by})")
    last = (drawn.stderr.strip().splitlines() or [f"ended with {drawn.returncode}"])[-1]
    reason = last.split(": ", 1)[-1]
    return Finding("OpenGL", f"does not draw ({by})", f"no films and no drawn bodies: {reason}")


def room() -> Finding:
    """Free disk of the working directory, where ``runs/`` is made."""
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    lack = ""
    if free < 2 * REPLAY:
        lack = f"{free:.1f} GB of disk: a run of the paper's protocol keeps a replay of {REPLAY} GB"
    return Finding("disk", f"{free:.0f} GB free here", lack)
