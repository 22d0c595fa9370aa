"""A body's MJCF text whose lengths are functions of the design, to build it where there is no Python.

Shapes: D design, N designs, n slots of the text.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from coim.envs.fleet import Fleet
from coim.envs.root import FLOOR, find_height
from coim.envs.simulation import start_clearance

EXACT = 1e-9  # m; a larger error is none of rounding
CHECKED = 8  # random designs, and corners of the bounds, on which the text is checked
DIGITS = 12  # after the point: what a fit leaves behind them is rounding
# Attributes of the file that a design may change. The drawn value stays where none does.
SHAPED = ("pos", "size", "fromto")
CHANGING = {"body": ("pos",), "geom": SHAPED, "site": SHAPED, "joint": ("pos", "ref")}


@dataclass(frozen=True, eq=False)
class WrittenBody:
    """The MJCF file of a body with slots for its numbers.

    A slot has the number ``constant + slopes @ design + share * start``, where ``start`` is the height at which the
    root starts. This height need not be affine in the design, such as over the longer of two legs; the body's
    clearance in its start pose is. So a body is built twice: with a start of 0, to measure its lowest point, and then
    with the right one.

    Attributes:
        texts: text before, between and behind the slots, ``n + 1``.
        slots: constant, slopes and share of the start of each slot, ``[n, D + 2]``, in the units of the file.
        clearance: constant and slopes of the lowest point's height in the start pose with all joints within their
            ranges, in m, ``[D + 1]``; None if no slot has a share of the start.
    """

    texts: tuple[str, ...]
    slots: np.ndarray
    clearance: np.ndarray | None

    def text(self, design: np.ndarray) -> str:
        """Return the MJCF text of a design ``[D]``."""
        start = 0.0
        if self.clearance is not None:
            flat = mujoco.MjModel.from_xml_string(self._filled(design, start))
            start = float(self.clearance @ np.concatenate([[1.0], design])) - start_clearance(flat)
        return self._filled(design, start)

    def _filled(self, design: np.ndarray, start: float) -> str:
        numbers = self.slots @ np.concatenate([[1.0], design, [start]])
        return "".join(part for pair in zip(self.texts, [*map(_number, numbers), ""]) for part in pair)


def written_body(env: Fleet) -> WrittenBody:
    """Write the body of an environment as text with slots.

    Args:
        env: any body whose lengths are affine in its design.

    Returns:
        The text. Compiled, it is the body that the environment simulates: every number of the model is compared on 8
        random designs and on 8 corners of the bounds.

    Raises:
        ValueError: if the file cannot be read by itself, or the text does not give the same body.

    Example:
        >>> from coim.envs import HopperMorph
        >>> body = written_body(HopperMorph(seed=0))
        >>> model = mujoco.MjModel.from_xml_string(body.text(np.array([1.0, 2.0, 1.0, 1.0])))
        >>> model.geom("thigh").size.round(3).tolist()  # half of a thigh of 0.9 m
        [0.05, 0.45, 0.0]
    """
    tree = _file_of(env)
    designs = _designs(env)
    specs = [env.simulations.body(design) for design in designs]
    models = [spec.compile() for spec in specs]
    drawn = env.simulations.body(np.ones(env.DESIGN_SIZE))
    starts = _starts(models)
    rows: list[np.ndarray] = []
    for place, attribute, values in _changing(tree, drawn, specs):
        words = []
        for column in values.T:
            if (column == column[0]).all():
                words.append(_number(column[0]))
            else:
                words.append(f"\0{len(rows)}\0")
                rows.append(_slot(column, designs, starts, f"{place.tag} {attribute}"))
        place.set(attribute, " ".join(words))
    slots = np.array(rows).reshape(-1, env.DESIGN_SIZE + 2)
    clearance = None
    if slots[:, -1].any():
        lowest = np.array([start_clearance(model) for model in models])
        clearance, error = _affine(designs, lowest)
        if error > EXACT:
            raise ValueError(f"the clearance of {type(env).__name__} at its start is not affine in its design")
    parts = ET.tostring(tree, encoding="unicode").split("\0")
    order = [int(part) for part in parts[1::2]]
    body = WrittenBody(tuple(parts[0::2]), slots[order], clearance)
    _check(body, designs[-2 * CHECKED :], models[-2 * CHECKED :], type(env).__name__)
    return body


def _file_of(env: Fleet) -> ET.Element:
    """Parse the body's file, with the floor that the fleet gives to a robot without one."""
    path = Path(__file__).parent / "assets" / env.ASSET
    try:
        tree = ET.parse(path).getroot()
    except (OSError, ET.ParseError) as error:
        raise ValueError(f"{path} cannot be read ({error})") from None
    world = tree.find("worldbody")
    if world is None or tree.find("include") is not None:
        raise ValueError(f"{path} has no worldbody of its own, or includes other files; write it as one file")
    planes = env.simulations.model(0).geom_bodyid == 0
    if planes.sum() > len(world.findall("geom")):
        ET.SubElement(world, "geom", name=FLOOR, type="plane", size="40 40 40", contype="1", conaffinity="1")
    return tree


def _designs(env: Fleet) -> np.ndarray:
    """Random designs to fit to, and then those that the text is checked on, ``[N, D]``."""
    low, high = (bound.numpy() for bound in env.design_bounds())
    rng = np.random.default_rng(0)
    random = rng.uniform(low, high, (env.DESIGN_SIZE + CHECKED, env.DESIGN_SIZE))
    corners = np.where(rng.random((CHECKED, env.DESIGN_SIZE)) < 0.5, low, high)
    return np.concatenate([random, corners])


def _starts(models: Sequence[mujoco.MjModel]) -> np.ndarray:
    """Height of the root's body at the start of each model, ``[N]``; 0 for robots on a fixed base."""
    if find_height(models[0]) is None:
        return np.zeros(len(models))
    root = int(models[0].jnt_bodyid[0])
    return np.array([model.body_pos[root, 2] for model in models])


def _changing(
    tree: ET.Element, drawn: mujoco.MjSpec, specs: Sequence[mujoco.MjSpec]
) -> Iterator[tuple[ET.Element, str, np.ndarray]]:
    """Yield each attribute that differs from the drawn one for some design, with its values ``[N, width]``."""
    world = tree.find("worldbody")
    assert world is not None
    columns = zip(*(list(_parts(spec.worldbody)) for spec in (drawn, *specs)))
    for place, (first, *others) in zip(list(_elements(world)), columns, strict=True):
        tag = "joint" if place.tag == "freejoint" else place.tag
        for attribute in CHANGING[tag]:
            values = np.array([np.atleast_1d(getattr(part, attribute)) for part in others], dtype=float)
            as_drawn = np.atleast_1d(np.asarray(getattr(first, attribute), dtype=float))
            # NaN is the first number of the ends of a part that is given by its middle instead.
            if not np.isnan(values).any() and (values != as_drawn).any():
                yield place, attribute, values


def _elements(parent: ET.Element) -> Iterator[ET.Element]:
    """Walk through bodies with their parts: joints first, then geoms, then sites, then children."""
    yield from (child for child in parent if child.tag in ("joint", "freejoint"))
    yield from parent.findall("geom")
    yield from parent.findall("site")
    for child in parent.findall("body"):
        yield child
        yield from _elements(child)


def _parts(parent: mujoco.MjsBody) -> Iterator[mujoco.MjsBody | mujoco.MjsGeom | mujoco.MjsJoint | mujoco.MjsSite]:
    """Walk through the same of a specification."""
    yield from parent.joints
    yield from parent.geoms
    yield from parent.sites
    for child in parent.bodies:
        yield child
        yield from _parts(child)


def _slot(values: np.ndarray, designs: np.ndarray, starts: np.ndarray, name: str) -> np.ndarray:
    """Fit one number of the file, ``[N]``: constant, slopes and share of the start, ``[D + 2]``."""
    for share in (0.0, 1.0, -1.0):
        fitted, error = _affine(designs, values - share * starts)
        if error < EXACT:
            return np.append(fitted, share)
    raise ValueError(f"{name} of this body is not affine in its design, so that it cannot be written as text")


def _affine(designs: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Constant and slopes ``[D + 1]`` of values ``[N]`` by least squares, and the largest error."""
    inputs = np.column_stack([np.ones(len(designs)), designs])
    found: np.ndarray = np.linalg.lstsq(inputs, values, rcond=None)[0]
    fitted: np.ndarray = found.round(DIGITS) + 0.0  # no -0
    return fitted, float(np.abs(inputs @ fitted - values).max())


def _number(value: float) -> str:
    return repr(float(value))


def _check(body: WrittenBody, designs: np.ndarray, models: Sequence[mujoco.MjModel], name: str) -> None:
    """Compare every number of the compiled text with that of the simulated body."""
    values = {field: getattr(models[0], field) for field in dir(models[0])}
    fields = [field for field, value in values.items() if isinstance(value, np.ndarray) and value.dtype.kind == "f"]
    for design, wanted in zip(designs, models):
        found = mujoco.MjModel.from_xml_string(body.text(design))
        for field in fields:
            value, other = getattr(wanted, field), getattr(found, field)
            if value.shape != other.shape or np.abs(value - other).max(initial=0) > EXACT * np.abs(value).max(
                initial=1
            ):
                raise ValueError(
                    f"{field} of {name} depends on its design in another way than by the places and sizes of its "
                    f"parts: it cannot be written as text (design {design.round(3).tolist()})"
                )
