"""How much the next state changes with the body: predicted, and by the simulator, over a plane of the design space.

Shapes: N designs, P points, E members, S observation, D design, A action.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Sec. 6.5 and Fig. 4(b).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coim.experiments.model_error.errors import Model
from coim.experiments.model_error.placed_simulator import PlacedSimulator
from coim.tables import design_columns

SIDE = 41  # points along each of the two directions
AREA = 0.05  # of the square that two entries of a design span: of less, a picture shows next to nothing


def principal_directions(designs: Tensor) -> tuple[Tensor, Tensor]:
    """The two orthogonal directions in which designs vary most.

    Args:
        designs: ``[N, D]``.

    Returns:
        Unit vectors ``[2, D]``, the largest entry of each positive, and their shares of the variance ``[2]``.

    Raises:
        ValueError: if the designs do not span a plane.

    Example:
        >>> principal_directions(torch.tensor([[1.0, 0.0, 5.0], [-1.0, 0.0, 5.0], [0.0, 0.5, 5.0], [0.0, -0.5, 5.0]]))
        (tensor([[1., 0., 0.],
                [0., 1., 0.]]), tensor([0.8000, 0.2000]))
    """
    centred = designs.double() - designs.double().mean(0)
    _, sizes, directions = torch.linalg.svd(centred, full_matrices=False)
    if len(sizes) < 2 or sizes[1] < 1e-6:
        raise ValueError(f"designs on one line, {len(designs)} in all, have no second component; try three or more")
    largest = directions[:2].gather(1, directions[:2].abs().argmax(1, keepdim=True))
    # + 0.0 turns a negative zero into a zero.
    return (directions[:2] * largest.sign() + 0.0).float(), (sizes.square() / sizes.square().sum())[:2].float()


def plane(origin: Tensor, directions: Tensor, bounds: tuple[Tensor, Tensor], *, side: int = SIDE) -> Tensor:
    """A grid of coordinates over the part of a plane in which designs are within their bounds.

    Args:
        origin: a design of the plane, ``[D]``.
        directions: two unit vectors, ``[2, D]``.
        bounds: lowest and highest design, ``[D]`` each.
        side: points along each direction.

    Returns:
        ``[side**2, 2]`` coordinates; those of designs that leave the bounds are among them.
    """
    corners = torch.tensor(list(itertools.product(*zip(*(bound.tolist() for bound in bounds)))))
    reach = (corners - origin) @ directions.T
    inside = reach.new_zeros(1, 2)
    for _ in range(2):  # first in all of the box's shadow, then in that of the plane's own part
        axes = [torch.linspace(float(low), float(high), side) for low, high in zip(reach.amin(0), reach.amax(0))]
        grid = torch.cartesian_prod(*axes)
        inside = torch.cat([inside, grid[within(origin + grid @ directions, bounds)]])
        reach = inside
    return grid


def with_area(designs: Tensor, directions: Tensor, bounds: tuple[Tensor, Tensor]) -> Tensor:
    """Designs through which enough of the plane can be built to be looked at.

    Through a corner of the bounds a plane may go that meets them nowhere else: nothing but the corner can be built.

    Args:
        designs: ``[N, D]``.
        directions: two unit vectors, ``[2, D]``.
        bounds: lowest and highest design, ``[D]`` each.

    Returns:
        Whether the part within the bounds is at least `AREA` of the bounds' mean width squared, ``[N]`` bool.

    Example:
        >>> askew = torch.tensor([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]]) / 2**0.5
        >>> with_area(torch.tensor([[1.0] * 4, [2.0] * 4]), askew, (torch.full((4,), 0.5), torch.full((4,), 2.0)))
        tensor([ True, False])
    """
    different, of_design = designs.unique(dim=0, return_inverse=True)
    areas = []
    for origin in different:
        grid = plane(origin, directions, bounds)
        share = within(origin + grid @ directions, bounds).float().mean()
        areas.append(share * (grid.amax(0) - grid.amin(0)).prod())
    return (torch.stack(areas) >= AREA * (bounds[1] - bounds[0]).mean() ** 2)[of_design]


def within(designs: Tensor, bounds: tuple[Tensor, Tensor]) -> Tensor:
    """Which of ``[P, D]`` designs can be built."""
    return ((designs >= bounds[0]) & (designs <= bounds[1])).all(-1)


@torch.no_grad()
def predicted_change(model: Model, row: TensorDictBase, designs: Tensor) -> Tensor:
    """h(s, a, xi_new) - h(s, a, xi) of the mean over members, ``[P, S]``.

    Args:
        model: of one run.
        row: one transition, batch size ``[]``.
        designs: xi_new, ``[P, D]``.
    """
    every = torch.cat([row["design"].unsqueeze(0), designs])
    observation, action = (row[key].expand(len(every), -1) for key in ("observation", "action"))
    means, _ = model.moments(observation, action, every)
    return model.wrapped(means[1:] - means[:1]).mean(-2)


def true_change(
    simulator: PlacedSimulator, model: Model, row: TensorDictBase, designs: Tensor
) -> tuple[Tensor, Tensor]:
    """The same from the simulator, ``[P, S]``, NaN where it breaks; and how deep the state is in the floor, ``[P]``."""
    every = torch.cat([row["design"].unsqueeze(0), designs])
    observation, action = (row[key].expand(len(every), -1) for key in ("observation", "action"))
    truth = simulator.step(observation, action, every)
    change = model.wrapped(truth.next_observation[1:] - truth.next_observation[:1])
    broken = truth.broken[1:] | truth.broken[0]
    return change.masked_fill(broken[:, None], torch.nan), truth.depth[1:]


def design_space(
    models: Mapping[str, Model],
    simulator: PlacedSimulator,
    rows: TensorDictBase,
    tried: Tensor,
    variance: Tensor,
    bounds: tuple[Tensor, Tensor],
    *,
    side: int = SIDE,
) -> list[dict[str, object]]:
    """Squared changes of the next state of some transitions, over the plane through each one's own design.

    The plane is spanned by the principal components of the designs tried and goes through the transition's own design
    rather than through their mean, so that the change vanishes where the circle is.

    Args:
        models: by what they predict.
        simulator: the truth.
        rows: transitions, ``[N]``.
        tried: all designs of the run, ``[N, D]``.
        variance: of one-step changes, ``[S]``.
        bounds: lowest and highest design, ``[D]`` each.
        side: points along each direction of the grid.

    Returns:
        A row per state and point of the grid that can be built, and per design tried, which is off the plane: its
        coordinates are those of its projection. ``change/NAME`` is the sum of squares, as the paper has it;
        ``normalised/NAME`` their mean in units of ``variance``.

    Raises:
        ValueError: if there are too few designs for two components.
    """
    directions, shares = principal_directions(tried)
    names = design_columns(type(simulator.env).design_names())
    found: list[dict[str, object]] = []
    for state, row in enumerate(rows.unbind(0)):
        origin = row["design"]
        grid = plane(origin, directions, bounds, side=side)
        grid = grid[within(origin + grid @ directions, bounds)]
        coordinates = torch.cat([grid, (tried - origin) @ directions.T])
        designs = torch.cat([origin + grid @ directions, tried])
        changes = {name: predicted_change(model, row, designs) for name, model in models.items()}
        changes["simulator"], depth = true_change(simulator, next(iter(models.values())), row, designs)
        columns = {name: xi.tolist() for name, xi in zip(names, designs.unbind(1))}
        for name, change in changes.items():
            columns[f"change/{name}"] = change.square().sum(-1).tolist()
            columns[f"normalised/{name}"] = (change.square() / variance).mean(-1).tolist()
        columns["depth"] = depth.tolist()
        kinds = ["grid"] * len(grid) + ["tried"] * len(tried)
        for kind, place, *values in zip(kinds, coordinates.tolist(), *columns.values()):
            about = {"state": state + 1, "point": kind, "pc_1": place[0], "pc_2": place[1]}
            found.append(about | dict(zip(columns, values)) | dict(zip(("share_1", "share_2"), shares.tolist())))
    return found
