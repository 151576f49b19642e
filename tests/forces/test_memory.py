"""A law with a state: its scan over episodes, its coefficient from a log, its state in motions and in programs."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_model

from forcegp import Accelerations, Dataset, JointFriction, Torques, export_c, fit
from forcegp.data import with_memory
from forcegp.errors import InvalidInput
from forcegp.forces import FORCES, Coefficient, JointLaw
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise

SIGMA, DT = 40.0, 0.01


@dataclass(frozen=True, eq=False)
class Bristle(JointLaw):
    """-c z with z' = sigma (sign(dq) - z) |dq|: exact over a step that does not turn back (Dahl's model)."""

    level: object = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"level": Coefficient()}

    def memory_names(self, robot):
        return tuple(f"bristle of {joint}" for joint in robot.joint_names)

    def remember(self, memory, step, dt):
        toward = step.sign()
        return toward + (memory - toward) * torch.exp(-SIGMA * step.abs())

    def features(self, state):
        return (self.remembered(state),)

    def amplitude(self, features, parameters):
        return -parameters["level"] * features[0]


@pytest.fixture(autouse=True, scope="module")
def registered():
    FORCES["bristle"] = Bristle
    yield
    del FORCES["bristle"]


LEVEL = [0.8, 0.5, 0.3]


def bristles_by_hand(q: np.ndarray) -> np.ndarray:
    """Row by row, in numpy."""
    z = np.zeros_like(q)
    for k in range(1, len(q)):
        step = q[k] - q[k - 1]
        z[k] = np.sign(step) + (z[k - 1] - np.sign(step)) * np.exp(-SIGMA * abs(step))
    return z


@pytest.fixture(scope="module")
def log() -> Dataset:
    """Smooth motions in two episodes, and the torques that they need with bristles in every joint."""
    rng, time = np.random.default_rng(0), DT * np.arange(300)
    parts = []
    for _ in range(2):
        w, phase, size = rng.uniform(1.0, 5.0, (2, 3)), rng.uniform(0.0, 6.0, (2, 3)), rng.uniform(0.1, 0.4, (2, 3))
        at = w * time[:, None, None] + phase
        q, v, a = (size * np.sin(at)).sum(1), (size * w * np.cos(at)).sum(1), -(size * w * w * np.sin(at)).sum(1)
        u = arm_model(0).robot.inverse_dynamics(*map(torch.tensor, (q, v, a))).numpy() + LEVEL * bristles_by_hand(q)
        parts.append((q, v, u, a))
    q, v, u, a = (np.concatenate(x) for x in zip(*parts, strict=True))
    return Dataset(q=q, v=v, u=u, a=a, time=np.tile(time, 2), episode=np.repeat([0, 1], 300), model=arm_model(0))


def test_the_scan_begins_anew_in_every_episode(log):
    model = arm_model(0).with_forces(Bristle(LEVEL))
    assert model.inputs == ("pan", "lift", "bend", *(f"bristle of {joint}" for joint in ("pan", "lift", "bend")))
    found = with_memory(log, model)
    expected = np.concatenate([bristles_by_hand(log.q[:300]), bristles_by_hand(log.q[300:])])
    np.testing.assert_allclose(found.u[:, 3:], expected, atol=1e-12)
    np.testing.assert_array_equal(with_memory(found.rows(slice(0, 600, 7)), model).u, found.u[::7])
    residual = model.dynamics(*map(torch.tensor, (log.q, log.v, found.u))).acceleration_map().offset.numpy() - log.a
    assert abs(residual).max() < 1e-9


@pytest.mark.parametrize("evidence", [Torques(), Accelerations()], ids=str)
def test_its_coefficient_is_found(log, evidence):
    noisy = replace(log, u=log.u + 0.01 * np.random.default_rng(1).standard_normal(log.u.shape))
    found = fit(arm_model(0).with_forces(Bristle()), noisy, evidence)
    values = [found.parameters[f"bristle.{joint}"].value for joint in ("pan", "lift", "bend")]
    np.testing.assert_allclose(values, LEVEL, rtol=0.05)


def test_motions_carry_the_state_along(log):
    model = arm_model(0).with_forces(Bristle(LEVEL), noise=Noise(1e-3))
    posterior = fit(model, log)
    u = np.concatenate([log.u[:40], np.zeros((40, 3))], axis=1)
    u[0, 3:] = [0.5, -0.2, 0.0]
    moved = posterior.rollout(log.q[0], log.v[0], u, DT)
    q, v, z = (torch.tensor(x) for x in (log.q[0], log.v[0], u[0, 3:]))
    law = model.laws[-1]
    for k in range(40):  # symplectic Euler, written out
        a = model.dynamics(q, v, torch.cat([torch.tensor(log.u[k]), z])).acceleration_map().offset
        v = v + DT * a
        z = law.remember(z, DT * v, DT)
        q = q + DT * v
    torch.testing.assert_close(moved.q[-1], q, rtol=1e-9, atol=1e-10)
    forgetful = posterior.rollout(log.q[0], log.v[0], np.concatenate([u[:1], u[:1].repeat(39, 0)]), DT)
    assert float((forgetful.q[-1] - q).abs().max()) > 1e-3  # other torques; the state is not frozen into u


def test_sampled_motions_each_have_their_own_state(log):
    model = arm_model(0).with_forces(Bristle(LEVEL), JointFriction(), noise=Noise(1e-3))
    few = fit(model, log, points=30, restarts=1, options=OptimizerOptions(iterations=5))
    u = np.concatenate([log.u[:10], np.zeros((10, 3))], axis=1)
    moved = few.rollout(log.q[0], log.v[0], u, DT, samples=4)
    assert moved.samples.q.shape == (4, 11, 3)
    assert bool(torch.isfinite(moved.samples.q).all())


def test_a_program_takes_the_state_as_columns_of_u(log, tmp_path):
    posterior = fit(arm_model(0).with_forces(Bristle(LEVEL), noise=Noise(1e-3)), log)
    export_c(posterior, tmp_path / "made", name="arm")  # compiled, and compared with predict, where it is written
    assert "const double u[6]" in (tmp_path / "made" / "arm.h").read_text(encoding="utf-8")


def test_rows_without_an_order_have_no_past(log):
    shuffled = log.rows(np.random.default_rng(0).permutation(len(log)))
    with pytest.raises(InvalidInput, match="bristle remembers, and the rows are not in order of time"):
        fit(arm_model(0).with_forces(Bristle()), shuffled)
