"""Settings that change nothing beside others, to be refused where somebody has written them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coim.experiments.run.settings import Settings

SWARM = ("num_particles", "num_iterations", "swarm_bounds")
MODEL = ("num_members", "model_cells", "model_lr", "weight_decay", "predict", "model_updates")
ROWS = ("mix", "imagined_states", "imagined_actions", "anchored", "governed")
IMAGINATION = ("dream", "sigma", "imagined_share", "individual_imagined_share", *ROWS, *MODEL)
# What has no effect, when, and the setting that decides it.
RULES: tuple[tuple[tuple[str, ...], Callable[[Settings], bool], str], ...] = (
    (
        ("search", "chosen_by", "reach", "widening", *SWARM),
        lambda settings: settings.bodies != "search",
        "bodies",
    ),
    (SWARM, lambda settings: settings.search == "gradient", "search"),
    (IMAGINATION, lambda settings: settings.imagine == "none", "imagine"),
    (("sigma",), lambda settings: settings.imagine != "noisy", "imagine"),
    (MODEL, lambda settings: settings.dream == "simulator", "dream"),
    (
        ("sigma", *ROWS),
        lambda settings: not (settings.imagined_share or settings.individual_imagined_share),
        "imagined_share",
    ),
    (("name",), lambda settings: settings.out is not None, "out"),
)


def without_effect(settings: Settings, *, called: Callable[[str], str] = str) -> dict[str, str]:
    """Settings that change nothing in this run, each with a sentence that says why.

    Args:
        settings: of the run.
        called: from a setting's name to what it is called where somebody wrote it.

    Example:
        >>> from coim.experiments.run.settings import Settings
        >>> without_effect(Settings(search="gradient", imagine="noisy"))["num_particles"]
        'num_particles has no effect with search gradient; leave it out'
    """
    found: dict[str, str] = {}
    for names, applies, by in RULES:
        if applies(settings):
            for name in names:
                sentence = f"{called(name)} has no effect with {called(by)} {getattr(settings, by)}; leave it out"
                found.setdefault(name, sentence)
    return found


def refuse_without_effect(
    settings: Settings, given: Collection[str], *, called: Callable[[str], str] = str, read: Collection[str] = ()
) -> None:
    """Refuse what somebody has written and what would change nothing: it was meant to.

    Args:
        settings: of a run.
        given: names of the settings that were written, as opposed to defaults.
        called: as for `without_effect`.
        read: names that the caller reads for purposes of its own.

    Raises:
        ValueError: on the first one.
    """
    for name, sentence in without_effect(settings, called=called).items():
        if name in given and name not in read:
            raise ValueError(sentence)
