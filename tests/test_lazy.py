"""Names that are imported when they are asked for: what works without mujoco and pyswarms, and that no name is lost."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

import coim
from coim.lazy import when_imported

PACKAGES = pytest.mark.parametrize("package", ["coim", "coim.designs", "coim.envs"])


def python(lines: list[str], *, without: list[str]) -> str:
    """What a process prints in which some packages are not installed."""
    lines = [f"import sys; sys.modules.update(dict.fromkeys({without}))", *lines]
    result = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    return result.stdout


def asked_for(name: str, *, package: str = "coim") -> str:
    """Two lines that print why a name cannot be had."""
    return f"try: from {package} import {name}\nexcept ImportError as error: print(type(error).__name__, error)"


def test_what_needs_neither_mujoco_nor_pyswarms_works_and_the_rest_names_what_is_missing() -> None:
    names = ["CoImSACLoss", "DesignValue", "EnsembleNLLLoss", "GaussianEnsemble", "make_policy", "make_qvalue"]
    names += ["SACLearner", "DynamicsLearner", "TransitionBuffer", "WorldModelEnv", "imagine", "sample_batches"]
    names += ["KnownDesigns", "NoisyDesigns", "RandomDesigns", "GradientSearch"]
    lines = [f"from coim import {name}" for name in names]
    lines += ["from coim.objectives import CoImSACLoss", "from coim.models import make_policy", "import coim.designs"]
    lines += [asked_for("HopperMorph"), asked_for("ParticleSwarm")]
    said = python(lines, without=["mujoco", "pyswarms", "gymnasium"]).splitlines()
    for sentence, missing in zip(said, ("mujoco", "pyswarms"), strict=True):
        assert sentence.startswith("ModuleNotFoundError")
        assert missing in sentence


def test_without_botorch_all_other_names_can_be_had_and_the_posterior_says_what_to_install() -> None:
    packages = ("coim", "coim.designs")
    lines = ["from coim import CoAdaptation, TrustRegion"]
    for package in packages:
        lines += [f"from {package} import *", "GradientSearch", "del GradientSearch"]
        lines += [asked_for("DesignPosterior", package=package)]
    said = python(lines, without=["botorch", "gpytorch", "linear_operator"]).splitlines()
    assert said == ["ImportError DesignPosterior needs BoTorch, which is optional: pip install 'coim[posterior]'"] * 2


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


def test_gymnasium_knows_the_bodies_in_either_order_and_is_not_imported_for_it() -> None:
    lines = ["import sys, coim", "assert not {'gymnasium', 'torch'} & sys.modules.keys()", "import gymnasium"]
    lines += ["known = [name for name in gymnasium.registry if name.startswith('coim/')]"]
    lines += ["assert 'torch' not in sys.modules", "for name in known: del gymnasium.registry[name]"]
    lines += ["del sys.modules['coim']", "import coim"]
    lines += ["assert known == [name for name in gymnasium.registry if name.startswith('coim/')]", "print(*known)"]
    result = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=True)
    assert "coim/Hopper-v0" in result.stdout.split()


def test_a_call_waits_for_its_module_and_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "made_up_module.py").write_text("value = 1")
    monkeypatch.syspath_prepend(tmp_path)
    finders, seen = list(sys.meta_path), []
    when_imported("made_up_module", lambda: seen.append(sys.modules["made_up_module"].value))
    assert importlib.import_module("json") is not None
    for _ in range(2):
        assert importlib.util.find_spec("made_up_module") is not None  # looks, and imports nothing
    assert seen == []
    importlib.reload(importlib.import_module("made_up_module"))
    assert (seen, sys.meta_path) == ([1], finders)
    when_imported("made_up_module", lambda: seen.append(2))  # it is there already
    monkeypatch.setitem(sys.modules, "made_up_module", None)  # and now it is forbidden
    when_imported("made_up_module", lambda: seen.append(3))
    assert (seen, sys.meta_path) == ([1, 2], finders)
