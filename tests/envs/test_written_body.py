"""Bodies as MJCF text: the same model as the simulated one, for every design, or a refusal."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from two_link_arm import TWO_LINK_ARM

from coim import morph_from_mjcf
from coim.envs import AntMorph, HalfCheetahMorph, HopperMorph, MorphEnv, WalkerMorph
from coim.envs.written_body import written_body

FIELDS = ("qpos0", "body_pos", "body_mass", "body_inertia", "body_ipos", "geom_pos", "geom_size", "jnt_pos", "dof_M0")


@pytest.mark.parametrize("body", [HopperMorph, WalkerMorph, HalfCheetahMorph, AntMorph])
def test_the_text_of_a_design_compiles_to_the_body_that_is_simulated(body: type[MorphEnv]) -> None:
    env = body(seed=0)
    written = written_body(env)
    low, high = (bound.numpy() for bound in env.design_bounds())
    for design in np.random.default_rng(7).uniform(low, high, (3, len(low))):
        found = mujoco.MjModel.from_xml_string(written.text(design))
        wanted = env.simulations.body(design).compile()
        for field in FIELDS:
            np.testing.assert_allclose(getattr(found, field), getattr(wanted, field), rtol=0, atol=1e-10, err_msg=field)


def test_numbers_that_no_design_changes_stay_as_they_are_written() -> None:
    written = written_body(HopperMorph(seed=0))
    assert 'range="-150 0"' in "".join(written.texts)
    thigh = written.texts.index(next(text for text in written.texts if 'geom name="thigh"' in text))
    np.testing.assert_allclose(written.slots[thigh], [0, 0, -0.225, 0, 0, 0])  # half of 0.45 m below the hip


def test_a_site_on_a_segment_that_scales_is_written_where_it_moves_to(tmp_path: Path) -> None:
    path, lower = tmp_path / "arm.xml", '<geom name="lower"'
    sites = '<site name="hand" pos=".4 0 0"/><site name="palm" fromto=".4 0 0 .4 .1 0" size=".01" type="capsule"/>'
    path.write_text(TWO_LINK_ARM.replace(lower, sites + lower))
    arm = morph_from_mjcf(path, {"upper": ["upper"], "lower": ["lower"]}, reward=lambda o, a, n, design: n[..., :1])
    written = written_body(arm(seed=0))
    model = mujoco.MjModel.from_xml_string(written.text(np.array([1.0, 1.5])))
    assert model.site("hand").pos.tolist() == pytest.approx([0.6, 0, 0])
    assert model.site("palm").pos.tolist() == pytest.approx([0.6, 0.075, 0])  # its middle is stretched about the elbow


class Sticky(HopperMorph):
    """Its design changes the friction too."""

    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        super().shape_body(spec, design)
        spec.geom("foot").friction = [design[0], 0.005, 0.0001]


class Curved(HopperMorph):
    """The place of its foot is no affine function of the design."""

    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        super().shape_body(spec, design)
        spec.body("foot").pos = [design[3] ** 2, 0.0, -0.3]


class Hovering(HalfCheetahMorph):
    """It starts higher above the floor, by no affine function of the design."""

    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        super().shape_body(spec, design)
        spec.body("torso").pos = spec.body("torso").pos + np.array([0.0, 0.0, design[0] ** 2])


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (Sticky, "geom_friction of Sticky depends on its design in another way"),
        (Curved, "body pos of this body is not affine"),
        (Hovering, "the clearance of Hovering at its start is not affine"),
    ],
)
def test_a_body_that_the_text_would_not_give_is_refused(body: type[MorphEnv], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        written_body(body(seed=0))
