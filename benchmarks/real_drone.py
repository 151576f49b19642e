"""A real drone in wind: force priors, a parametric model and an independent GP, each flight predicted from others.

Files are logs of Neural-Fly (O'Connell et al., "Neural-Fly enables rapid learning for agile flight in strong winds",
Science Robotics 2022; github.com/aerorobotics/neural-fly, data/experiment), which are not part of this project:
position and velocity, quaternion x, y, z, w, rates in the axes of the world, normalised thrust and its value at hover,
at 50 Hz. Torques are not logged, so only forces are compared: nRMSE of the linear accelerations in body axes, and the
position after .5 s, in m. Accelerations are differences of the logged velocity behind a zero-phase filter, which sees
.1 s ahead: that flatters every observer alike. The logged positions are late by times that change (up to 10 ms between
rows), so their differences are not used. Models have the observers of `benchmarks.quadrotor`.

    python -m benchmarks.real_drone FLIGHT.csv FLIGHT.csv [FLIGHT.csv ...] [--rows 200] [--mass 2.6]

FLIGHT.csv@FIRST takes 200 rows from that one on. The table in docs/how-to/moving-bases.md is from baseline_nowind@459,
baseline_35wind@459, baseline_70wind@460 and custom_figure8_baseline_100wind@0, with numbers of six digits.
"""

import argparse
import csv
import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import quadrotor
from benchmarks.quadrotor import TIMES, training_error
from forcegp import AerodynamicForce, Dataset, Model, Robot, fit
from forcegp.data import Preparation, differentiate
from forcegp.forces import Actuation, RigidBodies, Thrusters
from forcegp.posterior import Posterior, observing

GRAVITY = 9.81  # m/s^2
STRETCH = 200  # rows


def model_of(mass: float) -> Model:
    inertia = f'ixx="{0.012 * mass}" iyy="{0.012 * mass}" izz="{0.02 * mass}" ixy="0" ixz="0" iyz="0"'
    body = f'<inertial><mass value="{mass}"/><inertia {inertia}/></inertial>'
    robot = Robot.from_urdf_text(f'<robot name="drone"><link name="body">{body}</link></robot>', base="floating")
    push = Thrusters("body", [(0.0, 0.0, 0.0)], mass * GRAVITY)  # u is thrust over that at hover
    return Model(robot, (), (Actuation(), push, RigidBodies()))


def flight(given: str, model: Model, cutoff: float) -> Dataset:
    path, at, first = given.partition("@")
    with Path(path).open() as file:
        lines = list(csv.DictReader(file))
    if at:
        lines = lines[int(first) : int(first) + STRETCH]

    def column(name: str) -> np.ndarray:
        return np.array([json.loads(line[name]) for line in lines], dtype=float).reshape(len(lines), -1)

    time, turn = column("t")[:, 0], Rotation.from_quat(column("q"))
    v = np.hstack([turn.inv().apply(column("v")), turn.inv().apply(column("w"))])
    log = Dataset(
        q=np.hstack([column("p"), turn.as_quat()]),
        v=v,
        u=column("T_sp") / column("hover_throttle"),
        a=differentiate(v, time),
        time=time,
        model=model,
    )
    return Preparation(cutoff=cutoff, trim=0.1, differentiate="v").apply(log)


def joined(flights: list[Dataset]) -> Dataset:
    columns = {name: np.concatenate([getattr(each, name) for each in flights]) for name in ("q", "v", "u", "a", "time")}
    return replace(flights[0], **columns, episode=np.repeat(range(len(flights)), [len(each) for each in flights]))


def scores(posterior: Posterior, dataset: Dataset) -> tuple[float, float]:
    return quadrotor.scores(posterior, dataset, dataset.a[:, :3], horizon=25, stride=5, begin=10, dt=0.02)


def compared(model: Model, train: Dataset, test: Dataset, points: int) -> dict[str, tuple[float, float]]:
    linear = model.with_forces(AerodynamicForce(observe=0.0))
    parametric = fit(linear, train, points=min(1000, len(train)), restarts=1)
    seconds = min(TIMES, key=lambda each: training_error(parametric, train, each))
    force = fit(model.with_forces(AerodynamicForce()), train, points=min(points, len(train)), restarts=1)
    independent = fit(model.black_box(), train, points=min(points, len(train)), restarts=1)
    return {
        "force prior": scores(*observing(force, test)),
        "parametric": scores(*observing(parametric, test, seconds=seconds)),
        "parametric, unobserved": scores(parametric, test),
        "independent GP": scores(independent, test),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flights", nargs="+")
    parser.add_argument("--rows", type=int, default=200, help="points of force prior and independent GP")
    parser.add_argument("--mass", type=float, default=2.6, help="of the drone in kg; forces scale with it")
    parser.add_argument("--cutoff", type=float, default=6.0, help="of the filter in Hz")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    model = model_of(options.mass)
    flights = [flight(path, model, options.cutoff) for path in options.flights]
    results = []
    for k, test in enumerate(flights):
        train = joined([each for other, each in enumerate(flights) if other != k])
        found = compared(model, train, test, options.rows)
        results.append(found)
        for name, (share, away) in found.items():
            print(f"{Path(options.flights[k]).stem:32} {name:30} {share:.3f} {away:.3f} m", flush=True)
    for name in list(results[0])[1:]:
        ours, other = (np.square([found[each] for found in results]).mean(0) for each in ("force prior", name))
        print(f"force prior over {name}: accelerations, position: {np.sqrt(ours / other).round(3)}")


if __name__ == "__main__":
    main()
