"""Rules about what may be resumed."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from coim.checkpoints import PREFIX
from coim.experiments.run.atomic_write import ASIDE, write_whole
from coim.experiments.run.interrupt import LOCK
from coim.experiments.run.provenance import git_revision, now, versions
from coim.experiments.run.settings import ELSEWHERE, LATER, Settings, plain
from coim.products import chosen
from coim.run_folder import read_config

# What may differ when a run is gone on with, because no number of its past depends on it. Other products round the
# numbers to come otherwise, as other versions do.
FREE = {"num_designs", "threads", "products", "checkpoint_every", "resume", "wandb", "quiet"}


def refuse_filled(folder: Path) -> None:
    """Leave a folder alone that holds anything but our own lock, and a first file that was not finished."""
    ours = {LOCK, ASIDE.format("config.json")}
    if folder.exists() and (not folder.is_dir() or any(path.name not in ours for path in folder.iterdir())):
        raise FileExistsError(
            f"{folder} already holds something; name another folder with --out, move it away, or go on with the run in "
            f"it by --resume {folder}"
        )


def note_resumption(folder: Path, settings: Settings) -> None:
    """Write into ``config.json`` that the run went on: when, by which code, and with which other settings."""
    config = read_config(folder)
    moved = changes(saved_settings(folder), settings)
    products = chosen()._asdict()
    config["settings"] = plain(dataclasses.replace(settings, resume=None))
    config["products"] = products
    config["resumed"] = [
        *config.get("resumed", []),
        {"at": now(), "revision": git_revision(), "products": products, "versions": versions(), "changed": moved},
    ]
    write_whole(folder / "config.json", json.dumps(config, indent=2) + "\n")


def refuse_lost_checkpoints(folder: Path) -> None:
    """Refuse to go on with a run that has rows and no checkpoint: it would begin anew over them.

    Raises:
        ValueError: as for a copy of its tables alone. A run makes a checkpoint before its first row.
    """
    rows = folder / "evaluations.csv"
    if rows.is_file() and rows.read_bytes().count(b"\n") > 1 and not any((folder / "checkpoint").glob(f"{PREFIX}-*")):
        raise ValueError(
            f"{folder} has the tables of a run and no checkpoint/ to go on from; copy it there, or start a new run in "
            "another folder"
        )


def check_origin(folder: Path, name: str, settings: Settings) -> None:
    """Refuse a run of another environment, and warn of another machine and other versions than it began with."""
    config = read_config(folder)
    if config["environment"] != name:
        raise ValueError(f"{folder} holds a run of {config['environment']}: coim resume {folder}")
    now, before = vars(settings) | versions(), vars(saved_settings(folder)) | config["versions"]
    for what in (*ELSEWHERE, *config["versions"]):
        if now.get(what) != before[what]:
            told = f"{what} was {before[what]} and is {now.get(what)}"
            print(f"warning: {told}; the numbers may differ from here", file=sys.stderr)


def to_go_on(settings: Settings) -> Settings:
    """The settings with which a cell is begun, or with which its run is resumed.

    Raises:
        ValueError: if the folder holds files of a run and no config.json; see also `resumed`.
    """
    folder = settings.out
    if folder is None:
        raise ValueError("a cell has a folder")
    if (going_on := resumed(settings, folder)) is not None:
        return going_on
    # config.json is the first file of a run; a process that was killed before left it half written.
    if found := {path.name for path in folder.glob("*")} - {LOCK, ASIDE.format("config.json")}:
        raise ValueError(
            f"{folder} holds {', '.join(sorted(found))} and no config.json; put that back from a copy, or move the "
            "folder away to begin anew"
        )
    return settings


def resumed(settings: Settings, folder: Path) -> Settings | None:
    """The settings with which a run goes on; None if it has not begun. Nothing is changed on disk.

    Raises:
        ValueError: if it was begun with settings on which its past depends and which are others now, or its folder has
            rows and no checkpoint.
    """
    if not (folder / "config.json").exists():
        return None
    refuse_lost_checkpoints(folder)
    saved = saved_settings(folder)
    # A study may have been moved, or given another name.
    going_on = dataclasses.replace(settings, out=saved.out, name=saved.name, resume=folder)
    refuse_changes(saved, going_on)
    return going_on


def saved_settings(folder: Path) -> Settings:
    """The settings of the run in a folder.

    Raises:
        ValueError: if there is none, or one of a version that had other settings. Those that came later take their
            defaults.
    """
    saved = read_config(folder)["settings"]
    fields = {field.name for field in dataclasses.fields(Settings)}
    if other := sorted((fields ^ saved.keys()) - LATER):
        raise ValueError(
            f"{folder} was made by a version with other settings: {', '.join(other)}; go on with the version in its "
            "config.json"
        )
    values: dict[str, Any] = saved | {"out": Path(saved["out"]) if saved["out"] else None}
    return Settings(**values)


def changes(old: Settings, new: Settings) -> dict[str, list[Any]]:
    """Settings that differ, old and new value; where a run is resumed from is no setting of it."""
    one, other = plain(old), plain(new)
    return {name: [one[name], other[name]] for name in one if one[name] != other[name] and name != "resume"}


def refuse_changes(old: Settings, new: Settings) -> None:
    """Refuse by name what cannot be changed in the middle of a run."""
    fixed = {name: values for name, values in changes(old, new).items() if name not in {*FREE, *ELSEWHERE}}
    if fixed:
        told = ", ".join(f"{name} ({was!r} to {wanted!r})" for name, (was, wanted) in fixed.items())
        raise ValueError(
            f"the run in {new.resume} has begun with other settings: {told}; leave them, or start a new run. "
            f"Free to change are {', '.join(sorted(FREE - {'resume'}))}; with other numbers from there also "
            f"{', '.join(ELSEWHERE)}"
        )
    if new.num_designs < old.num_designs:
        raise ValueError(
            f"num_designs was {old.num_designs} and can only grow, not shrink to {new.num_designs}; to end a run "
            "early, stop it"
        )
