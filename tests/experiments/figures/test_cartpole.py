"""Fig. 4(c) is Gymnasium's cart-pole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv

from coim.experiments.figures.cartpole import LENGTH, POLE_MASS, STATES, cart_acceleration, plots


@pytest.mark.parametrize(("angle", "angular_velocity", "force"), STATES)
@pytest.mark.parametrize(("length", "mass"), [(LENGTH, POLE_MASS), (0.3, 1.7), (3.5, 0.6)])
def test_the_acceleration_is_that_of_gymnasiums_step(
    angle: float, angular_velocity: float, force: float, length: float, mass: float
) -> None:
    env = CartPoleEnv()
    assert (2 * env.length, env.masspole, env.masscart) == (LENGTH, POLE_MASS, 1.0)
    env.length, env.masspole = length / 2, mass
    env.total_mass, env.polemass_length = env.masscart + mass, mass * length / 2
    env.force_mag, env.kinematics_integrator = abs(force), "euler"
    env.reset(seed=0)
    env.state = np.array([0.0, 0.0, angle, angular_velocity], dtype=np.float64)
    env.step(int(force > 0))
    stepped = env.state[1] / env.tau  # from a cart at rest
    ours = cart_acceleration(length, mass, angle=angle, angular_velocity=angular_velocity, force=force)
    assert ours == pytest.approx(stepped, rel=1e-6)


def test_a_pole_at_rest_pulls_by_its_mass_and_not_by_its_length() -> None:
    state = {"angle": 0.2, "angular_velocity": 0.0, "force": 10.0}
    short, long = (cart_acceleration(length, 0.5, **state) for length in (0.4, 4.0))
    assert short == pytest.approx(long, rel=1e-12)
    assert cart_acceleration(1.0, 0.6, **state) < short


def test_the_figure_needs_no_study_and_its_rows_are_what_is_drawn() -> None:
    (plot,) = plots(Path("nowhere"))
    assert len(plot.figure.axes) == len(STATES)
    row = plot.rows[1111]
    state = {key: row[key] for key in ("angle", "angular_velocity", "force")}
    assert row["acceleration"] == pytest.approx(cart_acceleration(row["length"], row["mass"], **state))
