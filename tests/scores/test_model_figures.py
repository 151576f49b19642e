"""What the figures of a model draw is what the model says: lines and bands against predictions made by hand."""

import numpy as np
import pytest
from tests.simulation.pendulum import double_pendulum

from forcegp import Dataset, JointFriction, Viscous, fit
from forcegp.inference import OptimizerOptions
from forcegp.posterior import Posterior
from forcegp.progress import watched
from forcegp.scores import model_pictures
from forcegp.scores.figures.model import curve_panels, friction_curves_figure

QUICK = OptimizerOptions(iterations=10)


@pytest.fixture(scope="module")
def swinging() -> Dataset:
    return double_pendulum(4.0, seed=1)


@pytest.fixture(scope="module")
def friction(swinging) -> Posterior:
    """Friction learned beside a viscous law of 0.1 Nm s/rad."""
    model = swinging.model
    model = type(model)(model.robot, (), forces=(*model.forces, Viscous(0.1)))
    return fit(model.with_forces(JointFriction()), swinging, points=20, restarts=1, options=QUICK)


def lines(axes, label: str) -> list:
    return [line for line in axes.lines if line.get_label() == label]


def test_curves_are_laws_and_what_was_learned_beside_them(swinging, friction):
    figure = friction_curves_figure(friction, swinging)
    for panel, axes in zip(curve_panels(friction), figure.axes, strict=True):
        (whole,) = lines(axes, "laws and learned part")
        at, drawn = whole.get_xdata(), whole.get_ydata()
        curve = friction.curve(panel.latent, at[:, None])
        np.testing.assert_allclose(drawn, 0.1 * at + curve.mean.numpy(), atol=1e-12)
        np.testing.assert_allclose(
            lines(axes, "laws alone")[0].get_ydata(), 0.1 * lines(axes, "laws alone")[0].get_xdata()
        )
        visited = friction.training.v[:, panel.joint].numpy()
        assert (at.min() >= visited.min(), at.max() <= visited.max()) == (True, True)
        beyond = lines(axes, "beyond the training data")[0].get_xdata()
        assert beyond.min() < visited.min() < visited.max() < beyond.max()
        assert axes.get_xlabel() == "velocity [rad/s]"
        assert axes.get_ylabel() == "torque [Nm]"
    assert figure.get_suptitle() == "Friction learned from 20 points"


def test_every_picture_of_a_model_is_drawn_or_named(swinging, friction):
    told = []
    with watched(lambda *words: told.append(words)):
        pictures, missing = model_pictures(friction, swinging)
    assert [each.name for each in pictures] == ["forces"]
    assert (0, 1, "forces") in told
    assert missing == []
