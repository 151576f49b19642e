"""Logs of real robots, which lie beside the repository where they are there: three formats, three mappings."""

import numpy as np
import pytest
import torch
from tests.data.samples import model as arm

from forcegp.data import Preparation
from forcegp.model import Model
from forcegp.recordings import ColumnMapping, ImportOptions, import_recordings
from forcegp.robots import Robot


def test_eight_runs_of_a_double_pendulum(shared, tmp_path):
    folder = shared("realdata/dfki_double_pendulum")
    mapping = ColumnMapping(time="time", q=("pos_meas{1..2}",), v=("vel_meas{1..2}",), u=("tau_meas{1..2}",))
    model = Model(Robot.from_urdf(folder / "model" / "double_pendulum_C1.urdf"))
    runs = sorted((folder / "raw").glob("*.csv.gz"))
    data = import_recordings(runs, mapping, model=model)
    assert data.episodes == tuple(range(8))
    assert data.joint_names == ("joint1", "joint2")
    assert data.metadata["import"]["resampled_to_step"] == pytest.approx(1 / 500)
    raw = np.loadtxt(runs[2], delimiter=",", skiprows=1)
    own = data.select_episodes([2])
    for signal, columns in (("q", [1, 2]), ("v", [3, 4]), ("u", [13, 14])):
        for joint, column in enumerate(columns):
            between = np.interp(own.time, raw[:, 0] - raw[0, 0], raw[:, column])
            error = np.abs(getattr(own, signal)[:, joint] - between)
            assert np.median(error) < 0.02 * raw[:, column].std()  # a spline and straight lines through the same rows


def test_a_panda_whose_signals_lie_in_four_files(shared, tmp_path):
    """The torque residual of the identified URDF, published with the data, comes out of what was imported."""
    folder = shared("realdata/panda_gaz2019")
    names = ("time", "positions", "velocity", "torques")
    prefix = "exciting_traj_"
    mapping = ColumnMapping(
        time=f"{prefix}time:c1",
        q=(f"{prefix}positions",),
        v=(f"{prefix}velocity:c{{1..7}}",),
        u=(f"{prefix}torques",),
        headerless=(1, 7, 7, 7),
        side_by_side=True,
    )
    robot = Robot.from_urdf(folder / "model" / "panda_gaz2019_nomesh.urdf")
    paths = [folder / "raw" / f"{prefix}{name}.txt.gz" for name in names]
    raw = import_recordings(paths, mapping, model=Model(robot))
    assert raw.episodes == (0,)
    data = Preparation(cutoff=5.0, every=20, trim=0.25).apply(raw)
    q, v, a = (torch.tensor(values) for values in (data.q, data.v, data.a))
    residual = np.sqrt(np.square(robot.inverse_dynamics(q, v, a).numpy() - data.u).mean(axis=0))
    np.testing.assert_allclose(residual, [0.34, 0.62, 0.33, 0.59, 0.34, 0.19, 0.28], atol=0.03)


def test_a_passive_pendulum_with_absolute_angles(shared, tmp_path):
    path = shared("realdata/multiarm_pendulum/double_id.npz")
    mapping = ColumnMapping(
        step=1e-3,
        episodes="piece*",
        q=("[0] + pi", "[1] - [0]"),
        v=("[2]", "[3] - [2]"),
        u=("0",),
        unit={"q": ("rad",)},
    )
    data = import_recordings([path], mapping, model=arm("continuous"), options=ImportOptions(end=0.5))
    pieces = np.load(path)
    assert data.episodes == tuple(range(26))
    last = data.select_episodes([25])
    expected = pieces["piece25"][:501]
    np.testing.assert_array_equal(last.q, np.stack([expected[:, 0] + np.pi, expected[:, 1] - expected[:, 0]], axis=1))
    np.testing.assert_array_equal(last.v[:, 1], expected[:, 3] - expected[:, 2])
    assert not last.u.any()
