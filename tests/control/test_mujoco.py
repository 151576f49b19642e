"""Learned forces in MuJoCo: accelerations against `predict`, threads, drawn functions, and what is refused."""

import numpy as np
import pytest
from tests.control.test_monitor import DT, motion, posterior
from tests.control.test_tracking import ROBOT, URDF, VISCOUS
from tests.posterior.arm import arm_data, arm_model, quick_fit

from forcegp import Dataset, JointForces, JointFriction, Model, Viscous, fit
from forcegp.control.mujoco_forces import MujocoForces
from forcegp.errors import InvalidInput, NumericalError
from forcegp.forces import Actuation, RigidBodies

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
rollout = pytest.importorskip("mujoco.rollout")

__all__ = ["posterior"]  # a fixture
AS_STATED = '<mujoco><compiler balanceinertia="false"/></mujoco></robot>'


def model_of(urdf=URDF):
    model = mujoco.MjModel.from_xml_string(urdf.replace("</robot>", AS_STATED))
    model.jnt_limited[:] = 0
    return model


@pytest.fixture(scope="module")
def predictor(posterior):
    return posterior.predictor(covariance="none")


def accelerations(forces, model, q, v, u):
    data, found = mujoco.MjData(model), []
    with forces:
        for data.qpos[:], data.qvel[:], data.qfrc_applied[:] in zip(q, v, u, strict=True):
            mujoco.mj_forward(model, data)
            found.append(data.qacc.copy())
    return np.array(found)


def states(count, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (3, count, 2)) * [[[2.0]], [[1.5]], [[20.0]]]


def test_accelerations_are_those_of_predict(posterior, predictor):
    q, v, u = states(20)
    model = model_of()
    found = accelerations(MujocoForces(predictor, model), model, q, v, u)
    np.testing.assert_allclose(found, posterior.predict(q, v, u, covariance=False).mean, atol=1e-8)
    assert mujoco.get_mjcb_passive() is None


def test_known_friction_and_joints_in_another_order_act_too():
    """A model whose friction is all known, in a model with a free body in front."""
    laws = (Actuation(), RigidBodies(), Viscous(VISCOUS))
    q, v, u = motion(3.0, 8, noise=0.0)
    model = Model(ROBOT, forces=laws)
    rows = Dataset(q=q, v=v, u=u, a=v, time=DT * np.arange(len(q)), model=model, noise_std=np.ones(2))
    fitted = fit(model, rows, points=5, restarts=1)
    spec = mujoco.MjSpec.from_string(URDF.replace("</robot>", AS_STATED))
    ball = spec.worldbody.add_body(name="ball", pos=[5.0, 0.0, 0.0])
    ball.add_freejoint()
    ball.add_geom(size=[0.1, 0.0, 0.0])
    model = spec.compile()
    model.jnt_limited[:] = 0
    forces, data = MujocoForces(fitted.predictor(), model), mujoco.MjData(model)
    at = [model.joint(name).qposadr[0] for name in ROBOT.joint_names]
    dof = [model.joint(name).dofadr[0] for name in ROBOT.joint_names]
    with forces:
        for q, v, u in zip(*states(5), strict=True):
            data.qpos[at], data.qvel[dof], data.qfrc_applied[dof] = q, v, u
            mujoco.mj_forward(model, data)
            np.testing.assert_allclose(data.qfrc_passive[dof], -np.array(VISCOUS) * v, atol=1e-12)
            np.testing.assert_allclose(data.qacc[dof], fitted.predict(q, v, u).mean, atol=1e-8)


def test_threads_do_not_change_a_bit(predictor):
    model = model_of()
    model.opt.timestep = 0.002
    begin, data = np.zeros((16, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))), mujoco.MjData(model)
    for row, (q, v, _) in zip(begin, zip(*states(16), strict=True), strict=True):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_getState(model, data, row, mujoco.mjtState.mjSTATE_FULLPHYSICS)

    def ends(threads):
        with rollout.Rollout(nthread=threads) as runner:
            return runner.rollout([model] * 16, [mujoco.MjData(model) for _ in range(threads)], begin, nstep=50)[0]

    free = ends(1)
    with MujocoForces(predictor, model):
        one, many = ends(1), ends(8)
    np.testing.assert_array_equal(one, many)
    assert np.abs(one - free).max() > 1e-3


def test_a_force_that_is_not_finite_is_an_error(predictor):
    model = model_of()
    data = mujoco.MjData(model)
    data.qvel[:] = np.nan
    forces = MujocoForces(predictor, model)
    forces.__enter__()
    mujoco.mj_forward(model, data)
    with pytest.raises(NumericalError, match="not finite"):
        forces.__exit__(None, None, None)
    assert mujoco.get_mjcb_passive() is None


@pytest.mark.parametrize(
    ("urdf", "change", "message"),
    [
        (URDF.replace("elbow", "wrist"), None, "no hinge or slide 'elbow'; its joints are shoulder, wrist"),
        (URDF.replace('mass value="1.5"', 'mass value="1.7"'), None, "mass matrix of the MjModel differs by"),
        (URDF, ("opt.gravity", 1.0), "gravity or bias force of the MjModel differs"),
        (URDF, ("dof_armature", 0.1), "mass matrix"),
        (URDF, ("dof_damping", 0.3), "joint shoulder has damping in the MjModel, which would act beside"),
        (URDF, ("dof_frictionloss", 0.3), "has frictionloss"),
    ],
)
def test_models_that_do_not_fit(predictor, urdf, change, message):
    model = model_of(urdf)
    if change is not None:
        owner, _, name = change[0].rpartition(".")
        getattr(model.opt if owner else model, name)[:] = change[1]
    with pytest.raises(InvalidInput, match=message):
        MujocoForces(predictor, model)


def test_forces_that_mujoco_cannot_have(posterior, predictor):
    with pytest.raises(InvalidInput, match="made with compile=False"):
        MujocoForces(posterior.predictor(compile=False), model_of())
    with pytest.raises(InvalidInput, match=r"predictor is a Posterior; .*posterior\.predictor\(\)"):
        MujocoForces(posterior, model_of())
    touching = quick_fit(arm_model().with_forces(JointFriction()))
    by_torque = quick_fit(arm_model(0).with_forces(JointForces()), arm_data(20, 0, arm_model(0)))
    with pytest.raises(InvalidInput, match=r"with_contacts\(\[\]\)"):
        MujocoForces(touching.predictor(covariance="none"), model_of())
    model = model_of(arm_model(0).robot.urdf_text)
    model.dof_damping[:] = model.dof_frictionloss[:] = 0.0
    with pytest.raises(InvalidInput, match="forces depend on u, which MuJoCo computes after"):
        MujocoForces(by_torque.predictor(covariance="none"), model)
