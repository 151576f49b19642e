"""The dataset comes first, and what is given in another place or of another kind ends in one sentence."""

import pytest
from tests.posterior.arm import arm_data, arm_model

from forcegp import Model, Torques, check, fit, save_posterior, score
from forcegp.errors import InvalidInput
from forcegp.evidence import motion_residuals
from forcegp.fit import calibrated, held_out_noise
from forcegp.forces import JointForces
from forcegp.scores import split_named


@pytest.fixture(scope="module")
def data():
    return arm_data(12, 0, arm_model(0))


@pytest.fixture(scope="module")
def posterior(data):
    return fit(data.model.with_forces(JointForces()), data, restarts=1)


CALLS = [
    (lambda d, p: score(d, p), "log is a Posterior; give a Dataset"),
    (lambda d, p: score(d, d), "models is a Dataset; give a Posterior, a mapping from names, or names"),
    (
        lambda d, p: score({"a": 5}, d, split=split_named(d, "blocks:2:1", 0.0), points=3),
        "model 'a' is a int; give a name, a Model or a Posterior",
    ),
    (lambda d, p: check(d.model, d), "dataset is a Model; give a Dataset"),
    (lambda d, p: check(d, d.model.robot), "model is a Robot; give a Model"),
    (lambda d, p: motion_residuals(d.model, d), "dataset is a Model; give a Dataset"),
    (lambda d, p: held_out_noise(d, d.model, Torques()), "model is a Dataset; give a Model"),
    (lambda d, p: calibrated(d, p), "posterior is a Dataset; give a Posterior"),
    (lambda d, p: split_named("auto", "auto"), "dataset is a str; give a Dataset"),
    (
        lambda d, p: fit(d.model.with_forces(JointForces()), d.model),
        "dataset is a Model; give a Dataset; the model comes first",
    ),
    (lambda d, p: fit(d.model.with_forces(JointForces()), None), "dataset is a NoneType; give a Dataset"),
    (lambda d, p: fit(d, d.model), "model is a Dataset; give a Model"),
    (lambda d, p: p.update((d.q, d.v, d.u, d.a)), "rows is a tuple; give a Dataset, for example"),
    (lambda d, p: p.with_contacts(arm_model(1).contacts[0]), "contacts is .*; give a sequence of Contact"),
    (lambda d, p: d.model.with_contacts(5), "contacts is 5; give a sequence of Contact"),
    (lambda d, p: d.model.with_robot(d.model), "robot is a Model; give a Robot"),
    (lambda d, p: p.with_model(d.model.robot), "model is a Robot; give a Model"),
    (lambda d, p: Model("arm.urdf"), r"robot is a str; give a Robot, for example Robot.from_urdf"),
    (lambda d, p: save_posterior("run", p), "posterior is a str; give a Posterior"),
    (lambda d, p: score(["given"], d, points=4, model=d.model.robot), "model is a Robot; give a Model"),
    (lambda d, p: score(["given"], d, points=4, recording=d.model), "recording is a Model; give a Dataset"),
]


@pytest.mark.parametrize(("call", "message"), CALLS)
def test_swapped_and_wrong_arguments_end_in_one_sentence(data, posterior, call, message):
    with pytest.raises(InvalidInput, match=message) as caught:
        call(data, posterior)
    assert "\n" not in str(caught.value)
