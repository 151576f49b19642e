"""What values show of themselves: at most ten lines, at once, and as a table in a notebook."""

from xml.etree import ElementTree

import pytest
from tests.posterior.arm import arm_data, arm_model
from tests.posterior.raw_log import motion

from forcegp import Viscous, check, fit, score
from forcegp.forces import Actuation, JointForces, RigidBodies
from forcegp.inference import OptimizerOptions
from forcegp.summary import Summary


@pytest.fixture(scope="module")
def data():
    return arm_data(20, 0)


@pytest.fixture(scope="module")
def shown(data):
    quick = {"restarts": 1, "options": OptimizerOptions(iterations=3)}
    posterior = fit(data.model.with_forces(JointForces()), data, **quick)
    in_air = arm_model(0, forces=(Actuation(), RigidBodies(), Viscous()), baumgarte=None)
    learned, prediction = fit(in_air, arm_data(20, 0, arm_model(0))), posterior.predict(data.q, data.v, data.u)
    return {
        "Dataset": data, "Posterior": posterior, "Prediction": prediction, "Gaussian": prediction.unknown_force,
        "Scores": score(posterior, arm_data(10, 1), horizons=()), "Robot": data.model.robot, "Model": data.model,
        "Estimates": learned.estimates, "CheckReport": check(motion(1.0)),
        "Predictor": posterior.predictor(compile=False),
    }  # fmt: skip


FACTS = {
    "CheckReport": ("wrong: none", "sampling"), "Predictor": ("joints: 3", "covariance"),
    "Dataset": ["rows: 20", "joints: pan, lift, bend", "'arm', 1 contacts", "noise std: 0.05, 0.05, 0.05"],
    "Posterior": ["model: analytical mean", "learned from: 20 rows", "search: not converged"],
    "Prediction": ["batch: (20,)", "entries: 3", "forces: multiplier, contact_force, unknown_force"],
    "Gaussian": ["batch: (20,)", "largest std"],
    "Scores": ["mae of acceleration: ", "noise_floor of acceleration: 0.0399", "warnings: "],
    "Robot": ["name: 'arm'", "nv: 3", "pan (revolute), lift (revolute), bend (revolute)"],
    "Model": ["contacts: hand on Plane", "forces: Actuation, RigidBodies", "omega=5.0"],
    "Estimates": ["estimated: viscous.pan", "from: 20 rows, "],
}  # fmt: skip


@pytest.mark.parametrize("name", FACTS)
def test_texts_are_short_and_hold_what_matters(shown, name):
    text = repr(shown[name])
    assert text.startswith(f"{name}(")
    assert len(text) < 700
    assert len(text.splitlines()) <= 11
    for fact in FACTS[name]:
        assert fact in text


@pytest.mark.parametrize("name", FACTS)
def test_notebooks_show_the_same_facts_as_a_table(shown, name):
    table = ElementTree.fromstring(shown[name]._repr_html_())
    assert table.findtext("caption") == name
    cells = {row.findtext("th"): row.findtext("td") for row in table.findall("tr")}
    assert cells == {key: str(value) for key, value in shown[name].facts().items()}


def test_html_of_a_name_is_escaped():
    assert "<td>&lt;b&gt;</td>" in type("Odd", (Summary,), {"facts": lambda self: {"x": "<b>"}})()._repr_html_()
