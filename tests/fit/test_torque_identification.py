"""Identification on simulated motions of a small arm whose truth is known."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data, arm_model
from tests.robots.robot_models import loaded

from forcegp.data import Dataset
from forcegp.errors import InvalidInput, RobotFileWarning
from forcegp.evidence import Accelerations, Torques, motion_residuals
from forcegp.evidence.least_squares import Fit
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.fit import fit
from forcegp.fit.equations import Equations
from forcegp.fit.physical import _with_noise_in_both, typical_sizes
from forcegp.forces import Actuation, Body, Coulomb, LoadFriction, Offset, RigidBodies, Rotor, Spring, Viscous
from forcegp.model import Model
from forcegp.progress import watched
from forcegp.robots import Robot

TRUE_FORCES = (
    Actuation(), RigidBodies(), Viscous([0.3, 0.2, 0.1]), Coulomb([0.8, 0.5, 0.3], 0.2), Offset([0.2, -0.1, 0.05]),
    Rotor([0.05, 0.04, 0.03]),
)  # fmt: skip
LAWS = Viscous(), Coulomb(), Offset()
WEAK = 1e-3  # strength of the prior on bodies where the log shall decide


def identified(data: Dataset, model: Model, *laws, evidence=None, strength: float = 0.1, **options):
    """The bodies and these laws, from all rows."""
    bodies = RigidBodies(dict.fromkeys(("upper", "fore", "hand"), Body(strength)))
    return fit(model.with_forces(bodies, *laws), data, evidence or Torques(), **options)


def missing(posterior, data: Dataset) -> np.ndarray:
    return motion_residuals(data, posterior.model)[0]


def recorded(rows: int, seed: int, noise: float = 0.0, torque_noise: float = 0.0) -> Dataset:
    """Random states of the arm in the air with all true forces; noise on a and on u."""
    data = arm_data(rows, seed, arm_model(0, forces=TRUE_FORCES))
    states = [torch.tensor(np.array(x)) for x in (data.q, data.v, data.u)]
    a, generator = data.model.dynamics(*states).acceleration_map().offset.numpy(), np.random.default_rng(seed + 100)
    a = a + noise * generator.normal(size=a.shape)
    return replace(data, a=a, u=data.u + torque_noise * generator.normal(size=a.shape), truth={}, noise_std=None)


def given() -> Model:
    """A URDF that is wrong about every mass and knows no friction."""
    model = arm_model(0)
    return model.with_robot(loaded(model.robot, "upper", "fore", "hand", mass=0.05))


@pytest.mark.parametrize("evidence", [Torques(), Torques("both"), Accelerations()], ids=str)
def test_exact_data_give_the_truth(evidence):
    noise = 0.0 if evidence == Torques() else 1e-4
    found = identified(recorded(300, 0, noise), given(), *LAWS, Rotor(), evidence=evidence, strength=WEAK)
    test = recorded(100, 1)
    force, acceleration = motion_residuals(test, found.model)
    assert abs(force).max() < 5e-3 * abs(test.u).max()
    assert abs(acceleration).max() < 5e-3 * abs(test.a).max()
    for name, value in (
        ("viscous.pan", 0.3),
        ("coulomb.level.lift", 0.5),
        ("offset.bend", 0.05),
        ("coulomb.velocity_scale.pan", 0.2),
    ):
        assert found.parameters[name].value == pytest.approx(value, rel=0.02, abs=2e-3)


def test_what_predicts_is_what_is_written_down():
    found = identified(recorded(60, 2, noise=0.1), given(), *LAWS, Rotor())
    again, test = Model.from_json(found.model.to_json()), recorded(20, 3)
    force, acceleration = motion_residuals(test, again)
    np.testing.assert_allclose(missing(found, test), force, atol=1e-9)
    np.testing.assert_allclose(test.a - found.predict(test.q, test.v, test.u).mean.numpy(), acceleration, atol=1e-7)
    told = found.parameters
    for body in ("upper", "fore", "hand"):
        link = again.robot.link(body)
        assert told[f"{body}.mass"].value == pytest.approx(link.mass, rel=1e-9)
        centers = [told[f"{body}.center_of_mass.{axis}"].value for axis in "xyz"]
        np.testing.assert_allclose(centers, link.center_of_mass, atol=1e-9)


def test_intervals_hold_the_truth():
    """Of 12 recordings, about 95 % of the intervals hold the truth."""
    truth = {
        "viscous.pan": 0.3, "viscous.lift": 0.2, "coulomb.level.pan": 0.8, "coulomb.level.bend": 0.3,
        "offset.lift": -0.1,
    }  # fmt: skip
    held = []
    for seed in range(12):
        train = recorded(150, 10 + seed, torque_noise=0.2)
        found = fit(train.model.with_forces(*LAWS), train).parameters
        held += [found[name].interval[0] <= value <= found[name].interval[1] for name, value in truth.items()]
        assert all(found[name].decided_by == "log" for name in truth)
    assert 0.8 <= np.mean(held) <= 1.0


def test_what_the_log_does_not_show_is_said():
    train = recorded(60, 6, noise=0.1)
    found = identified(replace(train, v=np.zeros_like(train.v), a=np.zeros_like(train.a)), given(), Viscous())
    assert found.parameters["viscous.pan"].decided_by == "prior"
    assert found.parameters["viscous.pan"].why == "no row shows it"
    assert found.parameters["upper.mass"].decided_by == "prior"  # never lifted, never turned
    told = json.loads(json.dumps(found.parameters.to_dict(), allow_nan=False))
    assert told["parameters"]["hand.mass"]["unit"] == "kg"
    assert told["parameters"]["viscous.pan"]["unit"] == "Nm s/rad"
    assert found.parameters.by_body["upper"] == 10


def test_progress_and_a_limit_on_rows():
    seen = []
    with watched(lambda *told: seen.append(told)):
        found = identified(recorded(60, 7), given(), *LAWS, rows=20)
    assert found.settings["points"] == found.parameters.rows == 20
    assert [number for number, *_ in seen] == list(range(1, len(seen) + 1))
    assert seen[-1][2].startswith(f"all rows, step {len(seen)}: ")


def test_means_over_time_need_few_rows_in_each_window():
    log = replace(recorded(6000, 8, torque_noise=0.2), time=np.arange(6000) / 60.0)
    model = log.model.with_forces(*LAWS)
    for seconds, rows in ((0.2, 5000), (0.4, 2500), (2.0, 2000)):
        found = fit(model, log, Torques(mean=seconds)).estimates
        assert found.rows == pytest.approx(rows, abs=10)
    every = fit(model, log, Torques(mean=2.0), rows=6000).estimates
    assert all(abs(each.value - every[name].value) < 3.0 * each.std for name, each in found.items())


def test_models_that_cannot_be_identified_so():
    data = recorded(5, 9)
    with pytest.raises(InvalidInput, match="touches something with hand"):
        fit(arm_model(1).with_forces(Viscous()), data)
    with pytest.raises(InvalidInput, match=r"lack RigidBodies\(\); list it"):
        fit(arm_model(0, forces=(Actuation(),)).with_forces(Viscous()), data)
    with pytest.raises(InvalidInput, match="`rows=0` must be"):
        fit(arm_model(0).with_forces(Viscous()), data, rows=0)


def test_intervals_are_those_of_the_posterior():
    """Gauss-Newton's information of independent residuals, inverted densely; and finite where there is hardly any."""
    train = recorded(400, 30, torque_noise=0.2)
    found = fit(train.model.with_forces(Viscous()), train).parameters
    residual = motion_residuals(train, train.model.with_forces(Viscous([0.0, 0.0, 0.0])))[0]
    for joint, name in enumerate(("pan", "lift", "bend")):
        v = train.v[:, joint]
        noise = residual[:, joint] - found[f"viscous.{name}"].value * v
        assert found[f"viscous.{name}"].value == pytest.approx((v @ residual[:, joint]) / (v @ v), rel=1e-3)
        assert found[f"viscous.{name}"].std == pytest.approx(noise.std() / np.linalg.norm(v), rel=0.3)
    poor = identified(recorded(4, 31), given(), *LAWS, strength=1e-6).parameters
    assert np.isfinite([each.std for each in poor.values()]).all()


def test_friction_under_load_does_not_explain_the_torque_by_itself():
    """A wrist whose torque is friction of a changing level: from the measured |u| its mu came out as 1."""
    # The first joint has friction under load, and its mu is found
    robot, generator = arm_model(0).robot, np.random.default_rng(0)
    q, v, a = generator.normal(size=(3, 400, 3))
    torque = robot.inverse_dynamics(*(torch.tensor(x) for x in (q, v, a))).numpy()
    sign, u = np.tanh(v / 0.05), torque + 0.02 * generator.normal(size=a.shape)
    u[:, 0] = torque[:, 0] / (1.0 - 0.15 * sign[:, 0] * np.sign(torque[:, 0]))  # u = torque + 0.15 |u| sign
    u[:, 2] += 20.0 * sign[:, 2] * generator.uniform(0.5, 1.5, 400)
    log = Dataset(q=q, v=v, u=u, a=a, time=0.01 * np.arange(400.0), model=arm_model(0))
    found = fit(log.model.with_forces(LoadFriction()), log)
    assert found.parameters["load.factor.pan"].value == pytest.approx(0.15, abs=0.01)
    assert found.parameters["load.factor.bend"].value < 0.5
    assert missing(found, log)[:, 2].std() > 4.0  # of 5.8 that no model can know


def test_a_passive_joint_does_not_explain_its_torque_by_carrying_nothing():
    """No torque is no torque of any mass; the hand swings freely, beside noise of accelerations."""
    log = recorded(400, 3)
    free = replace(log, u=log.u * [1.0, 1.0, 0.0])
    states = [torch.tensor(np.array(x)) for x in (free.q, free.v, free.u)]
    model = replace(log.model, forces=(Actuation(), RigidBodies()))
    a = model.dynamics(*states).acceleration_map().offset.numpy()
    free = replace(free, a=a + 0.01 * a.std(axis=0) * np.random.default_rng(0).standard_normal(a.shape), model=model)
    found = identified(free, given(), strength=1.0).parameters
    assert found["hand.mass"].value == pytest.approx(model.robot.link("hand").mass, rel=0.1)
    space = ParameterSpace(model.with_forces(RigidBodies("all"), Viscous()), typical_sizes(model, [free]))
    equations = Equations(space, [free.rows(slice(0, 20))], Torques(), ())
    x = space.start + 0.1 * np.random.default_rng(1).standard_normal(space.size)
    assert list(equations.passive) == [2]
    needed = space.typical["force"][2] * np.random.default_rng(2).standard_normal((400, 1)) * [0.0, 0.0, 1.0]
    for share, passive in ((0.07, [2]), (0.15, [])):  # noise of a channel, and a torque that tells of what is carried
        assert list(Equations(space, [replace(free, u=free.u + share * needed)], Torques(), ()).passive) == passive
    J = np.asarray(equations.in_torque(x, equations.measured)[1])
    numeric = [(equations.in_torque(x + h, equations.measured)[0] - equations.in_torque(x - h, equations.measured)[0])
               / 2e-6 for h in 1e-6 * np.eye(len(x))]  # fmt: skip
    np.testing.assert_allclose(J, np.stack(numeric, axis=-1), atol=1e-5 * abs(J).max())


def test_springs_and_where_they_rest():
    """Torques from Pinocchio's inverse dynamics in other tests; here of a joint with a spring that no file states."""
    data = recorded(200, 50, torque_noise=0.05)
    stiffness, rest = np.array([2.0, 0.0, 1.0]), np.array([0.3, 0.0, -0.5])
    found = fit(data.model.with_forces(Spring()), replace(data, u=data.u + stiffness * (data.q - rest))).parameters
    for joint, (k, q_0) in {"pan": (2.0, 0.3), "bend": (1.0, -0.5)}.items():
        assert found[f"spring.stiffness.{joint}"].value == pytest.approx(k, rel=0.05)
        assert found[f"spring.rest.{joint}"].value == pytest.approx(q_0, abs=0.05)
    assert abs(found["spring.stiffness.lift"].value) < 0.1


def test_rotor_inertias_are_whole_in_reports_and_in_files(tmp_path):
    """The robot has a part of its rotors already; the estimate adds the rest."""
    data, model = recorded(300, 40), arm_model(0)
    model = model.with_robot(model.robot.with_armature([0.02, 0.0, 0.01]))
    found = identified(data, model, *LAWS, Rotor(), strength=1.0)
    for joint, (start, truth) in zip(model.robot.joint_names, ((0.02, 0.05), (0, 0.04), (0.01, 0.03)), strict=True):
        assert found.parameters[f"rotor.{joint}"].start == pytest.approx(start)
        assert found.parameters[f"rotor.{joint}"].value == pytest.approx(truth, rel=0.03)
    with pytest.warns(RobotFileWarning, match="^found.urdf: only forcegp reads rotor inertias from URDF"):
        found.model.to_urdf(tmp_path / "found.urdf")
    written = Robot.from_urdf(tmp_path / "found.urdf")
    np.testing.assert_allclose(written.armature, [0.05, 0.04, 0.03], rtol=0.03)
    assert [joint.damping for joint in written.joints] == pytest.approx(
        [found.parameters[f"viscous.{joint.name}"].value for joint in written.joints]
    )
    q, v, _ = (torch.tensor(np.array(x)) for x in (data.q, data.v, data.u))
    torch.testing.assert_close(written.mass_matrix(q), found.model.mass_matrix_at(found.model.robot.kinematics(q, v)))


@pytest.mark.usefixtures("unchecked")  # equations are only what the searches ask them for
def test_searches_beside_noise_of_accelerations_end_where_little_is_left_to_gain():
    one, levels = np.ones(1), SimpleNamespace(scaled=lambda factor: None)
    equations = SimpleNamespace(levels=lambda *_: levels, parts=[], measured=[], sizes=one, whitened=max)

    def ended(**how: bool) -> tuple[float, int, bool]:
        gains = iter([5.0, 1.0, 0.06, 0.03, 0.0])  # nats, of two numbers
        rest = one[None], np.zeros((1, 1, 2)), one, np.eye(2), np.zeros(2), 1, True
        found, _ = _with_noise_in_both(
            equations, lambda *_, start, **more: Fit(start, *rest, expected=next(gains)), np.zeros(2), max, **how
        )
        return found.expected, found.evaluations, found.settled

    assert ended() == ended(roughly=True) == (0.03, 4, True)  # far off
    assert ended(rough=False, roughly=True) == (0.06, 3, True)  # only to tell noise
