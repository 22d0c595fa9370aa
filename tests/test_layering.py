"""The rules of the house, read from the sources: who imports whom, what has one home, what a library does not do.

``violations`` maps one source to the rules that it breaks, so that it can be tried on made-up sources too.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Import only from a lower rank, or from your own room. The rooms of rank 1 do not know each other; rank 2 is one room.
RANKS = {name: 0 for name in ("objectives.functional", "products", "angles", "randomness", "calling", "lazy", "tables")}
RANKS |= {"native": 0}
RANKS |= {name: 1 for name in ("envs", "models", "objectives", "designs", "buffers", "batches", "compiling", "pairs")}
RANKS |= {name: 2 for name in ("learners", "episode", "imagination", "events", "agreement", "design_choice")}
RANKS |= {name: 2 for name in ("updates", "position", "coadaptation", "checkpoints", "saved_run", "run_folder")}
RANKS |= {name: 2 for name in ("governor", "imagined_replay", "posterior_choice")}
RANKS |= {"experiments": 3}
HOMES = {"mujoco": "envs", "gymnasium": "envs", "pyswarms": "designs"}
HOMES |= {name: "designs" for name in ("botorch", "gpytorch", "linear_operator")}
OF_EXPERIMENTS = ("wandb", "tyro", "matplotlib", "imageio", "jinja2", "argparse", "ray", "pandas", "pydantic")
OF_EXPERIMENTS += ("onnx", "onnxruntime", "safetensors", "minari", "h5py", "mjviser", "viser")
HOMES |= dict.fromkeys(OF_EXPERIMENTS, "experiments")
REFUSED = {"utils", "common", "core", "helpers", "misc", "trainers"}
DYNAMIC_IMPORTS = {"importlib.import_module", "import_module", "__import__"}
FUNCTIONAL_MAY_IMPORT = {"torch", "__future__", "typing", "math"}


def room_of(module: str) -> str | None:
    """The ranked part of ``coim`` that a module belongs to; None for ``coim`` itself and for modules without a rank."""
    name = module.removeprefix("coim.")
    return next((room for room in RANKS if name == room or name.startswith(room + ".")), None)


def imports(tree: ast.AST, module: str, *, is_package: bool) -> Iterator[str]:
    """Every module that a source imports, at its top or inside of functions, relative names resolved."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = module.split(".")[: (0 if not node.level else -node.level + is_package) or None]
            base = ".".join([*(parents if node.level else []), *([node.module] if node.module else [])])
            # `from coim.objectives import functional` imports a module, `from coim.designs import KnownDesigns` a name.
            yield from (f"{base}.{alias.name}" if base.split(".")[0] == "coim" else base for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in DYNAMIC_IMPORTS:
            yield from (
                arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant) and isinstance(arg.value, str)
            )


def violations(source: str, module: str, *, is_package: bool = False) -> list[str]:
    """What a source of ``coim`` does against the rules, one sentence each."""
    tree = ast.parse(source)
    names = list(imports(tree, module, is_package=is_package))
    found = []
    room = room_of(module)
    if module != "coim" and room is None:
        found.append(f"{module} has no rank: give it one in RANKS")
    for name in names:
        top, other = name.split(".")[0], room_of(name)
        if top == "coim" and module != "coim" and room is not None:
            if other is None:
                found.append(f"{module} imports {name}, the front door: import from the module that defines it")
            elif other != room and (RANKS[other] > RANKS[room] or RANKS[other] == RANKS[room] < 2):
                found.append(f"{module} (rank {RANKS[room]}) imports {name} (rank {RANKS[other]})")
        if HOMES.get(top, room) != room:
            found.append(f"{module} imports {top}, whose home is {HOMES[top]}")
        if module == "coim.objectives.functional" and top not in FUNCTIONAL_MAY_IMPORT:
            found.append(f"{module} imports {top}, it may import torch only")
    if room == "experiments":
        return found
    prints = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and ast.unparse(node.func) == "print"]
    return found + [f"{module} prints in line {node.lineno}" for node in prints]


def refused_names(paths: list[Path]) -> list[str]:
    """Folders and modules whose name says nothing about what is in them."""
    return [str(path) for path in paths if REFUSED & {*path.parent.parts, path.stem}]


def library() -> list[tuple[Path, str]]:
    """Every source of the library with its module name."""
    sources = sorted((ROOT / "coim").rglob("*.py"))
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in sources]
    return list(zip(sources, names))


def imported(sources: Mapping[str, tuple[str, bool]]) -> dict[str, set[str]]:
    """Modules that each of some modules imports, for type checking only included.

    Args:
        sources: text of each module, and whether it is a package's ``__init__``.
    """
    graph: dict[str, set[str]] = {}
    for module, (source, is_package) in sources.items():
        graph[module] = set()
        for name in imports(ast.parse(source), module, is_package=is_package):
            while name and name not in sources:  # `from coim.designs import KnownDesigns` names no module
                name = name.rpartition(".")[0]
            graph[module] |= {name} - {"", module}
    return graph


def by_folder(graph: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """The same for the folders of ``coim`` and of ``coim.experiments``, and for the modules beside them."""

    def folder(module: str) -> str:
        return ".".join(module.split(".")[: 3 if module.startswith("coim.experiments.") else 2])

    folders: dict[str, set[str]] = {}
    for module, names in graph.items():
        folders.setdefault(folder(module), set()).update({folder(name) for name in names} - {folder(module)})
    return folders


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """A circle of imports, from a module to itself; empty if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


LIBRARY = imported({module: (path.read_text(), path.name == "__init__.py") for path, module in library()})


def test_there_is_no_circle_of_imports() -> None:
    assert len(LIBRARY) > 100
    assert circle(LIBRARY) == []
    assert circle(by_folder(LIBRARY)) == []


def test_nothing_outside_of_the_experiments_imports_them() -> None:
    outside = {module: names for module, names in LIBRARY.items() if not module.startswith("coim.experiments")}
    assert outside
    assert {m: names for m, names in outside.items() if any(n.startswith("coim.experiments") for n in names)} == {}


def test_commands_import_none_of_each_other() -> None:
    commands = {module: names for module, names in LIBRARY.items() if module.startswith("coim.experiments.commands.")}
    assert commands
    assert {module: names & commands.keys() for module, names in commands.items() if names & commands.keys()} == {}


@pytest.mark.parametrize(
    "other",
    [
        "from coim.one import f",
        "from coim import one",
        "def late():\n    import coim.one",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .one import f",
    ],
)
def test_a_circle_is_found(other: str) -> None:
    sources = {"coim": ("", True), "coim.one": ("from coim.two import g", False), "coim.two": (other, False)}
    assert set(circle(imported(sources))) == {"coim.one", "coim.two"}


def test_a_circle_of_folders_is_found_where_no_two_modules_are_in_one() -> None:
    sources = {
        "coim.a.one": "from coim.b.one import f",
        "coim.a.two": "",
        "coim.b.one": "",
        "coim.b.two": "from coim.a.two import g",
    }
    graph = imported({module: (source, False) for module, source in sources.items()})
    assert circle(graph) == []
    assert set(circle(by_folder(graph))) == {"coim.a", "coim.b"}


@pytest.mark.parametrize(("path", "module"), library(), ids=[name for _, name in library()])
def test_a_module_keeps_the_rules(path: Path, module: str) -> None:
    assert violations(path.read_text(), module, is_package=path.name == "__init__.py") == []


def test_no_folder_or_module_has_a_name_that_says_nothing() -> None:
    folders = [ROOT / name for name in ("coim", "recipes", "benchmarks", "tests")]
    sources = [path.relative_to(ROOT) for folder in folders for path in folder.rglob("*.py")]
    assert sources
    assert refused_names(sources) == []


def test_no_test_imports_another() -> None:
    """What several tests need is a fixture, or a module that is no test."""
    sources = sorted((ROOT / "tests").rglob("*.py"))
    found = [name for path in sources for name in imports(ast.parse(path.read_text()), path.stem, is_package=False)]
    assert "toy_env" in found
    assert [name for name in found if name.startswith("test_")] == []


def test_importing_the_library_is_silent_and_leaves_no_file(tmp_path: Path) -> None:
    modules = [module for _, module in library() if not module.startswith("coim.experiments")]
    script = "\n".join(f"import {module}" for module in modules)
    script += "\nimport sys; assert not {'matplotlib', 'wandb', 'tyro', 'imageio', 'pandas'} & set(sys.modules)"
    script += "\nimport logging; assert not logging.root.handlers"
    result = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        (
            "coim.envs.hopper",
            "from coim.models.ensemble import GaussianEnsemble",
            "(rank 1) imports coim.models.ensemble",
        ),
        ("coim.buffers", "from coim.designs import KnownDesigns", "(rank 1) imports coim.designs"),
        ("coim.models.policy", "from coim.learners.sac import Learner", "(rank 1) imports coim.learners.sac"),
        ("coim.objectives.functional", "import coim.objectives.sac", "(rank 0) imports coim.objectives.sac"),
        ("coim.objectives.functional", "from . import sac", "(rank 0) imports coim.objectives.sac"),
        ("coim.objectives.sac", "from ..models import policy", "(rank 1) imports coim.models.policy"),
        ("coim.designs", "from .buffers import Buffers", "(rank 1) imports coim.buffers"),
        ("coim.designs", "def late():\n    import coim.buffers", "(rank 1) imports coim.buffers"),
        ("coim.designs", "import importlib\nimportlib.import_module('coim.buffers')", "(rank 1) imports coim.buffers"),
        ("coim.learners.sac", "from coim import make_policy", "the front door"),
        ("coim.models.policy", "import mujoco", "imports mujoco, whose home is envs"),
        ("coim.learners.sac", "from gymnasium import Env", "imports gymnasium, whose home is envs"),
        ("coim.buffers", "import pyswarms.single as s", "imports pyswarms, whose home is designs"),
        ("coim.envs.hopper", "import pyswarms", "imports pyswarms, whose home is designs"),
        ("coim.coadaptation", "import wandb", "imports wandb, whose home is experiments"),
        ("coim.coadaptation", "import tyro", "imports tyro, whose home is experiments"),
        ("coim.saved_run", "def rows():\n    import pandas", "imports pandas, whose home is experiments"),
        ("coim.envs.morph", "import matplotlib.pyplot as plt", "imports matplotlib, whose home is experiments"),
        ("coim", "from argparse import ArgumentParser", "imports argparse, whose home is experiments"),
        ("coim.objectives.functional", "import numpy as np", "it may import torch only"),
        ("coim.objectives.functional", "from tensordict import TensorDict", "it may import torch only"),
        ("coim.learners.sac", "def update():\n    print('loss')", "prints in line 2"),
        ("coim.training", "import torch", "has no rank"),
    ],
)
def test_a_bad_source_is_found(module: str, source: str, complaint: str) -> None:
    assert any(complaint in found for found in violations(source, module))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        (
            "coim.objectives.sac",
            "from coim.objectives import functional\nfrom coim.objectives.functional import soft_value",
        ),
        (
            "coim.models.policy",
            "from coim.objectives.functional import soft_value\nfrom coim.models.stacked import StackedMLP",
        ),
        ("coim.envs.hopper", "import mujoco, gymnasium\nfrom .morph import MorphEnv"),
        ("coim.coadaptation", "from coim.learners.sac import Learner\nfrom coim.imagination import imagine"),
        (
            "coim.imagination",
            "from coim.designs import DesignGenerator\nfrom coim.envs.world_model import WorldModelEnv",
        ),
        (
            "coim.objectives.functional",
            "from __future__ import annotations\nimport math, torch\nfrom typing import Literal",
        ),
        ("coim.learners.sac", '"""Say print("x") in a docstring."""\npprint = 1\nself.print()'),
        ("coim", "from coim.designs import KnownDesigns\nfrom .buffers import Buffers"),
    ],
)
def test_a_good_source_is_let_through(module: str, source: str) -> None:
    assert violations(source, module, is_package=module == "coim") == []


def test_names_that_say_nothing_are_found() -> None:
    paths = [
        Path("coim/utils/seeds.py"),
        Path("coim/helpers.py"),
        Path("recipes/common/plot.py"),
        Path("coim/designs.py"),
    ]
    assert refused_names(paths) == [str(path) for path in paths[:3]]
