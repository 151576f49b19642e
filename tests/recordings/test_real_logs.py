"""Logs of real robots, which lie beside the repository where they are there: three formats, three mappings."""

import numpy as np
import torch

from forcegp.data import Preparation
from forcegp.model import Model
from forcegp.recordings import ColumnMapping, import_recordings
from forcegp.robots import Robot


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
