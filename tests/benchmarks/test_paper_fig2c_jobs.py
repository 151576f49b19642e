"""The wrong start of figure 2c, by Pinocchio, and when its errors count as found."""

import numpy as np
import pinocchio as pin
import pytest
from benchmarks.paper.fig2c import _found_at
from benchmarks.paper.fig2c_jobs import CENTER_BOUND, CENTER_OFFSET, MASS_BOUND, MASS_OFFSET, wrong_system
from tests.benchmarks.oracle import Tool

from forcegp.simulation.kuka_motion import TOOL_LINK


def bodies(system) -> dict[str, pin.Inertia]:
    """The inertia of the body behind every joint, in the joint's frame, with rotational inertia about its centre."""
    model = Tool(system).oracle.model
    return dict(zip(model.names, model.inertias, strict=True))


def test_the_wrong_tool_is_too_heavy_and_off_centre_and_nothing_else(motion):
    wrong = wrong_system(motion.system)
    before, after = bodies(motion.system), bodies(wrong)
    assert list(before) == list(after)
    tool = Tool(motion.system).oracle.model
    own = tool.names[tool.frames[tool.getFrameId(TOOL_LINK)].parentJoint]
    for name in before:
        mass, center = (MASS_OFFSET, CENTER_OFFSET) if name == own else (0.0, (0.0, 0.0, 0.0))
        assert after[name].mass == pytest.approx(before[name].mass + mass, rel=1e-9)
        np.testing.assert_allclose(after[name].lever - before[name].lever, center, rtol=0, atol=1e-9)
        np.testing.assert_allclose(after[name].inertia, before[name].inertia, rtol=1e-7, atol=1e-10)
    assert MASS_OFFSET == 0.5
    assert CENTER_OFFSET == (0.05, 0.05, -0.03)


def test_the_contact_point_of_the_wrong_tool_stays_where_it_was(motion):
    wrong = wrong_system(motion.system)
    assert wrong.contacts == motion.system.contacts
    before, after = Tool(motion.system), Tool(wrong)
    for q in motion.q[::120]:
        np.testing.assert_allclose(after.position(q), before.position(q), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("mass", "center", "found"),
    [
        ([0.5, 0.01, 0.01], [0.08, 5e-4, 5e-4], 1),
        ([0.5, 0.01, 0.5, -0.01], [0.0, 0.0, 0.0, 0.0], 3),  # what leaves its bounds again was not found before
        ([0.0, 0.0, 0.0], [0.08, 2e-3, 9e-4], 2),
        ([0.0, -0.01], [0.0, 0.0], 0),
        ([0.5, 0.01, -0.03], [0.0, 0.0, 0.0], None),
        ([0.0, 0.0], [0.0, 2e-3], None),
        ([MASS_BOUND, -MASS_BOUND], [CENTER_BOUND, CENTER_BOUND], 0),
    ],
)
def test_found_means_from_there_on_to_the_end(mass, center, found):
    assert _found_at({"mass_error": mass, "center_error": center}) == found
