"""Fig. 4(c): how a cart-pole's acceleration depends on its body. It needs no study.

References:
    Barto, Sutton, Anderson 1983, Neuronlike adaptive elements that can solve difficult learning control problems, IEEE
    Transactions on Systems, Man, and Cybernetics 13(5): the equations of motion.
    Florian 2007, Correct equations for the dynamics of the cart-pole system: the form without friction.
    Gymnasium's CartPole-v1, https://gymnasium.farama.org/environments/classic_control/cart_pole: that form, and the
    masses and the length of the original body.
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Sec. 6.5 and Fig. 4(c).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import AbstractPathEffect, withStroke
from numpy.typing import ArrayLike

from coim.experiments.drawing.layout import new_figure
from coim.experiments.drawing.palette import CIRCLE
from coim.experiments.figures.plot import Plot

GRAVITY = 9.8  # m/s^2
CART_MASS = 1.0  # kg
LENGTH, POLE_MASS = 1.0, 0.1  # m, kg: Gymnasium's body, whose `length` of 0.5 m is half the pole
LENGTHS, MASSES = np.linspace(0.2, 4.0, 39), np.linspace(0.05, 2.0, 40)
MARGIN = 0.08  # of a panel's side, in which no number has room
# Angle from the vertical in rad, angular velocity in rad/s, force on the cart in N.
STATES = ((0.2, 0.0, 10.0), (0.2, 3.0, 0.0), (0.8, 6.0, -10.0))


def cart_acceleration(
    length: ArrayLike,
    pole_mass: ArrayLike,
    *,
    angle: float,
    angular_velocity: float,
    force: float,
    cart_mass: float = CART_MASS,
) -> np.ndarray:
    """Acceleration of the cart along x, without friction, in m/s^2.

    Args:
        length: length of the whole pole, m.
        pole_mass: mass of the pole, kg.
        angle: angle of the pole from the vertical, rad.
        angular_velocity: angular velocity of the pole, rad/s.
        force: force on the cart, N.
        cart_mass: mass of the cart, kg.

    Example:
        >>> float(cart_acceleration(1.0, 0.1, angle=0.0, angular_velocity=0.0, force=0.0))  # upright and at rest
        0.0
        >>> weightless = cart_acceleration(1.0, 1e-9, angle=0.3, angular_velocity=0.0, force=10.0)
        >>> float(weightless.round(6))  # m/s^2: 10 N push 1 kg
        10.0
    """
    half, pole_mass = np.asarray(length) / 2, np.asarray(pole_mass)
    total = cart_mass + pole_mass
    sine, cosine = np.sin(angle), np.cos(angle)
    push = (force + pole_mass * half * angular_velocity**2 * sine) / total
    turn = (GRAVITY * sine - cosine * push) / (half * (4 / 3 - pole_mass * cosine**2 / total))
    return np.asarray(push - pole_mass * half * turn * cosine / total)


def plots(study: Path) -> Iterator[Plot]:
    """Contours of the acceleration over length and mass of the pole, one panel for each state."""
    figure, grid = new_figure(2.9, 1, len(STATES))
    rows = []
    for axes, (angle, angular_velocity, force) in zip(grid, STATES):
        lengths, masses = np.meshgrid(LENGTHS, MASSES)
        state = {"angle": angle, "angular_velocity": angular_velocity, "force": force}
        acceleration = cart_acceleration(lengths, masses, **state)
        draw(axes, lengths, masses, acceleration)
        axes.set_title(f"{angle:g} rad, {angular_velocity:g} rad/s, {force:g} N", fontsize=9)
        rows += [
            {**state, "length": float(x), "mass": float(y), "acceleration": float(a)}
            for x, y, a in zip(lengths.flat, masses.flat, acceleration.flat)
        ]
    grid[0].set(ylabel="mass of the pole (kg)")
    caption = (
        "Acceleration of the cart of a cart-pole against length and mass of its pole, by the equations of motion, in "
        "three states (angle and angular velocity of the pole, force on the cart). Numbers on lines: m/s². Magenta "
        "circle: the body of Gymnasium."
    )
    notes = (
        "Gymnasium's body has a pole of 1 m and 0.1 kg on a cart of 1 kg.",
        "Each panel has a colour scale of its own.",
        "For a pole at rest its length makes no difference.",
    )
    yield Plot(name="figure_4c_cartpole", figure=figure, rows=rows, caption=caption, notes=notes)


def draw(axes: Axes, lengths: np.ndarray, masses: np.ndarray, acceleration: np.ndarray) -> None:
    """One state: colours, lines with numbers, the original body."""
    axes.pcolormesh(lengths, masses, acceleration, cmap="cividis", shading="gouraud", rasterized=True)
    lines = axes.contour(lengths, masses, acceleration, levels=8, colors="white", linewidths=0.7)
    # White alone is lost on the bright end of the colours.
    around: list[AbstractPathEffect] = [withStroke(linewidth=2.5, foreground="black")]
    for label in axes.clabel(lines, fontsize=7, fmt="%g", inline=False):
        label.set_path_effects(around)
        x, y = (axes.transData + axes.transAxes.inverted()).transform(label.get_position())
        if not (MARGIN < x < 1 - MARGIN and MARGIN < y < 1 - MARGIN):
            label.remove()  # cut, it would read as another number
    axes.plot(LENGTH, POLE_MASS, "o", **CIRCLE)
    axes.set(xlabel="length of the pole (m)")
