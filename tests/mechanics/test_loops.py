"""Closed loops against Pinocchio's constrained dynamics, MuJoCo's constraints and dense linear algebra."""

import warnings

import mujoco as untyped
import numpy as np
import pinocchio as pin
import pytest
import torch
from tests.robots.mjcf_models import BAR, FOUR_BAR
from tests.robots.mujoco_oracle import MujocoOracle
from tests.robots.random_positions import random_positions

from forcegp.errors import ContactError, InvalidInput
from forcegp.integration import onto_contacts, violation
from forcegp.mechanics import Held, LoopClosure, Plane, loop_frame, loop_point
from forcegp.mechanics.gauss_principle import Contact
from forcegp.model import Model

mujoco = untyped
LIMB = "".join(
    f'<body name="{{0}}{k}" pos="{pos}"><joint name="{{0}}{k}" axis="{axis}"/>{BAR.format(0.05, 0.1, 1 + 0.2 * k)}'
    for k, (pos, axis) in enumerate(
        ((".1 0 0", "0 0 1"), ("0 .05 .2", "0 1 0"), (".1 0 .2", "1 0 1"), ("0 0 .2", "0 1 1"))
    )
)
SPATIAL = f"""<mujoco model="two arms"><worldbody>{LIMB.format("a")}<site name="end" pos="0 .1 .1" euler="10 0 5"/>
</body></body></body></body><body pos=".3 .1 0" euler="0 0 40">{LIMB.format("b")}</body></body></body></body></body>
</worldbody><equality>{{}}</equality></mujoco>"""
CONNECT = SPATIAL.format('<connect name="pin" body1="a3" body2="b3" anchor=".02 .1 .15"/>')
WELD = SPATIAL.format('<weld name="seam" body1="a3" body2="b3" anchor=".1 0 .1" relpose=".02 .1 .1 1 .2 .1 .3"/>')
CLOSED = {"four-bar": FOUR_BAR, "connect": CONNECT, "weld": WELD}


def model_of(text, tmp_path, **options):
    (tmp_path / "loop.xml").write_text(text)
    return Model.from_mjcf(tmp_path / "loop.xml", **options)


def states(model, rows=3):
    """On the loop, with velocities that keep it closed, and inputs."""
    generator = torch.Generator().manual_seed(3)
    q, v, u = (torch.randn(rows, model.robot.nv, dtype=torch.float64, generator=generator) for _ in range(3))
    q, v = onto_contacts(model, 0.1 * q, v)
    return q, v, 5.0 * u


@pytest.mark.parametrize("name", CLOSED)
def test_accelerations_and_forces_are_those_of_pinocchio(name, tmp_path):
    model = model_of(CLOSED[name], tmp_path)
    robot, (q, v, u) = model.robot, states(model)
    limits = '<limit lower="-9" upper="9" effort="1" velocity="1"/></joint>'  # without, q is (cos, sin) there
    text = robot.urdf_text.replace('type="continuous"', 'type="revolute"').replace("</joint>", limits)
    plain = pin.buildModelFromXML(text)
    order = [robot.joint_names.index(plain.names[k + 1]) for k in range(plain.nv)]
    loop = model.loops[0]
    ends = []
    for frame, point in ((loop.frame, loop.point), (loop.second_frame, loop.second_point)):
        at = plain.frames[plain.getFrameId(frame, pin.FrameType.BODY)]
        ends += [at.parentJoint, at.placement * pin.SE3(np.eye(3), np.array(point))]
    kind = pin.ContactType.CONTACT_6D if name == "weld" else pin.ContactType.CONTACT_3D
    constraint = pin.RigidConstraintModel(kind, plain, *ends, pin.ReferenceFrame.LOCAL)
    found = model.dynamics(q, v, u)
    a, force = found.acceleration(torch.zeros_like(v)), found.multiplier(torch.zeros_like(v))
    for k in range(len(q)):
        data, models, datas = plain.createData(), pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        models.append(constraint)
        datas.append(constraint.createData())
        pin.initConstraintDynamics(plain, data, models, datas)
        settings = pin.ProximalSettings(1e-14, 1e-12, 100)
        numbers = (x[k].numpy()[order] for x in (q, v, u))
        expected = pin.constraintDynamics(plain, data, *numbers, models, datas, settings)
        np.testing.assert_allclose(a[k].numpy()[order], expected, rtol=1e-9, atol=1e-9 * abs(expected).max())
        if name == "connect":  # three independent rows: the force is unique
            world = data.oMi[ends[0]].rotation @ ends[1].rotation @ datas[0].contact_force.linear
            np.testing.assert_allclose(force[k], world, rtol=1e-9, atol=1e-9 * abs(world).max())


@pytest.mark.parametrize("name", CLOSED)
def test_derivatives(name, tmp_path):
    """A' v is the derivative of A v; A is that of c where the loop is closed; accelerations pass gradcheck."""
    model = model_of(CLOSED[name], tmp_path)
    q, v, u = states(model, 2)
    for k in range(2):
        at, moving, away = q[k], torch.roll(v[k], 1), q[k] + 0.3  # any velocity: A v is not 0
        _, slope = torch.func.jvp(lambda x, moving=moving: violation(model, x, moving)[0], (at,), (moving,))
        torch.testing.assert_close(slope, violation(model, at, moving)[1], rtol=1e-10, atol=1e-10)
        _, drift = torch.func.jvp(lambda x, moving=moving: violation(model, x, moving)[1], (away,), (moving,))
        torch.testing.assert_close(-model.dynamics(away, moving, u[k]).b, drift, rtol=1e-10, atol=1e-10)
    inputs = [x[:1].clone().requires_grad_() for x in (q, v, u)]
    torch.autograd.gradcheck(lambda *x: model.dynamics(*x).acceleration(torch.zeros_like(v[:1])), inputs)


def test_loops_survive_files_and_act_where_their_switch_is_on(tmp_path):
    robot = model_of(WELD, tmp_path).robot
    model = Model(robot, loop_frame("end", "b3", switch="latched"))
    again = Model.from_json(model.to_json())
    assert again.contacts == model.contacts
    assert again.inputs[-1] == "latched"
    assert "end and b3" in repr(model)
    q = torch.full((2, robot.nv), 0.2).double()
    u = torch.cat([torch.ones(2, robot.nv), torch.tensor([[0.0], [1.0]])], 1).double()
    a = again.dynamics(q, 0 * q, u).acceleration(0 * q)
    free = robot.forward_dynamics(q, 0 * q, u[:, :-1])
    torch.testing.assert_close(a[0], free[0])
    J = (robot.frame_jacobian(q, "end") - robot.frame_jacobian(q, "b3"))[1]
    assert (J @ a[1]).abs().max() < 1e-9
    assert (J @ free[1]).abs().max() > 1.0


def test_states_that_do_not_fit_and_frames_of_one_body_are_refused(tmp_path):
    model = model_of(FOUR_BAR, tmp_path)
    model.check_states(*states(model))
    with pytest.raises(ContactError, match="do not move against each other"):
        Model(model.robot, loop_point("crank", (0, 0, 0), "crank", (0, 0, 1)))
    with pytest.raises(InvalidInput, match="use loop_point"):
        LoopClosure("crank", (0.0, 0.0, 0.0), Plane((0, 0, 1), 0.0), None, "rocker")
    with pytest.raises(InvalidInput, match="second_point"):
        LoopClosure("crank", (0.0, 0.0, 0.0), Held((0, 0, 1)), None, "rocker", (0, 0))  # type: ignore[arg-type]
    assert model.touching == ()
    assert len(model.with_contacts([*model.contacts, Contact("crank", (0, 0, 1), Plane((0, 0, 1), 0))]).loops) == 3


@pytest.mark.parametrize("gear", ["0 0 1 0 0 .02", "1 2 -3 .4 .5 .6", "0 0 0 .1 .2 -.3", "0 0 0 0 0 0"])
@pytest.mark.parametrize("base", ["", '<freejoint name="root"/>'])
def test_rotors_on_links_that_move_are_inputs(tmp_path, base, gear):
    """MuJoCo's joint forces: a tilting pod with a rotor under a frame of its own, and one on the body."""
    pod = '<body name="pod" pos=".2 0 .1" euler="10 0 20"><joint name="tilt" axis="0 1 0" pos="0 .01 .02"/>'
    pod += '<geom size=".05" mass=".3"/><body pos=".05 .02 .1" euler="30 -20 5"><site name="r2" pos="0 .1 .02"/></body>'
    right = '<motor name="right" site="r1" gear="0 0 1 0 0 .1"/>' if base else ""
    text = (
        f'<mujoco><worldbody><body name="frame">{base}<geom size=".1 .2 .1" type="box"/><site name="r1" pos=".1 .1 0"/>'
        f'{pod}</body></body></worldbody><actuator><motor name="left" site="r2" gear="{gear}"/>'
        f'<motor name="turn" joint="tilt" gear="3"/>{right}</actuator></mujoco>'
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model, plain = model_of(text, tmp_path), mujoco.MjModel.from_xml_string(text)
    names = ("turn", *(("right",) if base else ()), "left")
    assert model.inputs == names
    oracle, generator = MujocoOracle(plain), torch.Generator().manual_seed(0)
    q = random_positions(model.robot, generator, 3)
    v, u = (torch.randn(3, n, dtype=torch.float64, generator=generator) for n in (model.robot.nv, len(names)))
    delivered = model.state(q, v, u).delivered
    for k in range(3):
        oracle.data.ctrl[[plain.actuator(name).id for name in names]] = u[k].numpy()
        oracle.at(q[k].numpy(), v[k].numpy())
        np.testing.assert_allclose(delivered[k], oracle.T.T @ oracle.data.qfrc_actuator, atol=1e-9)
    assert Model.from_json(model.to_json()).inputs == names
    if base:
        held = Model.from_mjcf(tmp_path / "loop.xml", locked={"tilt": 0.3})
        assert held.inputs == ("right", "left")
