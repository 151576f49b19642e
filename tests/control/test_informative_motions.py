"""Chosen motions: limits at every time, against Pinocchio; what they teach, against real updates; what is refused."""

from dataclasses import replace

import numpy as np
import pinocchio
import pytest
import scipy.linalg
import torch
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import URDF, arm_data, arm_model, arm_that_remembers, quick_fit

from forcegp import Contact, Dataset, Plane, excitation
from forcegp.control.informative_motions import BaseParameters, far_apart
from forcegp.control.tracking import Past
from forcegp.errors import InvalidInput
from forcegp.forces import Coulomb, JointFriction
from forcegp.inference.engines import Inducing

FREE, START = arm_model(0), [0.3, 0.8, -0.6]
FEW = {"motions": 9, "start": START, "seconds": 4.0}
LIMITS = {"position": [0.5, 1.0, 0.7], "velocity": [1.0, 2.0, 1.5], "acceleration": 8.0, "torque": [50.0, 11.0, 3.0]}


def fitted(prior, model=FREE, rows=12):
    return quick_fit(model.with_forces(prior), arm_data(rows, 1, model), 8)


@pytest.fixture(scope="module")
def posterior():
    return fitted(JointFriction())


@pytest.fixture(scope="module")
def chosen(posterior):
    return excitation(posterior, **FEW, limits={"velocity": 2.0, "acceleration": 10.0}, rows=20)


def test_a_posterior_of_many_rows_is_as_that_of_some_of_them(posterior, chosen, monkeypatch):
    latent = posterior.likelihood.condition(posterior.kernels, posterior.hyperparameters, Inducing())
    many, given = replace(posterior, latent=latent), {"limits": {"velocity": 2.0, "acceleration": 10.0}, "rows": 20}
    found = excitation(many, **FEW, **given)
    np.testing.assert_allclose(found.spread, chosen.spread, rtol=1e-6)
    monkeypatch.setattr("forcegp.control.informative_motions.MANY_ROWS", 4)
    assert (excitation(many, **FEW, **given).spread[0] > found.spread[0]).all()


def rnea(q, v, a):
    model = pinocchio.buildModelFromXML(URDF)
    return np.array([pinocchio.rnea(model, model.createData(), *x) for x in zip(q, v, a, strict=True)])


@pytest.mark.parametrize("seed", range(3))
def test_all_limits_hold_at_every_time(seed):
    found = excitation(FREE.robot, **FEW, limits=LIMITS, seed=seed)
    q, v, a = found.trajectory(np.linspace(-0.1, 4.1, 4201))
    for values, name in ((q - START, "position"), (v, "velocity"), (a, "acceleration"), (rnea(q, v, a), "torque")):
        assert (np.abs(values) <= np.array(LIMITS[name])).all(), name
    assert found.usage["velocity"].max() > 0.5
    assert max(x.max() for x in found.usage.values()) <= 1.0
    for at in (0.0, 4.0):  # rest
        np.testing.assert_allclose(np.stack(found.trajectory(at)), [START, [0.0] * 3, [0.0] * 3], atol=1e-12)
    np.testing.assert_allclose(np.gradient(q, 0.001, axis=0), v, atol=5e-3)
    np.testing.assert_allclose(np.gradient(v, 0.001, axis=0)[105:-105], a[105:-105], atol=5e-2)


def test_a_bare_robot_moves_so_that_its_parameters_show():
    """The determinant of independent columns of Pinocchio's regressor and friction grows with the motions looked at."""
    model = pinocchio.buildModelFromXML(URDF)
    data, rng = model.createData(), np.random.default_rng(0)

    def regressor(q, v, a):
        Y = [pinocchio.computeJointTorqueRegressor(model, data, *x).copy() for x in zip(q, v, a, strict=True)]
        return np.concatenate(Y)

    _, R, order = scipy.linalg.qr(regressor(*rng.normal(0.0, 2.0, (3, 100, 3))), mode="economic", pivoting=True)
    columns = order[: int((np.abs(R.diagonal()) > 1e-9 * abs(R[0, 0])).sum())]

    def determinant(motions):
        found = excitation(FREE.robot, **FEW | {"motions": motions}, limits={"velocity": 2.0, "acceleration": 10.0})
        q, v, a = found.trajectory(np.linspace(0.0, 4.0, 201))
        friction = [np.concatenate([np.diag(f(x)) for x in v]) for f in (np.array, lambda x: np.tanh(x / 0.05))]
        Y = np.hstack([regressor(q, v, a)[:, columns], *friction])
        return np.linalg.slogdet(Y.T @ Y)[1], found.condition

    (least, _), (more, condition) = determinant(1), determinant(30)
    assert more > least + 3.0
    assert 1.0 < condition < 1e3


def test_samples_one_after_the_other_show_what_all_show(monkeypatch):
    found, columns = excitation(FREE.robot, **FEW, limits=LIMITS), BaseParameters(FREE, np.ones(3))
    whole = columns.triangle(found.motion)
    monkeypatch.setattr("forcegp.control.informative_motions.ENTRIES", 700)
    np.testing.assert_allclose(np.abs(columns.triangle(found.motion)), np.abs(whole), atol=1e-10 * np.abs(whole).max())


def test_what_is_expected_is_what_an_update_gives_whatever_is_measured(posterior, chosen):
    motion = chosen.motion
    some, a = far_apart(motion.q, motion.v, motion.u, 20), np.random.default_rng(0).normal(0.0, 5.0, (20, 3))
    rows = Dataset(q=motion.q[some], v=motion.v[some], u=motion.u[some], a=a, time=np.arange(20) * 0.1, model=FREE)
    measured, at = posterior.update(rows), arm_data(30, 5, FREE)
    after, before = (x.predict(at.q, at.v, at.u) for x in (chosen.expected, posterior))
    np.testing.assert_allclose(after.covariance, measured.predict(at.q, at.v, at.u).covariance, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(after.mean, before.mean, rtol=1e-6, atol=1e-7)
    assert (chosen.spread[1] < chosen.spread[0]).all()


def test_torques_are_those_of_the_learned_friction(posterior, chosen):
    motion = chosen.motion
    v = motion.v[::20]
    friction = posterior.predict(motion.q[::20], v, motion.u[::20]).unknown_force.mean.numpy()
    np.testing.assert_allclose(motion.u[::20], rnea(motion.q[::20], v, motion.a[::20]) - friction, atol=1e-6)


def height(found):
    """Of the point of the tool above z = 0, at many times."""
    q, model = found.trajectory(np.linspace(0.0, found.seconds, 2001))[0], pinocchio.buildModelFromXML(URDF)
    data, frame, heights = model.createData(), model.getFrameId("hand"), []
    for x in q:
        pinocchio.framesForwardKinematics(model, data, x)
        heights.append(data.oMf[frame].act(np.array([0.0, 0.0, 0.2]))[2])
    return np.array(heights)


def test_a_point_stays_away_from_surfaces():
    low = height(excitation(FREE, **FEW)).min()
    floor = Contact("hand", (0.0, 0.0, 0.2), Plane((0.0, 0.0, 1.0), low + 0.1))
    for model, surfaces in ((FREE, [floor]), (FREE.with_contacts([floor]), None)):
        assert height(excitation(model, **FEW, surfaces=surfaces, clearance=0.05)).min() >= low + 0.15
    with pytest.raises(InvalidInput, match=r"frame 'hand' is .* m from its surface, not 2, at the start"):
        excitation(FREE, **FEW, surfaces=[floor], clearance=2.0)


def test_models_without_learned_forces_move_for_parameters():
    found = excitation(fitted(()), **FEW | {"motions": 3})
    assert found.spread is None
    assert found.expected is None
    assert found.condition > 1.0


def test_the_file_has_the_motion(chosen, tmp_path):
    chosen.save_csv(tmp_path / "next.csv", rate=50.0)
    header, *rows = (tmp_path / "next.csv").read_text().splitlines()
    assert header.split(",") == ["t", *(f"{x}_{joint}" for x in "qvau" for joint in ("pan", "lift", "bend"))]
    table = np.array([row.split(",") for row in rows], float)
    assert table.shape == (201, 13)
    np.testing.assert_allclose(table[:, 1:10], np.hstack(chosen.trajectory(table[:, 0])), atol=1e-7)
    assert "condition" in repr(chosen)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start": [0.0, 3.5, 0.0]}, r"joint lift: no motion from 3.5 .* position limits of -6.2 and -0.8 from there"),
        ({"limits": {"velocity": [1.0, 0.0, 1.0]}}, "joint lift: no motion from 0.8 .* velocity limits of 0 and 0"),
        ({"limits": {"torque": [50.0, 1.0, 50.0]}}, r"joint lift needs .* times its torque limit at the start"),
        ({"limits": {"jerk": 1.0}}, "jerk"), ({"limits": {"velocity": [1.0, 2.0]}}, "velocity"),
        ({"seconds": 0.0}, "seconds"), ({"clearance": np.nan}, "clearance"), ({"rows": 0}, "rows"),
        ({"surfaces": [3]}, "contacts"), ({"task": 3}, "task"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(posterior, changes, message):
    with pytest.raises(InvalidInput, match=message):
        excitation(posterior, **FEW | changes)


def test_without_a_start_it_is_inside_of_the_limits(posterior):
    how = {"motions": 1, "seconds": 4.0}
    np.testing.assert_allclose(excitation(FREE, **how).start, 0.0, atol=1e-12)  # the limits are -3 and 3
    middle = posterior.training.q.mean(0).numpy()
    np.testing.assert_allclose(excitation(posterior, **how).start, middle.clip(-2.565, 2.565))


def test_chosen_motions_are_what_they_were(chosen):
    bare = excitation(FREE.robot, **FEW, limits=LIMITS)
    ends = [bare.distances(bare.motion.q[:50]), far_apart(*bare.motion[1:3], bare.motion.u, 9)]
    found = {
        name: {"motion": each.motion._asdict(), "usage": each.usage, "limits": each.limits, "spread": each.spread,
               "condition": each.condition, "at": each.trajectory(np.linspace(0.0, 4.0, 41))}
        for name, each in (("learned", chosen), ("bare", bare))
    }  # fmt: skip
    assert_unchanged("control/motions", found | {"ends": ends}, rtol=1e-3)


def test_gears_that_remember_are_met_as_the_motion_leaves_them():
    """z+ = s + (z - s) exp(-sigma |dq|) sample by sample, from 0; torques against Pinocchio."""
    model = FREE.with_forces(Coulomb(0.8, 0.05, sigma=20.0, memory=("pan", "bend")))
    found = excitation(model, **FEW, limits=LIMITS | {"torque": 60.0})
    z, last = np.zeros((len(found.motion.q), 3)), np.zeros(3)
    for k in range(1, len(z)):
        step = np.diff(found.motion.q[k - 1 : k + 1], axis=0)[0]
        z[k] = last = np.sign(step) + (last - np.sign(step)) * np.exp(-20.0 * np.abs(step))
    z[:, 1] = np.tanh(found.motion.v[:, 1] / 0.05)
    q, v, a = found.motion[1:4]
    np.testing.assert_allclose(found.motion.u, rnea(q, v, a) + 0.8 * z, atol=1e-9)
    np.testing.assert_allclose(BaseParameters(model, np.ones(3)).dry(found.motion), z, atol=1e-12)
    assert np.abs(z - np.tanh(v / 0.05)).max() > 0.5, "which velocities alone do not tell"

    learned, _ = arm_that_remembers()
    best = excitation(learned, **FEW | {"motions": 3}, limits=LIMITS | {"torque": 60.0}, rows=20)
    rows, known = best.expected.training, len(learned.training)
    place = [int(np.abs(best.motion.q - each).sum(1).argmin()) for each in rows.q[known:].numpy()]
    assert len(place) == 20
    past = Past(learned.model).over(torch.as_tensor(best.motion.q))[0]
    np.testing.assert_allclose(rows.u[known:, 3:], past[place], atol=1e-9)
