"""Plots of friction curves and normal forces: what is drawn is what the model and the truth say."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from tests.evidence.test_contact_forces import held
from tests.evidence.test_contact_forces import measured as sensed
from tests.goldens.compare import assert_unchanged, drawn
from tests.posterior.arm import arm_model, quick_fit
from tests.scores.friction import fitted, friction_data, joint_law

from forcegp import Noise, Viscous
from forcegp.data import Dataset
from forcegp.data.dataset import FORCE
from forcegp.errors import InvalidInput
from forcegp.fit import fit
from forcegp.forces import ContactFriction, GearFriction, JointForces, JointFriction, JointPositionForces
from forcegp.mechanics import fixed_point
from forcegp.scores import friction_curves_figure, normal_force_figure
from forcegp.scores.accuracy import metrics, poor_scores, predict_rows, row_scores, rows_outside, unfinished_search
from forcegp.scores.figures.model import law_forces


@pytest.fixture(scope="module")
def data() -> Dataset:
    return friction_data(80, seed=1)


@pytest.fixture(scope="module")
def friction():
    return fitted(JointFriction(), ContactFriction(kernel="linear"))


def line(axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    (found,) = [line for line in axes.get_lines() if line.get_label() == label]
    return np.asarray(found.get_xdata()), np.asarray(found.get_ydata())


def band(axes) -> np.ndarray:
    """Corners (n, 2) of the band over the visited range."""
    (found,) = [part for part in axes.collections if part.get_label() == "95 % band"]
    assert isinstance(found, PolyCollection)
    return found.get_paths()[0].vertices


def test_every_curve_has_a_panel_that_names_it_with_its_units(friction, data):
    figure = friction_curves_figure(friction, data)
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in panels] == [
        "joint-friction: pan", "joint-friction: lift", "joint-friction: bend", "contact-friction: sliding",
    ]  # fmt: skip
    assert (panels[0].get_xlabel(), panels[0].get_ylabel()) == ("velocity [rad/s]", "torque [Nm]")
    assert (panels[3].get_xlabel(), panels[3].get_ylabel()) == ("sliding speed [m/s]", "force [N]")
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "95 % band", "learned", "beyond the training data", "training velocities", "true",
    ]  # fmt: skip


def test_a_panel_shows_the_curve_its_band_the_training_velocities_and_the_truth(friction, data):
    axes = friction_curves_figure(friction, data).axes[1]  # joint lift
    velocity, mean = line(axes, "learned")
    curve = friction.curve("joint-friction lift", velocity)
    np.testing.assert_allclose(mean, curve.mean, atol=1e-9)
    trained = friction.training.v[:, 1].numpy()
    np.testing.assert_array_equal(line(axes, "training velocities")[0], trained)
    assert trained.min() <= velocity.min() < velocity.max() <= trained.max()
    corners = band(axes)
    lower, upper = (end.numpy() for end in curve.interval())
    at = velocity[len(velocity) // 3]
    drawn = corners[np.isclose(corners[:, 0], at)][:, 1]
    assert [drawn.min(), drawn.max()] == pytest.approx([lower[len(lower) // 3], upper[len(upper) // 3]], abs=1e-8)
    everywhere, _ = line(axes, "beyond the training data")
    assert everywhere.min() < trained.min() < trained.max() < everywhere.max()
    assert line(friction_curves_figure(friction).axes[3], "beyond the training data")[0].min() >= 0.0  # a speed
    at, truth = line(axes, "true")
    np.testing.assert_allclose(truth, joint_law(at), atol=1e-12)
    assert len(at) > 60
    gears = data.model.with_forces(Viscous(0.2), GearFriction(level=0.5, factor=0.1, sigma=300.0, memory=True))
    np.testing.assert_allclose(law_forces(gears, 1, np.array([-2.0, 2.0])), [-0.9, 0.9], rtol=1e-9)


def test_large_models_say_how_many_curves_are_shown(monkeypatch):
    model = fitted(JointFriction(), JointPositionForces(), iterations=1)
    monkeypatch.setattr("forcegp.scores.figures.model.LARGEST_GRID", 2)
    figure = friction_curves_figure(model)
    assert (len(figure.axes), "2 of 6 curves" in figure.get_suptitle()) == (2, True)


def test_models_without_normal_force_are_refused(without_contact, data):
    for model in (without_contact, fit(data.model.black_box(), friction_data(10, 0))):
        with pytest.raises(InvalidInput, match="no normal force"):
            normal_force_figure(model, data)


def test_figures_and_scores_are_what_they_were(friction, data):
    figures = friction_curves_figure(friction, data), normal_force_figure(friction, data, seconds=0.5)
    rows = predict_rows(friction, data)
    table, stretches = row_scores(friction, data)
    doubts = [*rows_outside(friction, data), *poor_scores(friction, data, table), *unfinished_search(friction)]
    found = {"figures": list(map(drawn, figures)), "rows": rows, "table": table, "stretches": stretches}
    found["doubts"] = [(each.about, each.level, each.numbers) for each in doubts]
    assert_unchanged("scores/friction", found, rtol=1e-3)


def test_scores_beside_sensors_are_what_they_were():
    """Of forces at two frames, and of intervals without a width."""
    log = sensed(held(Viscous(0.7)), held(), rows=40, noise=0.1)
    feet = (held().contacts[0], fixed_point("fore", (0.0, 0.1, 0.0))[1])
    model = arm_model(0).with_contacts(feet).with_forces(JointForces(("v",)), noise=Noise(0.1))
    log = replace(log, model=model.known, measured=log.measured | {f"{FORCE}fore": log.a}, truth={"a": 1.01 * log.a})
    posterior = quick_fit(model, replace(log, measured={})).with_settings(widening=1.0)
    table, stretches = row_scores(posterior, log, whole=log.rows(slice(20)))
    size = np.array([[1e-3], [1.0], [1e3]]) * [1.0, -1.0]
    widths = [metrics(1.1 * x, (k * 1e-9 * x) ** 2 * [1.0, 1e20], x) for x in size[:, None] for k in (0.9, 1.1)]
    figure = normal_force_figure(posterior, log, seconds=0.2)
    assert_unchanged("scores/sensors", {"of": table, "in": stretches, "no": widths, "seen": drawn(figure)}, rtol=1e-3)
