"""Logs of real robots, which lie beside the repository where they are there: no false alarm, and defects are found."""

from pathlib import Path

import numpy as np
import pytest

from forcegp.checks import check
from forcegp.data import Dataset
from forcegp.model import Model
from forcegp.recordings import ColumnMapping, import_recordings
from forcegp.robots import Robot


@pytest.fixture(scope="module")
def panda(shared) -> Dataset:
    folder: Path = shared("realdata/panda_gaz2019")
    names = ("time", "positions", "velocity", "torques")
    mapping = ColumnMapping(
        time="exciting_traj_time:c1", q=("exciting_traj_positions",), v=("exciting_traj_velocity",),
        u=("exciting_traj_torques",), headerless=(1, 7, 7, 7), side_by_side=True,
    )  # fmt: skip
    model = Model(Robot.from_urdf(folder / "model" / "panda_gaz2019_nomesh.urdf"))
    return import_recordings([folder / "raw" / f"exciting_traj_{name}.txt.gz" for name in names], mapping, model=model)


@pytest.mark.nightly
def test_a_panda_is_well_but_its_velocities_are_late(panda):
    report = check(panda)
    assert report.doubts.level == "look"
    assert report.comparison is not None
    assert np.nanmax(report.comparison.unexplained) < 0.06
    (late,) = report.doubts.of("velocity")
    assert set(late.joints) == set(panda.joint_names)
    assert not report.doubts.of("delay")


def test_a_double_pendulum_whose_elbow_sticks_in_one_run(shared, tmp_path):
    folder: Path = shared("realdata/dfki_double_pendulum")
    mapping = ColumnMapping(time="time", q=("pos_meas{1..2}",), v=("vel_meas{1..2}",), u=("tau_meas{1..2}",))
    model = Model(Robot.from_urdf(folder / "model" / "double_pendulum_C1.urdf"))
    runs = [folder / "raw" / f"20230629-{name}.csv.gz" for name in ("143339", "143601", "143906")]
    report = check(import_recordings(runs, mapping, model=model))
    assert report.doubts.level == "look"
    (held,) = report.doubts.of("held joint")
    assert (held.joints, held.numbers["stretches"]) == (("joint2",), [2])
