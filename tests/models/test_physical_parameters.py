"""What can be learned of a system: names, units, what stays, and the gradient of the objective in every number."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.models.arm import arm_data, arm_system

from forcegp.errors import InvalidInput, NumericalError, NumericalWarning, UnknownJoint, UnknownLink
from forcegp.inference import OptimizerOptions, minimize_objective
from forcegp.mechanics import (
    Actuation,
    Armature,
    CoulombJointFriction,
    RigidBodyBias,
    ViscousJointFriction,
)
from forcegp.models import Coefficients, StructuredGP
from forcegp.models.identification.physical_parameters import PHYSICAL, PhysicalParameters
from forcegp.models.search import with_steps_before
from forcegp.models.structured.physical_start import _slopes
from forcegp.priors import NoForces
from forcegp.robots import LinkInertia

FORCES = (
    Actuation(),
    RigidBodyBias(),
    ViscousJointFriction([0.3, 0.2, 0.1]),
    CoulombJointFriction([0.2, 0.0, 0.4]),
    Armature([0.01, 0.02, 0.03]),
)


def system():
    return arm_system(known_forces=FORCES)


def everything():
    return (
        LinkInertia("hand"),
        LinkInertia("fore", ("com",)),
        Coefficients("viscous-joint-friction", joints=("bend", "pan")),
        Coefficients("coulomb-joint-friction", start=0.15),
        Coefficients("armature"),
    )


def moved(physical, seed=0, size=0.3):
    return size * torch.as_tensor(np.random.default_rng(seed).standard_normal(len(physical.zero)))


def test_starts_at_the_systems_own_values_with_names_and_units():
    physical = PhysicalParameters.of(system(), everything())
    hand, fore = system().robot.link("hand"), system().robot.link("fore")
    named = physical.named(physical.zero)
    assert named["hand.mass"] == pytest.approx(hand.mass, rel=1e-14)
    assert [named[f"hand.com.{axis}"] for axis in "xyz"] == pytest.approx(hand.center_of_mass, rel=1e-14)
    assert [named[f"fore.com.{axis}"] for axis in "xyz"] == pytest.approx(fore.center_of_mass, rel=1e-14)
    moments = [named[f"hand.inertia.{axes}"] for axes in ("xx", "xy", "xz", "yy", "yz", "zz")]
    assert moments == pytest.approx(np.array(hand.inertia)[np.triu_indices(3)], rel=1e-12, abs=1e-16)
    assert [named[f"viscous-joint-friction.{joint}"] for joint in ("bend", "pan")] == pytest.approx([0.1, 0.3])
    assert [named[f"coulomb-joint-friction.{joint}"] for joint in ("pan", "lift", "bend")] == pytest.approx([0.15] * 3)
    units = dict(zip(physical.names, physical.units, strict=True))
    assert (units["hand.mass"], units["hand.com.x"]) == ("kg", "m")
    assert units["armature.lift"] == units["hand.inertia.xy"] == "kg m^2"
    assert units["viscous-joint-friction.pan"] == "Nms/rad"
    assert "viscous-joint-friction.lift" not in units


@pytest.mark.parametrize("parts", [("mass",), ("com",), ("mass", "com"), ("inertia",), ("mass", "inertia")])
def test_what_is_not_learned_keeps_its_physical_value(parts):
    before = system().robot.link("hand")
    physical = PhysicalParameters.of(system(), LinkInertia("hand", parts))
    for seed in range(3):
        after = physical.system_at(moved(physical, seed)).robot.link("hand")
        same = {
            "mass": after.mass == pytest.approx(before.mass, rel=1e-13),
            "com": after.center_of_mass == pytest.approx(before.center_of_mass, rel=1e-13),
            "inertia": bool(np.allclose(after.inertia, before.inertia, rtol=1e-12, atol=1e-16)),
        }
        assert same == {part: part not in parts for part in ("mass", "com", "inertia")}


def test_the_identified_system_carries_the_values_and_the_rest_is_untouched():
    physical = PhysicalParameters.of(system(), everything())
    z = moved(physical)
    identified, named = physical.system_at(z), physical.named(z)
    assert identified.robot.link("hand").mass == pytest.approx(named["hand.mass"], rel=1e-14)
    assert identified.robot.link("upper") == system().robot.link("upper")
    viscous, coulomb, armature = identified.known_forces[2:]
    assert viscous.coefficients.tolist() == pytest.approx(
        [named["viscous-joint-friction.pan"], 0.2, named["viscous-joint-friction.bend"]]
    )
    assert coulomb.coefficients.tolist() == pytest.approx(
        [named[f"coulomb-joint-friction.{joint}"] for joint in ("pan", "lift", "bend")]
    )
    assert armature.inertia[1].item() == pytest.approx(named["armature.lift"])
    again = PhysicalParameters.of(identified, everything()[:2])
    assert [again.named(again.zero)[name] for name in again.names] == pytest.approx(
        [named[name] for name in again.names], rel=1e-12, abs=1e-15
    )


def test_contact_points_do_not_know_the_centre_of_mass():
    physical = PhysicalParameters.of(system(), LinkInertia("hand"))
    q = torch.tensor(arm_data(5, seed=1).q)
    for seed in range(3):
        identified = physical.system_at(moved(physical, seed, 1.0))
        before, after = (s.contacts[0].position(s.robot.kinematics(q)) for s in (system(), identified))
        assert torch.equal(before, after)


@pytest.mark.parametrize("mean", ["analytical", "zero"])
def test_gradient_of_the_objective_in_every_number(mean):
    data = arm_data(6, seed=3, system=system())
    learn = everything() if mean == "analytical" else everything()[:1]
    posterior = StructuredGP(system(), mean=mean).identify(
        data, learn, restarts=1, options=OptimizerOptions(iterations=1)
    )
    identification = posterior.identification
    physical, objective = identification.physical, identification.objective
    z = (torch.linalg.inv(physical.transform) @ moved(physical, size=0.1)).requires_grad_()
    fixed = {name: value for name, value in identification.parameters.items() if name != PHYSICAL}
    (gradient,) = torch.autograd.grad(objective({**fixed, PHYSICAL: z}), z)
    for k, step in enumerate(1e-5 * torch.linalg.inv(physical.transform).T):
        above, below = (float(objective({**fixed, PHYSICAL: z.detach() + sign * step})) for sign in (1, -1))
        expected = float(gradient @ step) * 1e5
        assert (above - below) / 2e-5 == pytest.approx(expected, rel=2e-5, abs=2e-4), physical.names[k]


@pytest.mark.parametrize("contacts", [0, 1])
def test_quiet_data_give_the_true_inertia_back(contacts):
    truth = arm_system(contacts)
    data = arm_data(40, seed=5, system=truth)
    exact = truth.dynamics(*(torch.tensor(x) for x in (data.q, data.v, data.u))).acceleration(
        torch.zeros(40, 3).double()
    )
    noise = 1e-6 * np.random.default_rng(0).standard_normal((40, 3))
    quiet = replace(data, a=exact.numpy() + noise, truth={}, noise_std=np.full(3, 1e-6))
    wrong = PhysicalParameters.of(truth, LinkInertia("hand", ("mass", "com")))
    system = wrong.system_at(moved(wrong, 2, 0.5))
    posterior = StructuredGP(system, prior=NoForces()).identify(quiet, LinkInertia("hand", ("mass", "com")))
    found, true = posterior.system.robot.link("hand"), truth.robot.link("hand")
    assert abs(system.robot.link("hand").mass - true.mass) > 0.05
    assert found.mass == pytest.approx(true.mass, abs=1e-5)
    assert found.center_of_mass == pytest.approx(true.center_of_mass, abs=1e-5)
    assert posterior.negative_log_likelihood == pytest.approx(posterior.result.value, abs=1e-4)


def test_a_zero_mean_begins_at_the_given_system():
    data = arm_data(15, seed=7, system=system())
    learn = LinkInertia("hand", ("mass", "com"))
    wrong = PhysicalParameters.of(system(), learn)
    given = wrong.system_at(moved(wrong, 2, 0.5))
    starts = {}
    for mean in ("analytical", "zero"):
        posterior = StructuredGP(given, mean=mean).identify(
            data, learn, restarts=1, options=OptimizerOptions(iterations=0)
        )
        starts[mean] = len(posterior.result.iterates), posterior.identification.values["hand.mass"]
    mass = given.robot.link("hand").mass
    assert starts["zero"] == (1, pytest.approx(mass, rel=1e-12))
    # the analytical mean trusts the known forces, so that Gauss-Newton steps come first
    assert starts["analytical"][0] > 1
    assert starts["analytical"][1] != pytest.approx(mass, rel=0.01)


def test_a_start_in_the_units_of_another_fit_is_refused():
    data = arm_data(8, seed=7, system=system())
    with pytest.raises(InvalidInput, match=r"start has 'physical'.*StructuredGP\(posterior.system\)"):
        StructuredGP(system()).identify(data, LinkInertia("hand"), start={PHYSICAL: torch.zeros(10).double()})


def test_steps_without_an_objective_do_not_cost_the_fit():
    def objective(parameters):
        if float(parameters["x"]) > 2.0:
            raise NumericalError("far away")
        return parameters["x"].log()

    points = [{"x": torch.tensor(x).double()} for x in (3.0, -1.0, 2.0)]
    found = minimize_objective(lambda p: p["x"] ** 2, points[2], OptimizerOptions(keep_iterates=True))
    with pytest.warns(NumericalWarning, match="at 2 of 3 steps before the search"):
        longer = with_steps_before(found, objective, points)
    assert longer.history == (pytest.approx(np.log(2.0)), *found.history)
    assert longer.iterates == (points[2], *found.iterates)
    assert with_steps_before(found, objective, []) == found


@pytest.mark.parametrize(
    ("learn", "error", "words"),
    [
        (LinkInertia("hnd"), UnknownLink, "did you mean 'hand'"),
        (LinkInertia("base"), InvalidInput, "fixed in the world"),
        ((), InvalidInput, "learn is"),
        ((LinkInertia("hand"), LinkInertia("hand", ("com",))), InvalidInput, "com of 'hand' is named twice"),
        (Coefficients("wind"), InvalidInput, "no coefficients are called 'wind'; there are viscous-joint-friction"),
        (Coefficients("viscous-joint-friction", joints=("bnd",)), UnknownJoint, "did you mean 'bend'"),
        (Coefficients("coulomb-joint-friction"), InvalidInput, "0 for lift.*start=0.1"),
        ([Coefficients("armature"), Coefficients("armature", "pan")], InvalidInput, "armature.pan is named twice"),
    ],
)
def test_what_cannot_be_learned_is_named(learn, error, words):
    with pytest.raises(error, match=words):
        PhysicalParameters.of(system(), learn)


def test_a_force_must_be_listed_once():
    with pytest.raises(InvalidInput, match=r"lists 0 known forces 'armature'.*Armature\(...\) once"):
        PhysicalParameters.of(arm_system(), Coefficients("armature"))
    twice = arm_system(known_forces=(ViscousJointFriction(0.1), ViscousJointFriction(0.2)))
    with pytest.raises(InvalidInput, match="lists 2 known forces"):
        PhysicalParameters.of(twice, Coefficients("viscous-joint-friction"))


@pytest.mark.parametrize("parts", [("weight",), ("mass", "color")])
def test_a_link_has_three_parts(parts):
    with pytest.raises(InvalidInput, match="inertial parts mass, com, inertia, and '"):
        system().robot.link("hand").inertial(*parts)
    assert system().robot.link("hand").inertial("center_of_mass").parts == ("com",)
    assert system().robot.link("hand").inertial().parts == ("mass", "com", "inertia")


def test_slopes_of_the_start_are_derivatives():
    s = torch.tensor([0.3, -0.7], dtype=torch.float64)
    mean, covariance = _slopes(lambda s: (torch.stack([s[0] ** 2, s[0] * s[1], s[1].exp()]), torch.diag(s.sin())), s)
    x, y = s
    expected = torch.stack([torch.stack([2 * x, y, 0 * x]), torch.stack([0 * x, x, y.exp()])])
    torch.testing.assert_close(mean, expected, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(covariance, torch.stack([torch.diag(row * s.cos()) for row in torch.eye(2).double()]))
