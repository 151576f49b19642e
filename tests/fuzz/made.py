"""What the fuzzed commands and functions are given where they are given nothing wrong, made once."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.data.samples import dataset, model
from tests.posterior.arm import URDF, arm_data, arm_model
from tests.recordings import log_files
from tests.recordings.log_files import motion, table
from tests.robots.mjcf_models import OPEN_BARS, QUADROTOR

from forcegp.fit import fit
from forcegp.forces import Actuation, JointForces, JointFriction, ObservedWrench, RigidBodies, Thrusters
from forcegp.inference import OptimizerOptions
from forcegp.mechanics import fixed_point
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior import save_posterior
from forcegp.robots import Robot
from forcegp.simulation import QuadrotorConfig
from forcegp.simulation.moving_bases import simulate_quadrotor

MODELS = ("structured", "carried", "independent")
QUICK = OptimizerOptions(iterations=2)
INPUTS: Any = SimpleNamespace(folder=None)
"""`folder` with the files below, `data`, `posterior`, `predictor`; filled by `make`."""
LOGS = ("log.csv", "log.npz", "log.mat", "log73.mat", "log.h5", "log.parquet", "log.mcap")

PAIR = model("continuous").robot.urdf_text  # the robot of the logs


def make(folder: Path) -> None:
    """train.h5, test.h5, arm.urdf, the models, logs of two joints with their mappings."""
    import numpy as np

    data, free = arm_data(14, 5), arm_data(80, 6, arm_model(0))
    structured = fit(
        data.model.with_forces(JointForces(), JointFriction(), noise=Noise(0.05, 0.02, learn=True)), data, points=8,
        restarts=1, options=QUICK,
    )  # fmt: skip
    plain = fit(data.model.with_forces(JointForces()), data, points=8, restarts=1, options=QUICK)
    heavier = Robot.from_urdf_text(URDF.replace('mass value="0.6"', 'mass value="0.9"'))
    models = {
        "structured": structured,
        "carried": plain.with_model(Model(heavier, data.model.contacts, data.model.forces)),
        "independent": fit(data.model.black_box(), data, points=8, restarts=1, options=QUICK),
    }
    for name, posterior in models.items():
        save_posterior(posterior, folder / name)
    data.save(folder / "train.h5")
    free.save(folder / "test.h5")
    dataclasses.replace(data, truth={}, noise_std=None).save(folder / "bare.h5")
    (folder / "arm.urdf").write_text(URDF)
    (folder / "pair.urdf").write_text(PAIR)
    rows = motion(60)
    log_files.write_text(folder / "log.csv", table(rows))
    np.savez(folder / "log.npz", **rows)
    log_files.write_matlab5(folder / "log.mat", rows)
    log_files.write_matlab73(folder / "log73.mat", rows)
    log_files.write_hdf5(folder / "log.h5", rows)
    log_files.write_parquet(folder / "log.parquet", table(rows))
    next(log_files.write_bag2(folder / "bag", rows).glob("*.mcap")).rename(folder / "log.mcap")
    INPUTS.folder, INPUTS.data, INPUTS.posterior, INPUTS.free = folder, data, plain, free
    INPUTS.other = dataset()
    INPUTS.moving = simulate_quadrotor(QuadrotorConfig(seconds=0.1))
    INPUTS.moving.save(folder / "moving.h5")
    (folder / "drone.xml").write_text(QUADROTOR)
    INPUTS.models = (INPUTS.moving.model.to_json(), switched().to_json())
    INPUTS.predictor = plain.predictor(compile=False)


def switched() -> Model:
    """A contact with a switch, and forces of every kind that files carry."""
    robot, push = Robot.from_mjcf_text(OPEN_BARS), Thrusters("coupler", [[0.0, 0.0, 0.1]])
    forces = (Actuation([[1.0], [0.0], [0.0]], ("motor",)), push, ObservedWrench("rocker"), RigidBodies())
    return Model(robot, fixed_point("crank", (0.0, 0.0, 0.1), switch="held"), forces)
