"""Copy the tables of finished runs, without their checkpoints."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from coim.experiments.run.atomic_write import write_whole
from coim.experiments.study.ledger import in_csv, read_ledger
from coim.experiments.study.runs import runs_of_folder
from coim.run_folder import read_config

OF_STUDY = ("study.json", "retrained/designs.csv")
LEDGERS = ("ledger.csv", "retrained/ledger.csv")
OF_ITS_USER = r"evaluation(-\d+)?\.csv"  # what `coim evaluate` left, with paths of this machine
RUNS = ("cells", "retrained/cells", "model_error")


def archive(study: Path, target: Path) -> list[Path]:
    """Copy what the figures of a study are drawn from.

    Args:
        study: its folder.
        target: folder of the copy.

    Returns:
        The run folders that were copied, relative to the study's.

    Raises:
        ValueError: if the folder is no study's, no run of it is over, or the target keeps runs that it does not have.
    """
    if not (study / "cells").is_dir():
        raise ValueError(
            f"{study} is no study's folder: it has no cells/; name a folder that coim.experiments.commands.study wrote"
        )
    refuse_target(study, target)
    kept = [name for name in runs_in(study) if over(study / name)]
    if not kept:
        raise ValueError(f"no run of {study} is over yet; let the study go on")
    refuse_loss(study, target)
    for name in set(runs_in(target)) - set(kept):  # the study was changed since, and they go on
        remove_run(target / name)
    for name in kept:
        copy_run(study / name, target / name, name)
    for file in (*OF_STUDY, *LEDGERS):
        if (study / file).is_file():
            (target / file).parent.mkdir(exist_ok=True)
            finished = {folder.name for folder in kept}
            write_whole(target / file, only(finished, study / file) if file in LEDGERS else (study / file).read_bytes())
    return kept


def refuse_target(study: Path, target: Path) -> None:
    """Refuse to write over what is more than an archive.

    Raises:
        ValueError: if the target is in the study's own folder, is a study's folder itself, keeps another study, or is
            no folder.
    """
    if target.resolve().is_relative_to(study.resolve()):
        raise ValueError(f"{target} is in the study's own folder; name one outside of it")
    if target.exists() and not target.is_dir():
        raise ValueError(f"{target} is a file; name a folder")
    if (target / "logs").exists() or any(target.glob("cells/*/checkpoint")):
        raise ValueError(f"{target} is the folder of a study with checkpoints, no archive; name another one")
    kept, own = (name_of(folder) for folder in (target, study))
    if None not in (kept, own) and kept != own:
        raise ValueError(f"{target} keeps another study, {kept!r}, and this one is {own!r}; name another folder")


def refuse_loss(study: Path, target: Path) -> None:
    """Refuse to delete runs of an archive that came from elsewhere, as of a study that two machines computed.

    Raises:
        ValueError: that names one of them.
    """
    if elsewhere := sorted(set(runs_in(target)) - set(runs_in(study))):
        raise ValueError(
            f"{target} keeps {len(elsewhere)} run(s) that {study} does not have, such as {elsewhere[0]}; they would be "
            "lost: archive into a new folder and put the two together, or delete them yourself"
        )


def name_of(study: Path) -> str | None:
    """What a study is called in its ``study.json``, if it has one."""
    path = study / "study.json"
    return json.loads(path.read_text()).get("name") if path.is_file() else None


def runs_in(study: Path) -> list[Path]:
    """All run folders of a study, relative to its own."""
    return sorted(path.parent.relative_to(study) for part in RUNS for path in (study / part).rglob("config.json"))


def over(folder: Path) -> bool:
    """Whether nothing more will come into a run's folder."""
    runs = runs_of_folder(folder, environment="", task="", arm="", seed=0)
    return bool(runs) and all(run.over for run in runs)


def copy_run(folder: Path, target: Path, name: Path) -> None:
    """The settings and the tables of a run, whose folder is called by its place in the study."""
    target.mkdir(parents=True, exist_ok=True)
    config: dict[str, Any] = read_config(folder)
    config.pop("wandb_id", None)  # of an account
    config["settings"] |= {"out": name.as_posix(), "resume": None}
    for resumption in config.get("resumed", []):
        resumption["changed"].pop("out", None)
    write_whole(target / "config.json", json.dumps(config, indent=2) + "\n")
    for table in folder.glob("*.csv"):
        if re.fullmatch(OF_ITS_USER, table.name):
            continue
        write_whole(target / table.name, table.read_bytes())


def remove_run(folder: Path) -> None:
    """Take away what `copy_run` has written."""
    for path in (folder / "config.json", *folder.glob("*.csv")):
        path.unlink()
    if not any(folder.iterdir()):
        folder.rmdir()


def only(kept: set[str], ledger: Path) -> str:
    """A ledger in which every run waits that was not kept and has not failed again and again."""
    rows = []
    for row in read_ledger(ledger):
        row.message = ""  # why a cell failed is told with paths of its machine
        if row.cell in kept:
            row.state = "finished"
        elif row.state != "failed":
            row.state, row.tries, row.seconds = "waiting", 0, None
        rows.append(row)
    return in_csv(rows)
