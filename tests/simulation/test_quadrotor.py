"""`quadrotor`: rows obey Newton and Euler."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forcegp.simulation import QuadrotorConfig, moving_bases, simulate_quadrotor

PLACES = np.array([(0.13, -0.13, 0.02), (-0.13, 0.13, 0.02), (0.13, 0.13, 0.02), (-0.13, -0.13, 0.02)])


def pushed(robot, height, R, V, speeds, air):
    """Accelerations in the axes of the body: Mahony, Kumar & Corke 2012; drag of rotors, thrust near the ground."""
    link, flow, w = robot.link("body"), V[:3] - R.T @ air, speeds.mean()
    lost = 1.0 - 0.9 * flow[2] / (0.127 * w) + 2.0 * (flow[0] ** 2 + flow[1] ** 2) / (0.127 * w) ** 2
    thrust = 1.1e-5 * speeds**2 * lost / (1.0 - 1.5 * (0.127 / (4.0 * max(height, 0.1905))) ** 2)
    drag = -np.array([0.022, 0.034, 0.06]) * np.linalg.norm(flow) * flow
    force = drag - np.array([9e-5, 11e-5, 4e-5]) * speeds.sum() * flow + [0.0, 0.0, thrust.sum()]
    moment = np.cross([0.01, -0.006, 0.02], drag) + 0.006 * np.array([-flow[1], flow[0], 0.0])
    for place, each, spin in zip(PLACES, thrust, (0.016, 0.016, -0.016, -0.016), strict=True):
        moment = moment + np.cross(place, [0.0, 0.0, each]) + [0.0, 0.0, spin * each]
    turned = np.linalg.solve(link.inertia, moment - np.cross(V[3:], link.inertia @ V[3:]))
    return np.concatenate([force / link.mass - 9.81 * R[2] - np.cross(V[3:], V[:3]), turned])


@pytest.mark.parametrize("wind", [pytest.param(0.0, marks=pytest.mark.nightly), 7.0])
def test_it_flies_by_newton_euler_and_the_published_air(wind, monkeypatch):
    """In steady wind, behind rotors of first order; from row to row by small steps."""
    monkeypatch.setattr(moving_bases, "GUST", 0.0)
    lag, dt = 0.05, 1.0 / 240.0
    data = simulate_quadrotor(QuadrotorConfig(seconds=2.0, seed=3, wind=wind, noise=0.0, lag=lag, episodes=1))
    air, robot, speeds = np.array(data.metadata["wind"][0]), data.model.robot, np.array(data.u[0])
    assert np.linalg.norm(air) == pytest.approx(wind)
    for k in range(len(data) - 1):
        x, V, R = data.q[k, :3], data.v[k], Rotation.from_quat(data.q[k, 3:]).as_matrix()
        if k > 300:  # the rotors at the first row are not known
            np.testing.assert_allclose(data.truth["a"][k], pushed(robot, x[2], R, V, speeds, air), rtol=0, atol=1e-6)
        for part in np.full(40, dt / 40) if k in (301, 400) else ():
            now = data.u[k] + (speeds - data.u[k]) * np.exp(-0.5 * part / lag)
            half = V + 0.5 * part * pushed(robot, x[2], R, V, now, air)
            middle = R @ Rotation.from_rotvec(0.5 * part * V[3:]).as_matrix()
            x, V = x + part * middle @ half[:3], V + part * pushed(robot, x[2], middle, half, now, air)
            R = R @ Rotation.from_rotvec(part * half[3:]).as_matrix()
            speeds = data.u[k] + (speeds - data.u[k]) * np.exp(-part / lag)
        if k in (301, 400):
            np.testing.assert_allclose(np.r_[x, V], np.r_[data.q[k + 1, :3], data.v[k + 1]], rtol=0, atol=2e-5)
            np.testing.assert_allclose(R, Rotation.from_quat(data.q[k + 1, 3:]).as_matrix(), rtol=0, atol=1e-5)
        else:
            speeds = data.u[k] + (speeds - data.u[k]) * np.exp(-dt / lag)
