"""The body that a command line names."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from coim.experiments.run.bodies import imported_body


def test_a_module_in_the_present_folder_is_found_by_the_installed_command_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python has the folder of the command in its path then, not the present one."""
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry not in ("", str(Path.cwd()))])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="start from the folder in which robot_of_this_folder lies"):
        imported_body("robot_of_this_folder:Robot")
    (tmp_path / "robot_of_this_folder.py").write_text("from coim import HopperMorph\nclass Robot(HopperMorph): ...\n")
    body = imported_body("robot_of_this_folder:Robot")
    assert body is not None
    assert body.__name__ == "Robot"
    assert sys.path.count(str(tmp_path)) == 1
    sys.modules.pop("robot_of_this_folder")
