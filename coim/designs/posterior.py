"""What the bodies built so far say about all others: a Gaussian process over the returns that they earned.

Shapes: ``N`` bodies built, ``P`` candidate designs, ``D`` design entries.

References:
    A. Cully, J. Clune, D. Tarapore and J.-B. Mouret, *Robots that can adapt like animals*, Nature 521, 2015
    (arXiv:1407.3501): the critic's stand-in there, a simulator, is the mean of the process.

    C. E. Rasmussen and C. K. I. Williams, *Gaussian Processes for Machine Learning*, 2006: Sec. 2.2, 2.7 and 5.4.

    N. Srinivas, A. Krause, S. Kakade and M. Seeger, *Gaussian Process Optimization in the Bandit Setting*, 2010
    (arXiv:0912.3995): the upper confidence bound.

    M. Balandat et al., *BoTorch: A Framework for Efficient Monte-Carlo Bayesian Optimization*, 2020 (arXiv:1910.06403).
"""

from __future__ import annotations

import math
import warnings
from typing import Any, cast

import torch
from torch import Tensor, nn
from torchrl.data import Bounded

from .bounds import bounds_for, bounds_of, in_unit_cube
from .search import Fitness, evaluate

try:
    with warnings.catch_warnings():
        # linear_operator compiles a function by torch.jit.script when it is imported.
        warnings.filterwarnings("ignore", message=r"`torch\.jit\.\w+` is deprecated", category=DeprecationWarning)
        import botorch.settings
        from botorch.exceptions.warnings import OptimizationWarning
        from botorch.models import SingleTaskGP
        from botorch.optim.fit import fit_gpytorch_mll_scipy
        from botorch.posteriors.gpytorch import GPyTorchPosterior
        from gpytorch.constraints import GreaterThan
        from gpytorch.kernels import RBFKernel, ScaleKernel
        from gpytorch.likelihoods import GaussianLikelihood
        from gpytorch.means import Mean
        from gpytorch.mlls import ExactMarginalLogLikelihood
        from gpytorch.priors import LogNormalPrior, NormalPrior
except ImportError as error:
    raise ImportError(
        "DesignPosterior needs BoTorch, which is optional: pip install 'coim[posterior]'", name=error.name
    ) from error

# Medians of the priors, and the deviation of the logarithm of each. Designs are in the unit cube, returns have
# deviation 1. Few bodies say little about them: the priors decide, and docs/results/choosing.md
# has what others would have gained on simulated studies.
LENGTH = 0.8
SIGNAL = 1.0
NOISE = 0.9
SPREAD = 0.3

ROUNDING = 1e-4  # of the width of the bounds, by which designs that went through a file or a transform may leave them
ROUNDED = 1e-5  # of the largest value of a critic in float32: what differs by less is rounding
LEAST_RETURNS = 3  # with two, every straight line through both is as good as another


class DesignPosterior:
    r"""Return that a body will earn next, by a Gaussian process over the bodies built so far.

    The mean before any data is :math:`a + b\,Q(\xi) + c\,n`: ``prior``, usually Eq. 5, and the order of building n, as
    later bodies earn more whatever they are.  b is at least 0 and fitted to the bodies like a and c, so that a critic
    that does not rank them drops out with a slope of exactly 0.  What this mean misses is smooth in the design, and
    what is left is noise: the same body does not earn the same return again.

    It is a fitness, ``[P, D] -> [P]``: the upper confidence bound of the body's own part of the return, without noise,
    differentiable in the designs if ``prior`` is.  Any :class:`~coim.designs.DesignSearch` maximises it.

    Args:
        spec: bounds of one design, ``[D]``, as ``env.design_spec``.
        designs: built so far in the order of building, ``[N, D]``.
        returns: the best return of each, ``[N]``; a NaN marks one that has none and is left out.
        prior: fitness ``[P, D] -> [P]`` that may know which bodies are good, as :class:`~coim.DesignValue`.  None:
            plain Bayesian optimisation of returns.  It is asked whenever a design is: once its networks have learnt on,
            a posterior that was fitted before is no longer right, and a new one is due.
        optimism: deviations that the upper confidence bound lies above the mean, at least 0.

    Attributes:
        model: the fitted ``botorch.models.SingleTaskGP``, in float64 on the CPU, for BoTorch's own acquisition
            functions.  It reads :meth:`inputs` and tells returns minus their mean, over their deviation.

    Raises:
        ImportError: when the module is imported and BoTorch is not installed.
        ValueError: if designs and returns do not belong together, a design is not finite or beyond the bounds, fewer
            than three returns are finite or all of these are equal, ``prior`` gives values that are not finite, or
            ``optimism`` is negative.

    Note:
        Nothing is drawn: the same data give the same bits on the same machine.  Length scale, signal, noise, a, b and
        c are those of highest posterior density, found by L-BFGS-B from the medians of their priors.  If it ends
        early, as it does when no step improves the last bits, the best that it met counts.  The deviation does not
        hold how uncertain these six are; slope and trend are drawn towards 0 while bodies are few.

    Example:
        >>> spec = Bounded(low=0.8, high=2.0, shape=(1,))
        >>> designs = torch.tensor([[0.8], [1.2], [1.6], [2.0]])
        >>> posterior = DesignPosterior(spec, designs, torch.tensor([100.0, 400.0, 500.0, 300.0]))
        >>> mean, deviation = posterior.predict(torch.tensor([[0.8], [1.5]]))
        >>> bool(mean[0] < mean[1]), bool((deviation > posterior.noise).all())
        (True, True)
        >>> posterior(torch.tensor([[0.8], [1.5]])).shape
        torch.Size([2])
    """

    def __init__(
        self,
        spec: Bounded,
        designs: Tensor,
        returns: Tensor,
        *,
        prior: Fitness | None = None,
        optimism: float = 0.5,
    ) -> None:
        if not 0 <= optimism < math.inf:
            raise ValueError(f"optimism is {optimism}, it must be 0 or more: deviations above the mean")
        self._low, self._high = bounds_of(spec)
        _check(designs, returns, self._low, self._high)
        self.prior, self.optimism = prior, optimism
        self._num_built = len(returns)
        known = returns.isfinite()
        targets = returns[known].detach().to("cpu", torch.float64)
        self._mean, self._scale = targets.mean(), targets.std()
        with torch.no_grad():
            values = self._values(designs[known])
            spread = values.std()
            # Divided by infinity, a prior that is the same everywhere, but for rounding, has no slope.
            ranks = spread > ROUNDED * values.abs().max()
            self._value_mean, self._value_scale = values.mean(), torch.where(ranks, spread, torch.inf)
            order = known.nonzero().to("cpu", torch.float64) / self._num_built
            inputs = self._inputs(designs[known], values, order)
        self.model = _fitted(inputs, (targets - self._mean) / self._scale)
        self._prior_mean: _PriorMean = self.model.mean_module

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickle and deepcopy: gpytorch's priors cannot be pickled, so a copy has its own."""
        state = {key: value for key, value in vars(self).items() if key not in ("model", "_prior_mean")}
        return state | {"process": (self.model.train_inputs[0], self.model.train_targets, self.model.state_dict())}

    def __setstate__(self, state: dict[str, Any]) -> None:
        inputs, targets, weights = state.pop("process")
        vars(self).update(state)
        self.model = _process(inputs, targets)
        self.model.load_state_dict(weights)
        self.model.requires_grad_(False).eval()
        self._prior_mean = self.model.mean_module

    def __call__(self, designs: Tensor) -> Tensor:
        """Upper confidence bound of the return of candidates ``[P, D]``, if built next: ``[P]``."""
        mean, variance = self._posterior(designs)
        return (mean + self.optimism * variance.sqrt()).to(designs)

    @torch.no_grad()
    def predict(self, designs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and the deviation, noise included, of the return of designs ``[P, D]``: two of ``[P]``."""
        mean, variance = self._posterior(designs)
        return mean.to(designs), (variance + self.noise**2).sqrt().to(designs)

    @torch.no_grad()
    def difference(self, designs: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
        """Return how much more designs ``[P, D]`` earn than others ``[P, D]``: mean and deviation, ``[P]`` each.

        It is the difference of the bodies' own parts of the return, without noise. Neighbours are known together: its
        deviation is far less than that of either body.
        """
        pairs = torch.stack([self.inputs(designs), self.inputs(others)], -2)  # [P, 2, D + 2]
        found = cast(GPyTorchPosterior, self.model.posterior(pairs))  # as it has no transform of its outcome
        mean, covariance = found.mean.squeeze(-1), found.distribution.covariance_matrix
        weights = mean.new_tensor([1.0, -1.0])
        variance = (weights @ covariance @ weights).clamp(min=0)  # rounding can take it below 0
        return (self._scale * (mean @ weights)).to(designs), (self._scale * variance.sqrt()).to(designs)

    def inputs(self, designs: Tensor) -> Tensor:
        """What the model reads of designs ``[P, D]`` that would be built next: ``[P, D + 2]``, differentiable.

        The design in the unit cube; the order of building, from 0 to 1; the prior's value, standardised.
        """
        if designs.dim() != 2:
            raise ValueError(
                f"designs of shape {list(designs.shape)} must be [P, {len(self._low)}]; a single one is design[None]"
            )
        order = torch.ones(len(designs), 1, dtype=torch.float64, device="cpu")
        return self._inputs(designs, self._values(designs), order)

    @property
    def slope(self) -> float:
        """b: return for each unit of the prior's value; exactly 0 if it does not rank the bodies."""
        return float(self._prior_mean.slope * self._scale / self._value_scale)

    @property
    def trend(self) -> float:
        """c: return that each further body adds, whatever it is."""
        return float(self._prior_mean.trend * self._scale / self._num_built)

    @property
    def noise(self) -> float:
        """Deviation of the return of one body from run to run."""
        return float(self.model.likelihood.noise.sqrt() * self._scale)

    def _posterior(self, designs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the return without noise, each ``[P]``, float64 on the CPU."""
        found = self.model.posterior(self.inputs(designs).unsqueeze(-2))  # [P, 1, D + 2]: each on its own
        # Rounding can take the variance below 0, where the root has no gradient.
        variance = found.variance.clamp(min=1e-12)
        mean, variance = (part.squeeze(-1).squeeze(-1) for part in (found.mean, variance))
        return self._mean + self._scale * mean, self._scale**2 * variance

    def _values(self, designs: Tensor) -> Tensor:
        """The prior's values ``[P, 1]``; 0 without one."""
        if self.prior is None:
            return torch.zeros(len(designs), 1, dtype=torch.float64, device="cpu")
        values = evaluate(self.prior, designs)
        # Without this, a search would climb what the bodies add to the prior, and not the prior.
        if (
            torch.is_grad_enabled()
            and designs.requires_grad
            and not values.requires_grad
            and self._value_scale.isfinite()
        ):
            raise ValueError(
                "the prior is not differentiable in the designs (was it computed under torch.no_grad, or in numpy?); a "
                "search without gradients, such as ParticleSwarm, takes it"
            )
        return values.to("cpu", torch.float64).unsqueeze(-1)

    def _inputs(self, designs: Tensor, values: Tensor, order: Tensor) -> Tensor:
        low, high = bounds_for(designs, self._low, self._high)
        place = in_unit_cube(designs, low, high).to("cpu", torch.float64)
        return torch.cat([place, order, (values - self._value_mean) / self._value_scale], -1)


class _PriorMean(Mean):
    """a + b * Q + c * n of inputs ``[*B, D + 2]``, whose last two entries are n and Q: ``[*B]``."""

    def __init__(self) -> None:
        super().__init__()
        for name in ("intercept", "slope", "trend"):
            self.register_parameter(name, nn.Parameter(torch.zeros(())))
            self.register_prior(f"{name}_prior", NormalPrior(0.0, 1.0), name)
        # Without a transform the bound itself is in reach, where a softplus would only come close.
        self.register_constraint("slope", GreaterThan(0.0, transform=None))

    def forward(self, inputs: Tensor) -> Tensor:
        order, value = inputs[..., -2], inputs[..., -1]
        return self.intercept + self.slope * value + self.trend * order


@torch.inference_mode(False)
@torch.enable_grad()  # the caller may be under no_grad: a whole training is
def _fitted(inputs: Tensor, targets: Tensor) -> SingleTaskGP:
    """The process of highest posterior density for inputs ``[N, D + 2]`` and standardised returns ``[N]``."""
    inputs, targets = inputs.clone(), targets.clone()  # those of an inference mode have no gradients
    model = _process(inputs, targets)
    with torch.device("cpu"), warnings.catch_warnings():
        warnings.simplefilter("ignore", OptimizationWarning)
        fit_gpytorch_mll_scipy(ExactMarginalLogLikelihood(model.likelihood, model))
    return model.requires_grad_(False).eval()


def _process(inputs: Tensor, targets: Tensor) -> SingleTaskGP:
    """The process before it is fitted: the medians of its priors."""

    def positive(median: float) -> GreaterThan:
        return GreaterThan(1e-4, transform=None, initial_value=median)

    def around(median: float) -> LogNormalPrior:
        return LogNormalPrior(math.log(median), SPREAD)

    num_entries = inputs.shape[-1] - 2
    # On the CPU whatever torch's default device is; the last input may leave the unit cube.
    with torch.device("cpu"), botorch.settings.validate_input_scaling(False):
        smooth = RBFKernel(
            active_dims=tuple(range(num_entries)),
            lengthscale_prior=around(LENGTH),
            lengthscale_constraint=positive(LENGTH),
        )
        return SingleTaskGP(
            inputs,
            targets.unsqueeze(-1),
            likelihood=GaussianLikelihood(noise_prior=around(NOISE), noise_constraint=positive(NOISE)),
            covar_module=ScaleKernel(smooth, outputscale_prior=around(SIGNAL), outputscale_constraint=positive(SIGNAL)),
            mean_module=_PriorMean(),
            outcome_transform=None,
        )


def _check(designs: Tensor, returns: Tensor, low: Tensor, high: Tensor) -> None:
    if designs.dim() != 2 or designs.shape[-1] != len(low) or returns.shape != designs.shape[:1]:
        raise ValueError(
            f"designs {list(designs.shape)} and returns {list(returns.shape)} do not belong together; "
            f"pass [N, {len(low)}] and [N]: one row and one return for each body that was built"
        )
    if not designs.isfinite().all():
        raise ValueError(f"design {int((~designs.isfinite()).any(-1).nonzero()[0])} has an entry that is not finite")
    lowest, highest = bounds_for(designs, low, high)
    width = ROUNDING * (highest - lowest).where(highest > lowest, 1)
    beyond = (designs < lowest - width) | (designs > highest + width)
    if beyond.any():
        body, entry = beyond.nonzero()[0].tolist()
        raise ValueError(
            f"design {body} has {designs[body, entry].item():g} as its entry {entry}, which must lie in "
            f"[{low[entry]:g}, {high[entry]:g}]; pass designs as they were built, and the spec of these bodies"
        )
    known = returns[returns.isfinite()]
    if len(known) < LEAST_RETURNS:
        raise ValueError(
            f"{len(known)} of {len(returns)} returns are finite, {LEAST_RETURNS} are needed; "
            "choose bodies at random or by Eq. 5 until there are more"
        )
    if bool((known == known[0]).all()):
        raise ValueError(
            f"all {len(known)} returns are {known[0].item()}, which says nothing about designs; "
            "choose bodies at random or by Eq. 5 until they differ"
        )
