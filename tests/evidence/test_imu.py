"""IMUs as evidence: better accelerations, small turns, and from columns to a fit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cli.in_process import run_here
from tests.data.test_imu import NAME, TURN, changed, recorded, turned
from tests.posterior.arm import URDF

from forcegp import Accelerations, FrameAcceleration, Torques, fit, load_posterior, save_posterior
from forcegp.data import Dataset, Preparation
from forcegp.data.dataset import IMU, imu_place
from forcegp.errors import InvalidInput
from forcegp.forces import JointForces, RigidBodies, Viscous
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise

QUICK = {"restarts": 1, "options": OptimizerOptions(iterations=8)}


def missed(posterior, true):
    return np.sqrt(((posterior.predict(true.q, true.v, true.u).mean.numpy() - true.a) ** 2).mean(0))


@pytest.mark.filterwarnings("ignore::forcegp.errors.DataWarning")
@pytest.mark.parametrize(
    ("rest", "forces"),
    [
        (Torques("both"), (RigidBodies("all"), Viscous())),
        (Accelerations(), (RigidBodies("all"), Viscous())),
        (Accelerations(), (JointForces(("v",)),)),
    ],
)
def test_an_imu_is_the_better_acceleration(rest, forces):
    rows, true = recorded()  # behind a filter for fast motions derived accelerations are noise
    rows, true = Preparation(cutoff=60.0, every=8, trim=0.5).apply(rows), true.rows(slice(300, None, 40))
    model = rows.model.with_forces(*forces)
    how = {"points": 60, "restarts": 1} if model.unknown_forces else {}
    alone = missed(fit(model, rows, rest, **how), true)
    beside = missed(fit(model, rows, [rest, FrameAcceleration(noise=0.05)], **how), true)
    assert np.linalg.norm(beside) < 0.75 * np.linalg.norm(alone)


def test_a_small_turn_is_found_and_goes_through_files_and_updates(tmp_path):
    rows = changed(turned(0.1)).rows(slice(200, 3800, 10))
    model = rows.model.with_forces(JointForces(("v",)), noise=Noise(0.2))
    with pytest.raises(InvalidInput, match=r"turned by 5.7 degrees. State it"):
        fit(model, rows, **QUICK)
    posterior = fit(model, rows, [Accelerations(), FrameAcceleration(turned=True)], points=40, **QUICK)
    [name] = posterior.training.sensed
    wanted = Rotation.from_euler("xyz", TURN) * Rotation.from_rotvec([0.0, 0.1, 0.0])
    assert (Rotation.from_matrix(imu_place(name)[2]).inv() * wanted).magnitude() < 0.01
    save_posterior(posterior, tmp_path / "run")
    again = load_posterior(tmp_path / "run").update(rows.rows(slice(5, 10)))
    assert len(again.training.sensed[name]) == 45
    with pytest.raises(InvalidInput, match="these rows do not have"):
        again.update(replace(rows, measured={}))
    with pytest.raises(InvalidInput, match="no small turn explains it: the IMU at hand differs by"):
        fit(model, changed(turned(0.5)).rows(slice(200, 3800, 10)), [Accelerations(), FrameAcceleration(turned=True)])
    with pytest.raises(InvalidInput, match="take accelerations for exact"):
        fit(rows.model.with_forces(Viscous()), rows, [Torques(), FrameAcceleration(turned=True)])
    with pytest.raises(InvalidInput, match=r"frame-acceleration need the sensor imu.fore"):
        fit(model, rows, [Accelerations(), FrameAcceleration("fore")])


def test_from_columns_in_g_to_a_fit(tmp_path):
    raw, _ = recorded()
    columns = np.c_[raw.time, raw.q, raw.u, raw.measured[NAME][:, [1, 0, 2]] * [-1, 1, 1] / 9.80665]
    np.savetxt(tmp_path / "log.csv", columns, delimiter=",", header="t,q1,q2,q3,u1,u2,u3,x,y,z", comments="")
    (tmp_path / "arm.urdf").write_text(URDF)
    words = ["--time", "t", "--q", "q{1..3}", "--u", "u{1..3}", "--robot", "arm.urdf", "--unit", "imu=g"]
    words += ["--force", f"imu:{NAME.removeprefix(IMU)}=y,-x,z", "--cutoff", "20", "--every", "5", "--out", "log.h5"]
    run_here("import", "log.csv", *words, folder=tmp_path).ok()
    wanted = Preparation(cutoff=20.0, every=5).apply(raw).measured[NAME]
    np.testing.assert_allclose(Dataset.load(tmp_path / "log.h5").measured[NAME], wanted, atol=1e-6)
    done = run_here("fit", "log.h5", "--forces", "viscous", "--out", "run", folder=tmp_path)
    assert "evidence: torques, noisy both, and frame-acceleration" in done.stderr
