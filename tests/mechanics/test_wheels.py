"""Wheels and balls that roll: against Pinocchio, differences along motions, and the unicycle in closed form."""

import math

import numpy as np
import pinocchio as pin
import pytest
import torch

from forcegp.errors import ContactError, InvalidInput
from forcegp.forces import ContactFriction
from forcegp.integration import onto_contacts
from forcegp.mechanics import Contact, Held, Plane, RollingContact, Sphere, rolling
from forcegp.model import Model
from forcegp.robots import Robot

BODY, AHEAD, SPIN = 8.0, 0.05, 0.3  # kg, m, kg m^2 about the centre of mass
WHEEL, RADIUS, HALF, ROLL, TURN = 0.7, 0.1, 0.2, 0.004, 0.003  # kg, m, m, kg m^2 about the axle, and across
INERTIAL = '<inertial><origin xyz="{}"/><mass value="{}"/>'
INERTIAL += '<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial>'
SIDE = """<joint name="{0}" type="continuous"><origin xyz="0 {1} 0"/><parent link="base"/><child link="{0}_wheel"/>
<axis xyz="0 1 0"/></joint><link name="{0}_wheel">{2}</link>"""
CART = (
    f'<robot name="cart"><link name="base">{INERTIAL.format(f"{AHEAD} 0 0.02", BODY, 0.2, 0.25, SPIN)}</link>'
    + "".join(
        SIDE.format(name, y, INERTIAL.format("0 0 0", WHEEL, TURN, ROLL, TURN))
        for name, y in (("left", HALF), ("right", -HALF))
    )
    + "</robot>"
)
DISC = f'<robot name="disc"><link name="disc">{INERTIAL.format("0 0 0", 2.0, 0.01, 0.02, 0.01)}</link></robot>'
CASTER = Contact("base", (0.3, 0.0, -RADIUS), Held((0.0, 0.0, 1.0)))
WHEELS = (*rolling("left_wheel", RADIUS), *rolling("right_wheel", RADIUS))


def states(robot, rows=5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    q, v = robot.random(generator, rows), torch.randn(rows, robot.nv, dtype=torch.float64, generator=generator)
    return q, v, torch.randn(rows, robot.nv, dtype=torch.float64, generator=generator)


def tilted():
    return Plane((0.2, -0.3, 1.0), 0.1)


CONTACTS = {
    "wheel": rolling("right_wheel", 0.13, (0.1, 1.0, -0.2), (0.02, 0.01, -0.03)),
    "wheel on a slope": rolling("left_wheel", 0.13, ground=tilted()),
    "ball": rolling("right_wheel", 0.13, None, (0.02, 0.01, -0.03), Held((0.2, -0.3, 1.0))),
}


@pytest.mark.parametrize("name", CONTACTS)
def test_rows_are_the_velocity_of_the_rim_by_pinocchio(name):
    """A v = t.(p' + w x arm), with the lowest point of the rim found by sampling it."""
    robot, contacts = Robot.from_urdf_text(CART, base="floating"), CONTACTS[name]
    first = contacts[0]
    q, v, _ = states(robot)
    rows = [contact.row(robot.kinematics(q, v), v) for contact in contacts]
    model = pin.buildModelFromXML(CART, pin.JointModelFreeFlyer())
    frame, data = model.getFrameId(first.frame), model.createData()
    n = np.array(first.normal)
    joints = [model.joints[model.getJointId(name)] for name in robot.joint_names[6:]]
    for k in range(len(q)):
        x, w = pin.neutral(model), v[k].numpy().copy()
        x[:7] = q[k, :7]
        for joint, angle, rate in zip(joints, q[k, 7:].tolist(), v[k, 6:].tolist(), strict=True):
            x[joint.idx_q : joint.idx_q + 2], w[joint.idx_v] = (math.cos(angle), math.sin(angle)), rate
        pin.computeJointJacobians(model, data, x)
        J = pin.computeFrameJacobian(model, data, x, frame, pin.LOCAL_WORLD_ALIGNED)
        pose = data.oMf[frame]
        p = pose.translation + pose.rotation @ np.array(first.point)
        if first.axis is None:
            arm = -first.radius * n
        else:
            across = np.linalg.svd(np.array(first.axis)[None])[2][1:]  # two directions in the wheel's plane
            angles = np.linspace(0.0, 2.0 * np.pi, 200_001)
            rim = first.radius * (np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1])
            arm = pose.rotation @ rim[np.argmin(rim @ pose.rotation.T @ n)]
        point = p - pose.translation + arm
        J = J[:3] - pin.skew(point) @ J[3:]
        for contact, row in zip(contacts, rows, strict=True):
            along = np.array(contact.surface.normal)
            np.testing.assert_allclose(contact.position(robot.kinematics(q[k])), p + arm, atol=1e-5)
            assert float(row.A[k] @ v[k]) == pytest.approx(along @ J @ w, abs=1e-4)


@pytest.mark.parametrize("name", CONTACTS)
def test_bias_is_the_derivative_along_motions(name):
    """d/dt (A v) = A a + A' v for any acceleration, and along the normal c' = A v, by central differences."""
    robot, contacts = Robot.from_urdf_text(CART, base="floating"), CONTACTS[name]
    q, v, a = states(robot, seed=1)
    h = 1e-5
    for contact in contacts:
        row = contact.row(robot.kinematics(q, v), v)
        ends = []
        for t in (h, -h):
            moved = contact.row(robot.kinematics(robot.integrate(q, t * v)))
            ends.append(((moved.A * (v + t * a)).sum(-1), moved.value))
        rate = (ends[0][0] - ends[1][0]) / (2.0 * h)
        torch.testing.assert_close(rate, (row.A * a).sum(-1) + row.drift, rtol=1e-6, atol=1e-6)
        if isinstance(contact.surface, Plane):
            slope = (ends[0][1] - ends[1][1]) / (2.0 * h)
            torch.testing.assert_close(slope, (row.A * v).sum(-1), rtol=1e-7, atol=1e-7)


def test_derivatives_pass_gradcheck():
    robot = Robot.from_urdf_text(CART, base="planar")
    contact = rolling("right_wheel", 0.13, (0.1, 1.0, -0.2))[1]
    q, v, _ = states(robot, 1)

    def function(v):
        row = contact.row(robot.kinematics(q, v), v)
        return torch.cat([row.drift[..., None], row.A], -1)

    assert torch.autograd.gradcheck(function, (v.requires_grad_(),))


def unicycle(speed, turn, left, right):
    """Accelerations (along, about z) of Lagrange's equations with the wheels' rotation eliminated."""
    mass = BODY + 2.0 * WHEEL + 2.0 * ROLL / RADIUS**2
    inertia = SPIN + BODY * AHEAD**2 + 2.0 * (TURN + WHEEL * HALF**2) + 2.0 * ROLL * HALF**2 / RADIUS**2
    along = ((left + right) / RADIUS + BODY * AHEAD * turn**2) / mass
    return along, (HALF * (right - left) / RADIUS - BODY * AHEAD * speed * turn) / inertia


@pytest.mark.parametrize("base", ["floating", "planar"])
def test_a_differential_drive_is_the_unicycle(base):
    robot = Robot.from_urdf_text(CART, base=base)
    model = Model(robot, (*WHEELS, CASTER) if base == "floating" else WHEELS)
    rng = np.random.default_rng(3)
    for _ in range(4):
        x, y, heading, speed, turn, *rest = rng.normal(size=9)
        torques = dict(zip(("left", "right"), rest[:2], strict=True))
        angles = dict(zip(("left", "right"), rest[2:], strict=True))
        names = robot.joint_names[-2:]
        side = {"left": -1.0, "right": 1.0}
        rates = [(speed + side[name] * HALF * turn) / RADIUS for name in names]
        half = 0.5 * heading
        pose = [x, y, 0.0, 0.0, 0.0, math.sin(half), math.cos(half)]
        twist = [speed, 0.0, 0.0, 0.0, 0.0, turn]
        if base == "planar":
            pose, twist = [x, y, math.cos(heading), math.sin(heading)], [speed, 0.0, turn]
        q = torch.tensor([*pose, *(angles[name] for name in names)], dtype=torch.float64)
        v = torch.tensor([*twist, *rates], dtype=torch.float64)
        u = torch.tensor([torques[name] for name in names], dtype=torch.float64)
        model.check_states(q[None], v[None], u[None])
        dynamics = model.dynamics(q, v, u)
        assert float((dynamics.A @ v).abs().max()) < 1e-12
        a = dynamics.acceleration_map().offset
        along, about = unicycle(speed, turn, torques["left"], torques["right"])
        last = robot.nv - 3
        assert float(a[0]) == pytest.approx(along, rel=1e-9)
        assert float(a[last]) == pytest.approx(about, rel=1e-9)
        assert float(a[1]) == pytest.approx(0.0, abs=1e-9)  # body axes: the turn of the axes is in v x w
        if base == "floating":
            force = dynamics.multiplier_map().offset
            weight = 9.81 * (BODY + 2.0 * WHEEL)
            assert float(force[0] + force[3] + force[6]) == pytest.approx(weight, rel=1e-9)


def test_a_rolling_disc_keeps_its_energy_and_does_not_slip():
    """A coin that wobbles: the fourth-order method on the manifold, kinetic and potential energy."""
    robot = Robot.from_urdf_text(DISC, base="floating")
    ground = Plane((0.0, 0.0, 1.0), 0.0)
    model = Model(robot, rolling("disc", 0.15, ground=ground))
    q, v = robot.neutral(), torch.zeros(6, dtype=torch.float64)
    q[2], v[3], v[4], v[5] = 0.15, 0.3, 8.0, 0.5
    q, v = (x[0] for x in onto_contacts(model, q[None], v[None]))

    def energy(q, v):
        return float(0.5 * v @ robot.mass_matrix(q) @ v + 2.0 * 9.81 * q[2])

    def slope(q, v, step, speed):
        at = robot.integrate(q, step) if step is not None else q
        w = v + speed if speed is not None else v
        return w, model.dynamics(at, w, v[:0]).acceleration_map().offset

    start, dt, heights = energy(q, v), 2e-3, []
    for _ in range(250):
        w1, a1 = slope(q, v, None, None)
        w2, a2 = slope(q, v, 0.5 * dt * w1, 0.5 * dt * a1)  # midpoint: second order
        q, v = robot.integrate(q, dt * w2), v + dt * a2
        heights.append(float(q[2]))
    assert energy(q, v) == pytest.approx(start, rel=2e-5)
    assert np.ptp(heights) > 1e-3  # it does wobble
    c, rate = ConstraintManifold(model).violation(q, v)
    assert float(c.abs().max()) < 1e-4
    assert float(rate.abs().max()) < 1e-3


def test_a_wheel_off_the_ground_is_free():
    robot = Robot.from_urdf_text(CART, base="floating")
    lifted = Model(robot, rolling("left_wheel", RADIUS, switch="down"))
    q, v, u = states(robot)
    flags = torch.zeros(len(q), 1).double()
    a = lifted.dynamics(q, v, torch.cat([u[:, :2], flags], -1)).acceleration_map().offset
    free = Model(robot).dynamics(q, v, u[:, :2]).acceleration_map().offset
    torch.testing.assert_close(a, free)


def test_what_is_no_wheel_is_refused():
    for wrong, message in (
        (lambda: rolling("w", 0.0), "radius is 0.0; it must be positive"),
        (lambda: rolling("w", 0.1, (0.0, 0.0, 0.0)), "give a direction"),
        (lambda: rolling("w", 0.1, ground=Sphere((0.0, 0.0, 0.0), 1.0)), "the ground is a Sphere"),
        (lambda: RollingContact("w", (0.0, 0.0, 0.0), Sphere((0.0, 0.0, 0.0), 1.0)), "surface is a Sphere"),
    ):
        with pytest.raises(InvalidInput, match=message):
            wrong()
    model = Model(Robot.from_urdf_text(CART, base="planar"), WHEELS)
    with pytest.raises(InvalidInput, match="no contact with a surface"):
        ContactFriction(contact=0).check(model.robot, model.contacts)
    flat = Model(Robot.from_urdf_text(DISC, base="floating"), rolling("disc", 0.1))
    q = flat.robot.neutral()
    q[3], q[6] = math.sqrt(0.5), math.sqrt(0.5)  # its axis is vertical
    with pytest.raises(ContactError, match="contact 0"):
        flat.check_states(q[None], torch.zeros(1, 6).double(), torch.zeros(1, 0).double())
