"""How the runs of a study were made: revisions of the code, and settings in which runs differ that are compared."""

from __future__ import annotations

from collections import Counter, defaultdict
from pathlib import Path

from coim.experiments.run.resume import LATER, OF_NO_NUMBER
from coim.experiments.run.settings import Settings, plain
from coim.experiments.study.arms import ARMS
from coim.experiments.study.runs import parts_of
from coim.run_folder import read_config

OF_NO_ARM = OF_NO_NUMBER | {"seed", "num_runs", "num_designs"}  # different lengths are told with the runs


def made_by(study: Path) -> str:
    """A sentence on the revision of the code that made the runs, or on all of them if there are several.

    Example:
        >>> made_by(Path("docs/results/preview"))  # doctest: +SKIP
        'All runs were made at revision 9d69483.'
    """
    revisions = Counter(" and ".join(sorted(revisions_of(path.parent))) for path in study.glob("cells/*/config.json"))
    if len(revisions) < 2:
        return f"All runs were made at revision {next(iter(revisions), 'unknown')}."
    told = ", ".join(f"{count} at {revision}" for revision, count in sorted(revisions.items()))
    return f"**Runs of different revisions are compared: {told}.** `CHANGELOG.md` says what moved results between them."


def revisions_of(folder: Path) -> set[str]:
    """Revisions of the code that began a run and of those that went on with it, where they are noted."""
    config = read_config(folder)
    noted = [config.get("revision"), *(entry.get("revision", "") for entry in config.get("resumed", []))]
    return {_shortened(revision) for revision in noted if revision != ""}


def _shortened(revision: str | None) -> str:
    """Twelve digits of a revision, and whether its files had been changed.

    Example:
        >>> _shortened("9d69483f0c1a22b0-dirty"), _shortened(None)
        ('9d69483f0c1a-dirty', 'unknown')
    """
    if revision is None:
        return "unknown"
    return revision[:12] + "-dirty" * revision.endswith("-dirty")


def made_otherwise(study: Path) -> list[str]:
    """Lines on the settings in which runs differ that are compared, beyond what their arms are about.

    `coim study` refuses them, but cells of several studies may be put together.
    """
    formerly = {name: value for name, value in plain(Settings()).items() if name in LATER}
    cells = {
        path.parent.name: formerly | read_config(path.parent)["settings"] for path in study.glob("cells/*/config.json")
    }
    arms = {parts_of(name)[2] for name in cells}
    of_arms = {setting for arm in arms if arm in ARMS for setting in ARMS[arm].settings}
    values: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for name, settings in sorted(cells.items()):
        environment, task, arm, _ = parts_of(name)
        for setting in sorted(settings.keys() - OF_NO_ARM):
            whose = f"{environment}, {task}" + f", {arm}" * (setting in of_arms)
            values[whose, setting][str(settings[setting])] += 1
    told = [
        f"`{setting}` of {whose} ({', '.join(f'{value} in {count}' for value, count in found.items())})"
        for (whose, setting), found in sorted(values.items())
        if len(found) > 1
    ]
    return [f"**Runs with different settings are compared: {'; '.join(told)}.**", ""] if told else []
