"""Arms whose gears are LuGre's: timing, numbers, payload, tracking and pushes, over least squares without memory."""

import numpy as np
import pytest
from tests.simulation.lugre_arm import ENCODER, NOISE_V, STEP, LuGreArm, reference

from forcegp import ContactMonitor, Torques, fit
from forcegp.control import ComputedTorque
from forcegp.data import Preparation
from forcegp.forces import parse_forces

STEADY, GEARS = "viscous,coulomb,offset,rotor", "viscous,gear,offset,rotor"
LINK = "lbr_iiwa_link_7"


def prepared(arm: LuGreArm, seconds: float, every: int = 1):
    return Preparation(cutoff="auto", delay="auto", trim=0.5, every=every).apply(arm.log(1000 + arm.seed, seconds))


@pytest.fixture(scope="module")
def learned():
    """An arm, and what one log says of it without and with memory."""
    arm = LuGreArm(1)
    log = prepared(arm, 60.0)
    known = {laws: log.model.with_forces(*parse_forces(f"bodies,{laws}")) for laws in (STEADY, GEARS)}
    return arm, {laws: fit(model, log, Torques()) for laws, model in known.items()}


@pytest.mark.parametrize(
    ("seed", "seconds"), [(1, 8.0), *(pytest.param(k, 60.0, marks=pytest.mark.nightly) for k in range(1, 7))]
)
def test_timing_rotors_and_payload(seed, seconds):
    arm = LuGreArm(seed)
    log = prepared(arm, seconds, every=1 if seconds == 60.0 else 4)
    assert abs(log.metadata["preparation"]["delay"] + 0.003) < 0.002, "half a step is that of u, which is held"
    posterior = fit(log.model.with_forces(*parse_forces(f"{GEARS},payload:{LINK}")), log, Torques(mean=0.4))
    numbers = posterior.parameters
    rotors = np.array([numbers[f"rotor.{joint}"].value for joint in log.joint_names])
    np.testing.assert_allclose(rotors, arm.rotors, rtol=0.1 if seconds < 60.0 else 0.05)
    assert all("memory" in parts for parts in posterior.settings["gear_friction"]["parts"].values())
    assert numbers["payload.mass"].value == pytest.approx(arm.mass, rel=0.01)
    for axis, true in zip("xyz", arm.center, strict=True):
        assert numbers[f"payload.center_of_mass.{axis}"].value == pytest.approx(true, abs=3e-3)


def tracking_error(arm: LuGreArm, posterior, seed: int) -> float:
    """Root mean square error [rad] of a motion of 8 s under computed torque, behind its first half second."""
    (q_d, v_d, a_d), noise = reference(seed, 8.0), np.random.default_rng(seed)
    controller = ComputedTorque(posterior.predictor(), stiffness=100.0, torque_limits=1e4)

    def control(k: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        seen = np.round(q / ENCODER) * ENCODER, v + NOISE_V * noise.standard_normal(7)
        return controller(*seen, q_d[k], v_d[k], a_d[k]).numpy()

    return float(np.sqrt(np.square(arm.move(q_d[0], len(q_d), control)[500:, 0] - q_d[500:]).mean()))


@pytest.mark.nightly
def test_a_controller_that_remembers_tracks_better(learned):
    arm, posteriors = learned
    steady, gears = (tracking_error(arm, posteriors[laws], 100) for laws in (STEADY, GEARS))
    print(f"tracking {1e3 * steady:.2f} mrad without, {1e3 * gears:.2f} with memory")
    assert gears < 0.4 * steady


@pytest.mark.nightly
def test_pushes_are_felt_through_gears(learned):
    arm, posteriors = learned
    free = [arm.log(seed, 60.0, late=0.0) for seed in (300, 301)]
    quiet, found = arm.log(302, 150.0, late=0.0), {}
    for laws, posterior in posteriors.items():
        monitor = ContactMonitor(posterior.model, dt=STEP)
        monitor.calibrate([(each.q, each.v, each.u) for each in free])
        silent = not monitor.run(quiet.q, quiet.v, quiet.u).alarm.any()
        assert silent or laws == STEADY
        for force in (5.0, 10.0):
            rng, pushes = np.random.default_rng(int(force)), []
            for k in range(30):
                way = rng.standard_normal(3)
                pushes.append((3.0 + 2.5 * k, (4, 6, 7)[k % 3], force * way / np.linalg.norm(way)))
            log = arm.log(400 + int(force), 78.0, late=0.0, pushes=tuple(pushes))
            alarm = monitor.run(log.q, log.v, log.u).alarm.numpy()
            hits = [alarm[(log.time >= begin) & (log.time < begin + 0.7)].any() for begin, *_ in pushes]
            found[laws, force] = float(np.mean(hits)) if silent else 0.0  # alarms that come anyway tell nothing
    assert found[GEARS, 5.0] >= 0.5
    assert found[GEARS, 10.0] >= 0.95
    assert found[GEARS, 5.0] > found[STEADY, 5.0] + 0.5
