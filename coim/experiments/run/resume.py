"""All rules about resuming a run: what may differ, what is refused, and what is written down about it."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from coim.checkpoints import PREFIX
from coim.experiments.run.atomic_write import ASIDE, write_whole
from coim.experiments.run.effect import without_effect
from coim.experiments.run.interrupt import LOCK
from coim.experiments.run.machine import choose_products
from coim.experiments.run.provenance import git_revision, now, versions
from coim.experiments.run.settings import Settings, plain
from coim.products import Choice, chosen
from coim.run_folder import read_config

# Settings that may change when a run is resumed, because no number of its past depends on them. Other products round
# later numbers differently, as other versions do.
FREE = {"num_designs", "threads", "products", "checkpoint_every", "resume", "log", "wandb", "quiet"}
# Settings that may change because the machine may lack what they name. Later numbers differ, at first within rounding.
ELSEWHERE = ("device", "replay_device", "compile", "native_episodes")
# Settings that may differ between a finished cell of a study and the same cell as it is asked for.
OF_NO_NUMBER = FREE | {"out", "device", "replay_device", "name"}
# Settings that older folders lack. Their defaults are what every run had before.
LATER = {"replay_device", "products", "value_states", "value_over", "chosen_by", "reach", "widening"}
LATER |= {"log", "imagined_states", "imagined_actions", "anchored", "governed", "native_episodes"}
FORMERLY = Choice("onednn", "onednn")  # the products of runs whose folder does not name them


def begin_or_resume(name: str, settings: Settings) -> Choice:
    """Refuse a run that can be neither begun nor resumed, and choose the library of its products.

    Args:
        name: of the environment.
        settings: of the run; ``resume`` names its folder if it is to be resumed.

    Raises:
        FileExistsError: if a new run is to use a folder that holds something.
        ValueError: if the run to resume is one of another environment, has lost its checkpoints, or this machine
            lacks the library that was asked for.
    """
    if settings.resume is None:
        if settings.out is not None:
            refuse_filled(settings.out)
        return choose_products(settings.products)
    check_origin(settings.resume, name, settings)
    refuse_lost_checkpoints(settings.resume)
    begun = read_config(settings.resume).get("products", FORMERLY._asdict())
    changed = saved_settings(settings.resume).products != settings.products
    return choose_products(settings.products, begun=begun, changed=changed)


def refuse_filled(folder: Path) -> None:
    """Refuse a folder that holds anything but a lock and an unfinished first file of ours."""
    ours = {LOCK, ASIDE.format("config.json")}
    if folder.exists() and (not folder.is_dir() or any(path.name not in ours for path in folder.iterdir())):
        raise FileExistsError(
            f"{folder} already holds something; name another folder with --out, move it away, or go on with the run in "
            f"it by --resume {folder}"
        )


def note_resumption(folder: Path, settings: Settings) -> None:
    """Add a resumption to ``config.json``: its time, its code, and the settings that changed."""
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
    """Refuse to resume a run that has rows and no checkpoint: it would start again over them.

    Raises:
        ValueError: such as for a copy of its tables alone. A run saves a checkpoint before its first row.
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
    """Return the settings that begin or resume the run of a cell.

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
    """Return the settings that resume a run, or None if it has not begun. Nothing changes on disk.

    Raises:
        ValueError: if a setting changed that its past depends on, or its folder has rows and no checkpoint.
    """
    if not (folder / "config.json").exists():
        return None
    refuse_lost_checkpoints(folder)
    saved = saved_settings(folder)
    # A study may have been moved, or given another name.
    going_on = dataclasses.replace(settings, out=saved.out, name=saved.name, resume=folder)
    going_on = with_episodes_as_begun(going_on, in_native_code=saved.native_episodes)
    refuse_changes(saved, going_on)
    return going_on


def still_finished(settings: Settings, folder: Path) -> bool:
    """Whether a finished cell of a study still is what the study asks for.

    Returns:
        False if its folder is gone, or if more designs are asked for than it has tried.

    Raises:
        ValueError: if it was made with other settings: it would be compared with runs of another protocol.
    """
    if not (folder / "config.json").exists():
        return False
    before = {name: value for name, value in plain(Settings()).items() if name in LATER}
    saved = before | read_config(folder)["settings"]
    settings = with_episodes_as_begun(settings, in_native_code=saved["native_episodes"])
    asked = json.loads(json.dumps(plain(settings)))
    more = asked["num_designs"] > saved["num_designs"]
    fixed = (saved.keys() & asked.keys()) - OF_NO_NUMBER | (set() if more else {"num_designs"})
    # A protocol may have changed in what this arm does not read: the size of a model that a model-free run has not.
    fixed -= without_effect(settings).keys()
    if other := [name for name in sorted(fixed) if saved[name] != asked[name]]:
        told = ", ".join(f"{name} ({saved[name]!r} to {asked[name]!r})" for name in other)
        raise ValueError(
            f"the run in {folder} was made with other settings: {told}; leave them, or take another folder"
        )
    return not more


def with_episodes_as_begun(settings: Settings, *, in_native_code: bool) -> Settings:
    """What a study asks of a cell that was begun when its protocol had no native episodes: the numbers of its past."""
    return dataclasses.replace(settings, native_episodes=settings.native_episodes and in_native_code)


def saved_settings(folder: Path) -> Settings:
    """Read the settings of the run in a folder; those that its version did not have take their defaults.

    Raises:
        ValueError: if the folder holds no run, or a run of a version with other settings.
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
    """Return the settings that differ, each with its old and its new value; ``resume`` is left out."""
    one, other = plain(old), plain(new)
    return {name: [one[name], other[name]] for name in one if one[name] != other[name] and name != "resume"}


def refuse_changes(old: Settings, new: Settings) -> None:
    """Refuse settings that cannot change in the middle of a run.

    Raises:
        ValueError: with their names, old and new values, and the settings that may change.
    """
    idle = without_effect(old).keys() & without_effect(new).keys()
    fixed = {name: values for name, values in changes(old, new).items() if name not in {*FREE, *ELSEWHERE, *idle}}
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
