"""The dataset comes first, and what is given in another place or of another kind ends in one sentence."""

import pytest
from tests.models.arm import arm_data, arm_system

from forcegp import (
    Comparison,
    JointFriction,
    MechanicalSystem,
    StructuredGP,
    check,
    compare_priors,
    evaluate,
    identify_analytical,
    save_posterior,
    split_named,
    validate,
)
from forcegp.analytical import held_out_noise, motion_residuals
from forcegp.errors import InvalidInput


@pytest.fixture(scope="module")
def data():
    return arm_data(12, 0, arm_system(0))


@pytest.fixture(scope="module")
def posterior(data):
    return StructuredGP(data.system).fit(data, restarts=1)


CALLS = [
    (lambda d, p: evaluate(d, p), "posterior is a Dataset; give a Posterior"),
    (lambda d, p: evaluate(p, p), "dataset is a StructuredPosterior; give a Dataset"),
    (lambda d, p: check(d.system, d), "dataset is a MechanicalSystem; give a Dataset"),
    (lambda d, p: check(d, d.system.robot), "system is a Robot; give a MechanicalSystem"),
    (lambda d, p: motion_residuals(d.system, d), "dataset is a MechanicalSystem; give a Dataset"),
    (lambda d, p: held_out_noise(d.system, d), "dataset is a MechanicalSystem; give a Dataset"),
    (lambda d, p: identify_analytical(d.system), "dataset is a MechanicalSystem; give a Dataset"),
    (lambda d, p: identify_analytical(d, d.system.robot), "system is a Robot; give a MechanicalSystem"),
    (lambda d, p: compare_priors({"a": JointFriction()}, d), "dataset is a dict; give a Dataset"),
    (lambda d, p: compare_priors(d, [JointFriction()] * 2), "priors is a list; give a Mapping from names to priors"),
    (lambda d, p: split_named("auto", "auto"), "dataset is a str; give a Dataset"),
    (lambda d, p: StructuredGP(d.system).fit(d.system), "dataset is a MechanicalSystem; give a Dataset; the system"),
    (lambda d, p: StructuredGP(d.system).fit(None), "dataset is a NoneType; give a Dataset"),
    (lambda d, p: StructuredGP(d).fit(d.system), "system is a Dataset; give a MechanicalSystem"),
    (lambda d, p: p.update((d.q, d.v, d.u, d.a)), "rows is a tuple; give a Dataset, for example"),
    (lambda d, p: p.with_contacts(arm_system(1).contacts[0]), "contacts is .*; give a sequence of Contact"),
    (lambda d, p: d.system.with_contacts(5), "contacts is 5; give a sequence of Contact"),
    (lambda d, p: p.with_robot(d.system), "robot is a MechanicalSystem; give a Robot"),
    (lambda d, p: p.with_system(d.system.robot), "system is a Robot; give a MechanicalSystem"),
    (lambda d, p: MechanicalSystem("arm.urdf"), r"robot is a str; give a Robot, for example Robot.from_urdf"),
    (lambda d, p: save_posterior("run", p), "posterior is a str; give a Posterior"),
    (lambda d, p: validate("folder", d), "comparison is a str; give a Comparison"),
    (lambda d, p: Comparison(d.system, d, d, ()), "system is a Dataset; give a MechanicalSystem"),
    (lambda d, p: Comparison(d, d.system, d.system, ()), "recording is a MechanicalSystem; give a Dataset"),
]


@pytest.mark.parametrize(("call", "message"), CALLS)
def test_swapped_and_wrong_arguments_end_in_one_sentence(data, posterior, call, message):
    with pytest.raises(InvalidInput, match=message) as caught:
        call(data, posterior)
    assert "\n" not in str(caught.value)
