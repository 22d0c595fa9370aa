"""The learned dynamics as an environment: the dream.

Shapes: ``*B`` any batch, ``S`` state, ``A`` action, ``D`` design.

References:
    Co-Imagination of Behaviour and Morphology of Agents: Eq. 6 and 7 (h), Sec. 3 (the reward function is given).

    K. Chua et al., *Deep reinforcement learning in a handful of trials using probabilistic dynamics models*, NeurIPS
    2018 (TS1: a member of the ensemble is drawn at each time step).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, Self, runtime_checkable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from coim.angles import wrap_angle
from coim.envs.designed_env import DesignedEnv, check_reset, check_reward, check_step, idle_rows, leave_idle
from coim.randomness import restore_generator

STATE_KEYS = ("observation", "design")
ROUNDING = 1e-6  # of the length of a unit quaternion in float32


class Dynamics(Protocol):
    """A model of the dynamics for :class:`WorldModelEnv`, such as :class:`coim.GaussianEnsemble`."""

    def sample(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Draw next observations ``[*B, S]``: h(s, a, xi) of Eq. 7."""


@runtime_checkable
class AnchoredDynamics(Dynamics, Protocol):
    """A model that can also compare several states, actions and designs, for `WorldModelEnv.advance_beside`."""

    def means(
        self, *asked: tuple[Tensor, Tensor, Tensor], generator: torch.Generator | None = None
    ) -> tuple[Tensor, ...]:
        """Return mean next observations ``[*B, S]`` of several (observation, action, design), by the same member."""


class WorldModelEnv(DesignedEnv):
    """A learned transition model over (observation, action, design) as an environment; not TorchRL's ``WorldModelEnv``.

    A step gets the next observation from the model, and the reward from the real environment's reward function. The
    design stays. No row is terminated or truncated, as in the real episodes (Sec. 6.1). For a horizon, use TorchRL's
    ``StepCounter``, or the ``max_steps`` of a rollout.

    A reset takes the start states from its input, ``{"observation": [*B, S], "design": [*B, D]}``. Without them, it
    takes those of the last reset that had some. Before that, it draws standard-normal observations and uniform designs,
    which are useful only to check specs.

    ``dream.step(td)`` steps the states of its input. Inside of a transform, the dream steps its own states, without the
    transform, as the bodies do; it then refuses a ``design`` in the input that is not its own.

    Args:
        ensemble: the model; its ``sample`` returns next observations.
        env: the real environment, without transforms (put them around the dream). It gives the specs, ``design_spec``
            and ``reward_fn``, and is not stepped.
        batch_size: batch size of the dream, ``[*B]``. It may differ from that of ``env``; for a fleet of models, the
            last dimension is the run axis.
        seed: seed of the dream's random numbers (TS1, noise, drawn starts); None draws one from torch.

    Attributes:
        rng: the dream's generator; its state is all that a dream keeps from one call of `advance` to the next.
        clearance: see :meth:`~coim.envs.morph.MorphEnv.clearance`; None if the bodies of ``env`` have none.
        transfer: see :meth:`~coim.envs.morph.MorphEnv.transfer`; None if the bodies of ``env`` have none.

    Raises:
        TypeError: if ``env`` is a TransformedEnv, or is not a body, such as a `SerialEnv`.
        ValueError: if a start state has an entry that is not finite, or a design that leaves the bounds, or if the
            reward of ``env`` is not ``[*B, 1]``.

    Example:
        >>> from coim import GaussianEnsemble, HopperMorph
        >>> env = HopperMorph(seed=0)
        >>> dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(32,)), env, batch_size=[256], seed=0)
        >>> start = TensorDict({"observation": torch.zeros(256, 11), "design": torch.ones(256, 4)}, [256])
        >>> dream.rollout(5, auto_reset=False, tensordict=dream.reset(start))["next", "reward"].shape
        torch.Size([256, 5, 1])
    """

    def __init__(self, ensemble: Dynamics, env: EnvBase, *, batch_size: Sequence[int], seed: int | None = None) -> None:
        if isinstance(env, TransformedEnv):
            raise TypeError(
                "model and reward need the observations of the bodies without transforms: pass env.base_env to the "
                "dream, and put the transforms around it, TransformedEnv(dream, ...)"
            )
        if isinstance(env, BatchedEnvBase) or not (hasattr(env, "reward_fn") and hasattr(env, "design_spec")):
            raise TypeError(
                f"a {type(env).__name__} has no reward_fn and design_spec of its own; pass one of its bodies, "
                "such as a MorphEnv, and give the dream any batch_size"
            )
        super().__init__(device=env.device, batch_size=torch.Size(batch_size))
        self.ensemble = ensemble
        self.reward_fn = env.reward_fn
        self.design_spec: Bounded = env.design_spec
        self.observation_scale: Tensor | None = getattr(env, "observation_scale", None)
        self.angle_indices: tuple[int, ...] = getattr(env, "angle_indices", ())
        self.quaternion_index: int | None = getattr(env, "quaternion_index", None)
        self.clearance: Callable[..., Tensor] | None = getattr(env, "clearance", None)
        self.transfer: Callable[..., Tensor] | None = getattr(env, "transfer", None)
        self._make_specs(env)
        single = self.full_observation_spec_unbatched
        check_reward(
            self.reward_fn,
            single["observation"].zero(),
            self.full_action_spec_unbatched["action"].zero(),
            self.design_spec.space.low,
            name=type(env).__name__,
        )
        self.rng = torch.Generator(self.device or "cpu")
        self._set_seed(int(torch.randint(2**31, (), device="cpu")) if seed is None else seed)
        self._start = TensorDict({}, self.batch_size, device=self.device)
        self._state: TensorDict | None = None  # the current states, without transforms

    def advance(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Compute one step of the dream on tensors of any batch size; differentiable.

        Args:
            observation: ``[*B, S]``.
            action: ``[*B, A]``, in [-1, 1].
            design: ``[*B, D]``.
            generator: generator of the random numbers; None takes the dream's own.

        Returns:
            Next observation ``[*B, S]`` and reward ``[*B, 1]``.
        """
        rng = self.rng if generator is None else generator
        next_observation = self._oriented(self.ensemble.sample(observation, action, design, generator=rng))
        return next_observation, self.reward_fn(observation, action, next_observation, design)

    def advance_beside(
        self,
        real: TensorDictBase,
        observation: Tensor,
        action: Tensor,
        design: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Compute one step anchored at a real transition: its outcome, plus the difference that the model predicts.

        ``s'_g = s' + h(s_g, a_g, xi_g) - h(s, a, xi)`` for a real transition (s, a, s') of body xi, by the mean of one
        member. Errors that are the same in both predictions cancel (CSE, arXiv:2507.07348).

        Args:
            real: transitions ``[*B]`` with ``observation``, ``action``, ``design`` and ``("next", "observation")``.
            observation: s_g ``[*B, S]``.
            action: a_g ``[*B, A]``, in [-1, 1].
            design: xi_g ``[*B, D]``.
            generator: generator of the random numbers; None takes the dream's own.

        Returns:
            Next observation ``[*B, S]`` with its angles in (-pi, pi] and its quaternion of length 1, and reward
            ``[*B, 1]``. If nothing differs from the real transition, the result is its next observation to the last
            bit.

        Raises:
            TypeError: if the model has no ``means``.
        """
        if not isinstance(self.ensemble, AnchoredDynamics):
            raise TypeError(
                f"a {type(self.ensemble).__name__} has no means() to anchor with; add it as in AnchoredDynamics, or "
                "imagine without anchoring"
            )
        # h is a next observation in raw units, also if the network predicts the change Delta. The difference therefore
        # already has s_g - s, the height by which the root was moved included:
        #   s' + h(s_g, ...) - h(s, ...) = s' + (s_g + Delta_g) - (s + Delta) = s_g + (s' - s) + (Delta_g - Delta).
        # Adding s_g - s again would lift the root twice. If h is exact, h(s, ...) = s', and the result is h(s_g, ...).
        here = tuple(real[key] for key in ("observation", "action", "design"))
        there, expected = self.ensemble.means(
            (observation, action, design), here, generator=self.rng if generator is None else generator
        )
        next_observation = real["next", "observation"] + (there - expected)
        angles = list(self.angle_indices)
        next_observation[..., angles] = wrap_angle(next_observation[..., angles])
        next_observation = self._oriented(next_observation)
        return next_observation, self.reward_fn(observation, action, next_observation, design)

    def _oriented(self, observation: Tensor) -> Tensor:
        """Scale the quaternion of observations ``[*B, S]`` to length 1.

        A model predicts the change of each entry by itself, so that a predicted orientation is none, by a little. Over
        a few steps that would add up.
        """
        if (at := self.quaternion_index) is None:
            return observation
        quaternion = observation[..., at : at + 4]
        length = quaternion.norm(dim=-1, keepdim=True).clamp(min=ROUNDING)
        length = torch.where((length - 1).abs() < ROUNDING, 1.0, length)  # a real one stays, to the last bit
        return torch.cat([observation[..., :at], quaternion / length, observation[..., at + 4 :]], -1)

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Step the ``observation`` and ``design`` of the input; the dream's own ones if they are missing."""
        self._assert_tensordict_shape(tensordict)
        given = self._as_specified(tensordict)
        own = {} if set(STATE_KEYS) <= set(given.keys()) else self._present()
        self._state = TensorDict({**own, **given}, self.batch_size, device=self.device)
        return super().step(tensordict)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, design = (self._present()[key] for key in STATE_KEYS)
        check_step(tensordict.get("design", None), design)
        seen = tensordict.get("observation", None)
        if seen is not None and not seen.requires_grad:  # the input has no gradient: keep no graph
            observation = observation.detach()
        action = tensordict["action"].to(observation.dtype)
        next_observation, reward = self.advance(observation, action, design)
        idle = idle_rows(tensordict, self.batch_size)
        if idle is not None:
            next_observation = torch.where(idle.unsqueeze(-1), observation, next_observation)
        after = TensorDict({"observation": next_observation, "design": design}, self.batch_size, device=self.device)
        self._state = after.clone()  # our own copy: the caller may write to the returned one
        answer = self.full_done_spec.zero().update(after).set("reward", reward)
        if idle is not None:
            leave_idle(answer, tensordict, idle)
        return answer

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        check_reset(tensordict, STATE_KEYS, self.observation_spec["design"].shape)
        everywhere = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        which = everywhere
        if tensordict is not None:
            given = self._as_specified(tensordict)
            which = tensordict.get("_reset", everywhere).reshape(self.batch_size)
            self._check_start(given, which)
            # Rows that are not reset keep their start; EnvBase.reset does not change their state.
            kept = given if which.all() else self._begun().select(*given.keys())
            self._start.update(given.where(which, kept))
        self._start = self._begun()
        self._state = self._start.clone() if which.all() else self._start.where(which, self._present())
        answer = self.full_done_spec.zero().update(self._state.clone())
        if tensordict is not None and "_reset" in tensordict:
            # For rows that are not reset, TorchRL returns the values of the input, and zeros if it has none.
            tensordict.update(self._state.exclude(*tensordict.keys()).clone())
        return answer

    def to(self, device: torch.device | str) -> Self:
        """Move the dream, its model and its generator; another kind of device draws other numbers."""
        super().to(device)
        state, self.rng = self.rng.get_state(), torch.Generator(self.device or "cpu")
        restore_generator(self.rng, state)
        self.design_spec, self._start = self.design_spec.to(device), self._start.to(device)
        self._state = None if self._state is None else self._state.to(device)
        return self

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickle and deepcopy, without the autograd graph of the states."""
        state = super().__getstate__() | {
            "rng": (self.rng.device, self.rng.get_state()),
            "_start": self._start.detach(),
        }
        return state | {"_state": None if self._state is None else self._state.detach()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        device, generator_state = state.pop("rng")
        super().__setstate__(state)
        self.rng = torch.Generator(device)
        restore_generator(self.rng, generator_state)

    def _as_specified(self, given: TensorDictBase) -> TensorDict:
        """Return the states that a tensordict has, in the dtypes of the specs; differentiable."""
        states = given.select(*STATE_KEYS, strict=False).items()
        return TensorDict({key: state.to(self.observation_spec[key].dtype) for key, state in states}, self.batch_size)

    def _present(self) -> TensorDict:
        """Return the current states of the rows; before any reset, their starts."""
        if self._state is None:
            self._state = self._begun().clone()
        return self._state

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.rng.manual_seed(seed)

    def _make_specs(self, env: EnvBase) -> None:
        """Copy the real environment's specs, with the dream's batch size."""
        single = env.full_observation_spec_unbatched
        observed = Composite({key: single[key] for key in ("observation", "design")})
        self.observation_spec = observed.expand(*self.batch_size)
        # Both must also be in the state spec: otherwise transforms and rollouts do not pass them to reset and step.
        self.state_spec = observed.clone().expand(*self.batch_size)
        self.action_spec = env.full_action_spec_unbatched.expand(*self.batch_size)
        self.reward_spec = env.full_reward_spec_unbatched.expand(*self.batch_size)
        self.done_spec = env.full_done_spec_unbatched.expand(*self.batch_size)

    def _begun(self) -> TensorDict:
        """Return the starts of all rows: the last ones given, or drawn ones if none were given."""
        if len(self._start.keys()) == 2:
            return self._start
        low, high = self.design_spec.space.low, self.design_spec.space.high
        observation = self.observation_spec["observation"].zero()
        design = self.observation_spec["design"].zero()
        uniform = torch.rand(design.shape, generator=self.rng, device=design.device, dtype=design.dtype)
        start = {"observation": observation.normal_(generator=self.rng), "design": low + (high - low) * uniform}
        return TensorDict(start, self.batch_size, device=self.device).update(self._start)

    def _check_start(self, start: TensorDictBase, which: Tensor) -> None:
        """Refuse starts of a wrong shape, not finite, or with a design out of bounds, in the rows to reset."""
        for key, value in start.items():
            if value.shape != self.observation_spec[key].shape:
                raise ValueError(
                    f"start {key} has shape {list(value.shape)}, not {list(self.observation_spec[key].shape)}"
                )
            if (strange := value[which & ~value.isfinite().all(-1)]).numel():
                raise ValueError(f"start {key} holds {strange[~strange.isfinite()][0].item()}; give finite numbers")
        if (design := start.get("design", None)) is None:
            return
        low, high = self.design_spec.space.low, self.design_spec.space.high
        outside = which & ((design < low) | (design > high)).any(-1)
        if outside.any():
            raise ValueError(
                f"design {design[outside][0].tolist()} leaves [{low.tolist()}, {high.tolist()}]; project it with "
                "design_spec.project() to clip it"
            )
