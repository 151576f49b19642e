"""The wrong start of figure 2c, by Pinocchio."""

import numpy as np
import pinocchio as pin
import pytest
from benchmarks.paper.fig2c_jobs import CENTER_OFFSET, MASS_OFFSET, wrong_model
from tests.benchmarks.oracle import Tool

from forcegp.simulation.kuka_surface import TOOL_LINK


def bodies(model) -> dict[str, pin.Inertia]:
    """The inertia of the body behind every joint, in the joint's frame, with rotational inertia about its centre."""
    model = Tool(model).oracle.model
    return dict(zip(model.names, model.inertias, strict=True))


def test_the_wrong_tool_is_too_heavy_and_off_centre_and_nothing_else(motion):
    before, after = bodies(motion.model), bodies(wrong_model(motion.model))
    assert list(before) == list(after)
    tool = Tool(motion.model).oracle.model
    own = tool.names[tool.frames[tool.getFrameId(TOOL_LINK)].parentJoint]
    for name in before:
        mass, center = (MASS_OFFSET, CENTER_OFFSET) if name == own else (0.0, (0.0, 0.0, 0.0))
        assert after[name].mass == pytest.approx(before[name].mass + mass, rel=1e-9)
        np.testing.assert_allclose(after[name].lever - before[name].lever, center, rtol=0, atol=1e-9)
        np.testing.assert_allclose(after[name].inertia, before[name].inertia, rtol=1e-7, atol=1e-10)
    assert MASS_OFFSET == 0.5
    assert CENTER_OFFSET == (0.05, 0.05, -0.03)
