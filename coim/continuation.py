"""What Algorithm 1 must remember to go on as if it had never stopped.

Shapes: K runs, D design.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from tensordict import TensorDict
from torch import Tensor

from coim.design_choice import Trial
from coim.randomness import restore_generator

if TYPE_CHECKING:
    from coim.coadaptation import CoAdaptation


def state_of(algorithm: CoAdaptation) -> dict[str, Any]:
    """All that the coming events depend on, read between two events.

    Args:
        algorithm: which is not running.

    Returns:
        Numbers, strings, tensors and dicts of them, as `torch.load` reads them with ``weights_only``. Tensors are not
        copied: save them or copy them before the next event.

    Note:
        Torch's, numpy's and Python's global generators are not in it. Nothing here draws from them, but a foreign
        policy or search may. A search without ``state_dict`` is taken to have no state.

    Example:
        >>> state = state_of(algorithm)  # doctest: +SKIP
        >>> sorted(state["buffers"])  # doctest: +SKIP
        ['art', 'ind', 'pop', 's0']
    """
    return {
        "position": {
            "index": algorithm.index,
            "env_steps": algorithm.env_steps,
            "trial": None if algorithm.trial is None else dict(vars(algorithm.trial)),
            "diverged": dict(algorithm.divergence.places),
        },
        "rngs": {name: rng.get_state() for name, rng in algorithm.rngs.items()},
        "env": algorithm.env.get_simulation_state().to_dict(),
        "evaluation_env": algorithm.evaluation_env.get_simulation_state().to_dict(),
        "population": algorithm.population.state_dict(),
        "individual": algorithm.individual.state_dict(),
        "dynamics": None if algorithm.dynamics is None else algorithm.dynamics.state_dict(),
        "imagined": None if algorithm.imagined is None else algorithm.imagined.state_dict(),
        "dream": None if algorithm.dream is None else algorithm.dream.rng.get_state(),
        "search": _if_any(algorithm.search, "state_dict"),
        "buffers": algorithm.buffers.state_dict(),
    }


def restore(algorithm: CoAdaptation, state: Mapping[str, Any]) -> None:
    """Let an algorithm go on, event by event and bit by bit, as the one whose state was taken.

    Args:
        algorithm: made of the same parts with the same settings; only ``num_designs`` may differ, and how many threads
            there are.
        state: of `state_of`; left as it is, and nothing of it is shared.

    Raises:
        ValueError: if the two do not have the same parts or the same sizes.
    """
    for part in ("dynamics", "dream"):
        if (state[part] is None) != (getattr(algorithm, part) is None):
            raise ValueError(f"one of the state and the algorithm has a {part} and the other has none; make it alike")
    # Runs that were begun before impossible pairs were counted go on with the columns that their tables have.
    imagined = state.get("imagined") or {"counts": False, "governor": None}
    if (imagined["governor"] is None) != (algorithm.governor is None):
        raise ValueError("one of the state and the algorithm is governed and the other is not; make it alike")
    algorithm.buffers.check_state(state["buffers"])
    algorithm.population.load_state_dict(state["population"])
    algorithm.individual.load_state_dict(state["individual"])
    if algorithm.dynamics is not None:
        algorithm.dynamics.load_state_dict(state["dynamics"])
    if algorithm.dream is not None:
        restore_generator(algorithm.dream.rng, state["dream"])
    if algorithm.imagined is not None:
        algorithm.imagined.load_state_dict(imagined)
    for name in ("env", "evaluation_env"):
        env = getattr(algorithm, name)
        env.set_simulation_state(TensorDict(state[name], state[name]["design"].shape[:1]))
    for name, rng in algorithm.rngs.items():
        restore_generator(rng, state["rngs"][name])
    if state["search"] is not None:
        _if_any(algorithm.search, "load_state_dict", state["search"])
    algorithm.buffers.load_state_dict(state["buffers"])
    position = state["position"]
    algorithm.index, algorithm.env_steps = position["index"], position["env_steps"]
    algorithm.divergence.places = dict(position["diverged"])
    algorithm.trial = None if position["trial"] is None else _trial(position["trial"], algorithm)


def _trial(saved: Mapping[str, Any], algorithm: CoAdaptation) -> Trial:
    """A trial of its own, the design on the bodies' device."""
    own: dict[str, Any] = {name: value.clone() if isinstance(value, Tensor) else value for name, value in saved.items()}
    return Trial(**{**own, "design": own["design"].to(algorithm.env.device)})


def _if_any(owner: object, method: str, *args: Any) -> Any:
    """Call a method that not every search has."""
    found = getattr(owner, method, None)
    return None if found is None else found(*args)
