"""Filters and derivatives of positions that are points of a manifold, against a body that tumbles in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.robots.test_moving_bases import LIMBS

from forcegp.data import Dataset, Preparation, differentiated, low_pass, motion_spectrum
from forcegp.errors import DatasetError
from forcegp.mechanics import fixed_point
from forcegp.model import Model
from forcegp.robots import Robot

RATE, SECONDS = 240.0, 4.0


def euler(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Yaw that grows through whole turns, pitch and roll; omega and its rate in body axes, by the usual formulas."""
    yaw, dyaw, ddyaw = 2.1 * t, np.full_like(t, 2.1), np.zeros_like(t)
    pitch, dpitch, ddpitch = 0.6 * np.sin(3 * t), 1.8 * np.cos(3 * t), -5.4 * np.sin(3 * t)
    roll, droll, ddroll = 1.0 * np.sin(2 * t), 2.0 * np.cos(2 * t), -4.0 * np.sin(2 * t)
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    turned = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], 1))
    omega = np.stack([droll - dyaw * sp, dpitch * cr + dyaw * sr * cp, -dpitch * sr + dyaw * cr * cp], 1)
    rate = np.stack(
        [
            ddroll - ddyaw * sp - dyaw * cp * dpitch,
            ddpitch * cr - dpitch * sr * droll + ddyaw * sr * cp + dyaw * (cr * droll * cp - sr * sp * dpitch),
            -ddpitch * sr - dpitch * cr * droll + ddyaw * cr * cp - dyaw * (sr * droll * cp + cr * sp * dpitch),
        ],
        1,
    )
    return turned, omega, rate


def tumbling(
    base: str = "floating", rate: float = RATE, world: Rotation | None = None, shift=(0.0, 0.0, 0.0)
) -> Dataset:
    """A crab whose trunk tumbles along a curve, exactly; `world` turns, `shift` moves everything."""
    t = np.arange(round(SECONDS * rate)) / rate
    turned, omega, omega_rate = euler(t)
    p = np.stack([np.sin(2 * t), 0.5 * np.cos(3 * t), 0.2 * t * t], 1)
    dp = np.stack([2 * np.cos(2 * t), -1.5 * np.sin(3 * t), 0.4 * t], 1)
    ddp = np.stack([-4 * np.sin(2 * t), -4.5 * np.cos(3 * t), np.full_like(t, 0.4)], 1)
    linear = turned.inv().apply(dp)
    linear_rate = turned.inv().apply(ddp) - np.cross(omega, linear)
    if world is not None:
        p, turned = world.apply(p) + shift, world * turned
    joints = [0.3 * np.sin(2 * t), 0.4 * np.cos(3 * t), 0.2 + 0.1 * np.sin(t)]
    djoints = [0.6 * np.cos(2 * t), -1.2 * np.sin(3 * t), 0.1 * np.cos(t)]
    ddjoints = [-1.2 * np.sin(2 * t), -3.6 * np.cos(3 * t), -0.1 * np.sin(t)]
    q, v, a = turned.as_quat(), omega, omega_rate
    if base == "floating":
        q, v, a = (np.concatenate(x, 1) for x in ((p, q), (linear, v), (linear_rate, a)))
    model = Model(Robot.from_urdf_text(LIMBS, base=base), fixed_point("a_foot", (0.0, 0.0, 0.0), switch="down"))
    u = np.stack([np.sin(5 * t), np.cos(4 * t), np.sin(3 * t), (t % 1.0 < 0.5).astype(float)], 1)
    q, v, a = (np.column_stack([x, *more]) for x, more in ((q, joints), (v, djoints), (a, ddjoints)))
    return Dataset(q=q, v=v, u=u, a=a, time=t, model=model)


def jumbled(log: Dataset) -> Dataset:
    q, turn = log.q.copy(), slice(3, 7)
    q[:, turn] *= np.random.default_rng(0).choice([-1.0, 1.0], len(q))[:, None]
    return replace(log, q=q)


def test_velocities_and_accelerations_of_a_tumbling_body():
    coarse, fine, errors = tumbling(), tumbling(rate=2 * RATE), []
    for log in (coarse, fine):
        found = differentiated(jumbled(log), "q")
        errors.append([np.abs(found.v - log.v).max(), np.abs(found.a - log.a)[3:-3].max()])
    assert errors[0][0] < 4e-3
    assert errors[0][1] < 2e-2
    np.testing.assert_array_less(np.array(errors[1]) * 3.5, errors[0])  # of second order


@pytest.mark.parametrize("how", [{}, {"differentiate": "v"}])
def test_neither_signs_nor_the_frame_of_the_world_matter(how):
    generator, world = np.random.default_rng(2), Rotation.from_rotvec([0.4, -1.9, 0.8])
    one, other = tumbling(), jumbled(tumbling(world=world, shift=(1.0, -2.0, 0.5)))
    bump = torch.tensor(1e-3 * generator.normal(size=one.v.shape))
    one, other = (
        replace(x, q=x.model.robot.integrate(torch.tensor(x.q), bump).numpy(), v=x.v + bump.numpy())
        for x in (one, other)
    )
    a, b = (Preparation(cutoff=10.0, every=2, trim=0.2, delay=0.004, **how).apply(x) for x in (one, other))
    np.testing.assert_allclose(a.v, b.v, atol=1e-9)
    np.testing.assert_allclose(a.a, b.a, atol=1e-8)
    np.testing.assert_allclose(a.u, b.u)
    np.testing.assert_allclose(world.apply(a.q[:, :3].copy()) + np.array([1.0, -2.0, 0.5]), b.q[:, :3], atol=1e-12)
    np.testing.assert_allclose(*(motion_spectrum(x).density for x in (one, other)), rtol=1e-6, atol=1e-18)


def test_what_no_filter_can_follow_is_refused():
    log = tumbling()
    q = log.q.copy()
    q[300:, 3:7] = (Rotation.from_quat(q[300:, 3:7]) * Rotation.from_rotvec([2.0, 0.0, 0.0])).as_quat()
    with pytest.raises(DatasetError, match="'base' turns by more than 90 degrees after row 299"):
        differentiated(replace(log, q=q), "q")
    spin = torch.tensor(log.time)[:, None] * torch.tensor([0, 0, 0, 0, 0, 90.0, 0, 0, 0]).double()
    fast = replace(log, q=log.model.robot.integrate(torch.tensor(log.q[:1]), spin).numpy())
    with pytest.raises(DatasetError, match="episode 0: 'base' turns faster than the filter passes"):
        low_pass(fast, 3.0)
    found = Preparation(delay="auto").resolved(replace(log, model=Model(log.model.robot), u=log.u[:, :3]))
    assert found.delay == 0.0
    assert found.why["delay"].startswith("u is taken to be on time: a delay is found from the torque of every joint")


def by_sensors(factor=1.0):
    """A base that tumbles: noise of .5 mm and .8 mrad on its pose, of sensors on v and a, which has a bias, too."""
    log, noise = tumbling(), np.random.default_rng(3).normal
    steps = noise(size=(len(log), 9)) * ([5e-4] * 3 + [8e-4] * 3 + [0.0] * 3)
    q = log.model.robot.integrate(torch.tensor(log.q), torch.tensor(steps)).numpy()
    a = np.where(np.arange(9) < 6, factor * log.a + 0.2 + 0.08 * noise(size=log.a.shape), log.a)
    return replace(log, q=q, v=log.v + 0.01 * noise(size=log.v.shape), a=a)


def test_a_base_keeps_what_sensors_measured_where_its_pose_is_noisier():
    raw, true, chosen = by_sensors(), low_pass(tumbling(), 20.0), Preparation(cutoff=20.0, trim=0.5)
    alone, errors = replace(raw, **{name: getattr(differentiated(raw, "q"), name) for name in "va"}), {}
    for name, log in (("sensors", raw), ("pose", alone)):
        found = chosen.apply(log)
        left = true.rows(np.searchsorted(true.time, found.time))
        errors[name] = np.stack([found.v - left.v, found.a - left.a])[:, :, :6]
    assert (errors["sensors"].std(1) < [[0.0048], [0.11]]).all()  # twice the frequency of SLOW leaves .005 and .2
    assert (errors["pose"].std(1) > 2.5 * errors["sensors"].std(1)).all()
    assert np.abs(errors["sensors"][1].mean(0)).max() < 0.01  # of a bias of .2
    unmeasured = chosen.apply(replace(raw, v=0.0 * raw.v, a=0.0 * raw.a))
    expected = differentiated(low_pass(raw, 20.0, signals=("q", "u")), "q").a
    np.testing.assert_array_equal(unmeasured.a, expected[np.searchsorted(raw.time, unmeasured.time)])
    wrong = by_sensors(1.6)  # as its v measured it, once a does not follow the pose
    expected = chosen.apply(replace(wrong, a=differentiated(wrong, "v").a)).a
    np.testing.assert_allclose(chosen.apply(wrong).a[:, :3], expected[:, :3], rtol=0.0, atol=0.02)
