"""Torque sensors behind the gears as evidence: MuJoCo's own between the bodies, and logs with a mistake planted."""

from dataclasses import replace
from functools import cache

import mujoco as untyped
import numpy as np
import pytest
from tests.cli.in_process import run_here
from tests.evidence.arm_in_mujoco import followed
from tests.posterior.arm import URDF, arm_model

from forcegp import JointTorques, Torques, check, fit, load_posterior
from forcegp.data import Dataset
from forcegp.data.dataset import TORQUE
from forcegp.errors import InvalidInput
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.fit.physical import typical_sizes
from forcegp.fit.sensors import torque_sensor_doubts
from forcegp.forces import Actuation, Coulomb, LoadFriction, Payload, RigidBodies, Rotor, Spring, Viscous

mujoco = untyped
JOINTS, AXES = ("pan", "lift", "bend"), (2, 1, 1)
GAIN, ROTOR = np.array([0.5, 2.0, 1.4]), np.array([0.1, 0.15, 0.04])
DAMPING, DRY = np.array([0.8, 0.7, 0.5]), np.array([0.3, 0.4, 0.2])
TRUTH = {"gain": GAIN, "rotor": ROTOR, "viscous": DAMPING, "coulomb.level": DRY}
STIFFNESS, RATE, NOISE = np.array([0.0, 6.0, 0.0]), 250, (0.05, 0.03)


def with_torque_sensors(spec):
    for body in ("upper", "fore", "hand"):
        spec.body(body).add_site(name=body)
        spec.add_sensor(type=mujoco.mjtSensor.mjSENS_TORQUE, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=body)
    model = spec.compile()
    model.dof_armature[:] = ROTOR
    return model


@cache
def recorded(spring=False):
    """An arm with rotors and friction in its gears that follows sines: currents, and torques between its bodies."""

    def taken(q, v):
        return DRY * np.tanh(v / 0.01) + spring * STIFFNESS * q

    (q, v, u, a, sensors), rng = followed(with_torque_sensors, 12, RATE, 5, taken)
    u, torque = u / GAIN, sensors.reshape(-1, 3, 3)[:, range(3), AXES] + spring * STIFFNESS * q
    u, torque = (x + noise * rng.standard_normal(x.shape) for x, noise in zip((u, torque), NOISE, strict=True))
    at_links = {f"{TORQUE}{name}": x[:, None] for name, x in zip(JOINTS, torque.T, strict=True)}
    return Dataset(q=q, v=v, u=u, a=a, time=np.arange(len(q)) / RATE, model=arm_model(0), measured=at_links)


GEARS = Actuation(gain=None), RigidBodies("all"), Viscous(), Coulomb(velocity_scale=0.01), Rotor()


def test_gears_and_bodies_are_told_apart_and_currents_calibrated():
    log = recorded()
    posterior = fit(log.model.with_forces(*GEARS), log)
    at_links = np.concatenate([*(log.measured[f"{TORQUE}{name}"] for name in JOINTS)], axis=1)
    for j, name in enumerate(JOINTS):
        # gain u - torque = rotor a + damping v + level sign(v) of each joint by itself: total least squares
        gear = np.c_[log.a[:, j], log.v[:, j], np.tanh(log.v[:, j] / 0.01)]
        both = np.c_[log.u[:, j] / NOISE[0], at_links[:, j] / NOISE[1]]
        n = np.linalg.svd(both - gear @ np.linalg.lstsq(gear, both, rcond=None)[0], full_matrices=False)[2][1]
        gain = -n[0] / n[1] * NOISE[1] / NOISE[0]
        alone = [gain, *np.linalg.lstsq(gear, gain * log.u[:, j] - at_links[:, j], rcond=None)[0]]
        for k, (law, true) in enumerate(TRUTH.items()):
            found = posterior.parameters[f"{law}.{name}"]
            assert found.value == pytest.approx(alone[k], rel=0.02), (law, name)
            assert abs(found.value - true[j]) < 0.75 * np.ptp(found.interval), (law, name)
            assert np.ptp(found.interval) < 0.1 * true[j], (law, name)


def changed(**columns):
    log = recorded()
    return replace(log, measured={**log.measured, **{f"{TORQUE}{name}": x for name, x in columns.items()}})


def at(name):
    return recorded().measured[f"{TORQUE}{name}"]


@pytest.mark.parametrize(
    ("columns", "level", "words"),
    [
        ({}, "ok", "lift differs by 0.0"),
        ({"lift": -at("lift")}, "wrong", "lift has the other sign; it varies by 1.2"),
        ({"bend": 1e3 * at("bend")}, "wrong", "bend shows 1001 times what bodies need there"),
        ({"lift": at("bend"), "bend": at("lift")}, "wrong", "lift shows the torque of bend"),
        ({"lift": 1.08 * at("lift")}, "look", "lift shows 1.0"),
        ({"bend": at("bend") - 0.4}, "look", "and -0.4 Nm more"),
        ({"pan": at("pan") + np.linspace(0.0, 0.1, 3000)[:, None]}, "look", "pan drifts by 0.1 Nm over the log"),
        ({"lift": at("bend") + 0.1 * np.sin(np.arange(3000.0) / 25.0)[:, None]}, "look", "of lift "),
        ({"pan": 0.0 * at("pan")}, "look", "pan does not follow what bodies need there; it varies by 0 Nm"),
        ({"pan": np.random.default_rng(0).normal(size=at("pan").shape)}, "look", "pan does not follow"),
        ({"lift": np.roll(at("lift"), 5, axis=0)}, "look", "lift is logged 21.2 ms later"),
    ],
)
def test_check_names_what_is_wrong_and_fit_refuses_it(columns, level, words):
    log = changed(**columns)
    found = [*torque_sensor_doubts(log, log.model)] if columns else check(log).doubts  # which asks these
    said = [doubt for doubt in found if "sensor" in doubt.about]
    assert [str(doubt) for doubt in said if doubt.level == level and words in str(doubt)], str([*map(str, found)])
    assert {"ok": 0, "look": 1, "wrong": 2}[level] == max({"ok": 0, "look": 1, "wrong": 2}[each.level] for each in said)
    if level == "wrong":
        with pytest.raises(InvalidInput, match="sensor at the link of"):
            fit(log.model.with_forces(*GEARS), log)


@pytest.mark.parametrize("evidence", [Torques(), Torques("both"), Torques(mean=0.02)], ids=str)
def test_springs_between_links_are_seen_at_both_sides_of_a_gear(evidence):
    log = recorded(spring=True)
    laws = Actuation(gain=GAIN), Spring(rest=0.0), Viscous(), Coulomb(velocity_scale=0.01), Rotor()
    found = fit(log.model.with_forces(*laws), log, [evidence, JointTorques()]).parameters
    for law, true in {**TRUTH, "spring.stiffness": STIFFNESS}.items():
        if law != "gain":
            np.testing.assert_allclose([found[f"{law}.{name}"].value for name in JOINTS], true, atol=0.01, err_msg=law)


def test_derivatives_are_those_of_finite_differences():
    log = recorded(spring=True).rows(slice(0, None, 300))
    forces = Actuation(), RigidBodies("all"), Spring(), LoadFriction(), Rotor(), Payload("hand")
    space = ParameterSpace(log.model.with_forces(*forces), typical_sizes(log.model, [log]))
    rows = RecordedRows(space, log.q, log.v, log.u, sensed=log.measured)
    x, motion = space.start + 0.1 * np.sin(np.arange(space.size)), rows.moving(log.a)
    _, Y, in_x, _ = rows.in_torque(x, motion)
    plain = RecordedRows(space, log.q, log.v, log.u)
    for beside, alone in zip(rows.in_acceleration(x, log.a), plain.in_acceleration(x, log.a), strict=True):
        assert np.array_equal(beside, alone)  # of which no torque tells anything
    found = np.concatenate([space.bodies.chained(x[: space.bodies.size], Y), in_x], axis=-1)
    for k, step in enumerate(1e-6 * np.eye(space.size)):
        ahead, behind = (rows.in_torque(x + s * step, motion)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(found[..., k], (ahead - behind) / 2e-6, atol=1e-6)


@pytest.mark.nightly
def test_from_columns_that_are_clipped_to_a_fit(tmp_path):
    log, at_links = recorded(), [1e3 * at(name)[:, 0] for name in JOINTS]
    at_links[1] = np.maximum(at_links[1], -2900.0)
    names = "t,q1,q2,q3,i1,i2,i3,s1,s2,s3"
    np.savetxt(tmp_path / "log.csv", np.c_[log.time, log.q, log.u, *at_links], delimiter=",", header=names, comments="")
    (tmp_path / "arm.urdf").write_text(URDF)
    words = ["--time", "t", "--q", "q1,q2,q3", "--u", "i1,i2,i3", "--robot", "arm.urdf", "--unit", "torque=mNm"]
    words += ["--force", "torque=s1,s2,s3", "--cutoff", "15", "--every", "3", "--trim", ".04", "--out", "log.h5"]
    done, clipped = run_here("import", "log.csv", *words, folder=tmp_path), int((at_links[1] == -2900.0).sum())
    assert (
        f"torque.lift (torque) stays at -2.9, an end of its range: {clipped} rows left out; --trim their" in done.stderr
    ), done
    rows = Dataset.load(tmp_path / "log.h5")
    assert len(rows) < (3100 - clipped) / 3
    assert check(rows).doubts.of("saturation").level == "ok"
    done = run_here("fit", "log.h5", "--forces", "gain,viscous,coulomb,rotor", "--out", "run", folder=tmp_path)
    assert "evidence: torques, and joint-torques" in done.stderr
    assert abs(load_posterior(tmp_path / "run").parameters["gain.lift"].value - GAIN[1]) < 0.02
    done = run_here("payload", "log.h5", "--forces", "gain,viscous,coulomb,rotor", folder=tmp_path)
    assert "as right as the torques of the log" in done.stderr
    two = {name: x for name, x in rows.measured.items() if "lift" not in name}
    replace(rows, measured=two).save(tmp_path / "two.h5")
    refused = run_here("payload", "log.h5", "--baseline", "two.h5", folder=tmp_path)
    assert "a baseline needs torque sensors at the same links as the log" in refused.stderr
    mass = next(line.split() for line in done.stdout.splitlines() if line.split()[:1] == ["mass"])
    assert abs(float(mass[2])) < 0.01  # it carries nothing; without the sensors .1 +- .2 kg
    said = check(changed(lift=np.maximum(at("lift"), -2.9))).doubts.of("saturation")
    assert f"sensor torque.lift (torque) stays at its smallest value -2.9 in {clipped} rows of motion" in str(said)
