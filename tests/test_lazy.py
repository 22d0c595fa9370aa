"""Names that are imported when they are asked for: what works without mujoco and pyswarms, and that no name is lost."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import coim

PACKAGES = pytest.mark.parametrize("package", ["coim", "coim.designs", "coim.envs"])
WITHOUT = "import sys; sys.modules.update(mujoco=None, pyswarms=None, gymnasium=None)\n"


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", WITHOUT + code], capture_output=True, text=True, check=False)


def test_losses_networks_learners_buffers_and_the_dream_need_neither_mujoco_nor_pyswarms() -> None:
    names = ["CoImSACLoss", "DesignValue", "EnsembleNLLLoss", "GaussianEnsemble", "make_policy", "make_qvalue"]
    names += ["SACLearner", "DynamicsLearner", "TransitionBuffer", "WorldModelEnv", "imagine", "sample_batches"]
    names += ["KnownDesigns", "NoisyDesigns", "RandomDesigns", "GradientSearch"]
    lines = [f"from coim import {name}" for name in names]
    lines += ["from coim.objectives import CoImSACLoss", "from coim.models import make_policy", "import coim.designs"]
    result = python("\n".join(lines))
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize(("name", "missing"), [("HopperMorph", "mujoco"), ("ParticleSwarm", "pyswarms")])
def test_what_needs_a_missing_package_names_it(name: str, missing: str) -> None:
    said = python(f"from coim import {name}").stderr.splitlines()[-1]
    assert said.startswith("ModuleNotFoundError")
    assert missing in said


@PACKAGES
def test_every_public_name_is_there_and_is_the_one_that_type_checkers_see(package: str) -> None:
    module = importlib.import_module(package)
    tree = ast.parse(Path(str(module.__file__)).read_text())
    (checked,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    homes = {
        alias.name: ("." * node.level + str(node.module), package)
        for node in checked.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert set(homes) == set(module.__all__)
    for name, home in homes.items():
        assert getattr(module, name) is getattr(importlib.import_module(*home), name)
    assert set(module.__all__) <= set(dir(module))


@PACKAGES
def test_a_name_that_is_not_there_is_an_attribute_error(package: str) -> None:
    module = importlib.import_module(package)
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        module.nothing  # noqa: B018
    assert not hasattr(module, "_private")


def test_modules_are_found_by_their_names_as_if_the_package_had_imported_them() -> None:
    result = subprocess.run(
        [sys.executable, "-c", "import coim; print(coim.products.__name__, coim.envs.task.__name__)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.split() == [coim.products.__name__, "coim.envs.task"]
