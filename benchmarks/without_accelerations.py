"""Is it better to filter and differentiate a log, or to learn from windows of its raw positions? On two real rigs.

    python -m benchmarks.without_accelerations ../shared/realdata [--rig dfki|multiarm] [--points 100] [--seeds 3]
                                               [--encoder COUNTS] [--only TEXT]

Both sides learn the same forces from the same number of points of the same training runs, windows or rows, with one
search from moments. Filtered rows: zero-phase Butterworth of order 4 on q and u, v and a by central differences, 0.12 s
off both ends. WindowedRows: `Windows` on the raw log. Seeds choose the points: where
farthest-point sampling of rows begins, where the first window of a run begins. Two scores on the test runs:

* nRMSE of the acceleration against the reference filter of the rig, which favours the side that learned from it;
* RMSE of q after 0.1, 0.25 and 0.5 s of a rollout under the recorded torques, against the raw positions: no filter
  chooses that target. All begin at the states of the reference filter.
"""

from __future__ import annotations

import argparse
import gzip
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from forcegp.data import Dataset, Preparation, farthest_rows, resample
from forcegp.data.views import RecordedMotions, recorded_motions
from forcegp.errors import DataWarning, NumericalWarning
from forcegp.evidence import Windows
from forcegp.fit import fit
from forcegp.forces import Actuation, CoupledRotors, JointForces, JointFriction, RigidBodies, Unknown
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior import Posterior
from forcegp.robots import Robot

HORIZONS = (0.1, 0.25, 0.5)
STARTS = 60
TRIM = 0.12
PENDULUM_LINK = """<link name="link{n}"><inertial><origin xyz="0 0 {a}"/><mass value="{m}"/>
<inertia ixx="{I}" iyy="{I}" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="joint{n}" type="continuous"><origin xyz="0 0 {at}"/><parent link="{parent}"/><child link="link{n}"/>
<axis xyz="0 1 0"/></joint>"""


@dataclass(frozen=True)
class Rig:
    """Raw training and test runs at even steps, what is known, what is to be learned, and the reference filter."""

    train: Dataset
    test: Dataset
    forces: tuple[Unknown, ...]
    mean: bool
    reference: float
    cutoffs: tuple[float, ...]
    seconds: tuple[float, ...]
    force_noise: float | None


def dfki(folder: Path) -> Rig:
    """Two actuated links with geared motors; rigid body and rotors are known, friction and all else is not."""
    home = folder / "dfki_double_pendulum"
    robot = Robot.from_urdf(home / "model" / "double_pendulum_C1.urdf")
    gear, rotor = 6.0, 6.287203962819607e-05  # model_1.0.yml
    rotors = CoupledRotors((rotor, rotor), ((gear, 0.0), (1.0, -gear)))
    model = Model(robot, forces=(Actuation(), RigidBodies(), rotors))

    def runs(*names: str) -> Dataset:
        episodes = []
        for name in names:
            with gzip.open(home / "raw" / f"20230629-{name}.csv.gz", "rt") as file:
                columns = file.readline().strip().split(",")
                table = dict(zip(columns, np.loadtxt(file, delimiter=",").T, strict=True))
            q, u = (np.stack([table[f"{what}{j}"] for j in (1, 2)], axis=1) for what in ("pos_meas", "tau_meas"))
            episodes.append((table["time"] - table["time"][0], q, u))
        return resample(_dataset(model, episodes), 0.002)

    train, test = runs("143524", "143601", "143704", "144115"), runs("143339", "143747")
    forces = JointFriction(), JointForces(inputs=("q", "v"))
    return Rig(train, test, forces, True, 20.0, (10.0, 20.0, 30.0, 40.0), (0.06, 0.1, 0.15, 0.2), 0.05)


def multiarm(folder: Path) -> Rig:
    """Two passive links, published parameters; forces are learned from nothing but the mass matrix."""
    pieces = np.load(folder / "multiarm_pendulum" / "double_id.npz")
    links = [
        {"n": 1, "a": 0.108565215, "m": 0.0938439748, "I": 4.37529430e-4, "at": 0.0, "parent": "base"},
        {"n": 2, "a": 0.116779018, "m": 0.137595970, "I": 1.26882939e-3, "at": 0.172719204, "parent": "link1"},
    ]
    parts = "\n".join(PENDULUM_LINK.format(**link) for link in links)
    robot = Robot.from_urdf_text(f'<robot name="multiarm"><link name="base"/>{parts}</robot>', gravity=(0, 0, -9.80858))
    model = Model(robot)

    def runs(numbers: range) -> Dataset:
        episodes = []
        for number in numbers:
            angles = pieces[f"piece{number:02d}"][:, :2]
            q = np.stack([angles[:, 0], angles[:, 1] - angles[:, 0]], axis=1)
            episodes.append((float(pieces["dt"]) * np.arange(len(q)), q, np.zeros_like(q)))
        return _dataset(model, episodes)

    train, test, forces = runs(range(0, 12, 2)), runs(range(1, 12, 2)), (JointForces(inputs=("q", "v")),)
    return Rig(train, test, forces, False, 25.0, (15.0, 20.0, 25.0, 35.0, 50.0), (0.04, 0.06, 0.08, 0.12), None)


RIGS = {"dfki": dfki, "multiarm": multiarm}


def _dataset(model: Model, episodes: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Dataset:
    time, q, u = (np.concatenate(parts) for parts in zip(*episodes, strict=True))
    v = np.concatenate([np.gradient(q, time, axis=0) for time, q, _ in episodes])
    numbers = np.concatenate([np.full(len(time), k) for k, (time, *_) in enumerate(episodes)])
    return Dataset(q=q, v=v, u=u, a=np.zeros_like(q), time=time, episode=numbers, model=model)


def coarse(rig: Rig, counts: int) -> Rig:
    """The training runs as an encoder with so many counts per turn would have logged them; the test stays as it is."""
    turn = 2.0 * np.pi / counts
    q = turn * np.round(rig.train.q / turn)
    runs = [(rig.train.time[at], q[at]) for at in (rig.train.episode == number for number in rig.train.episodes)]
    v = np.concatenate([np.gradient(position, time, axis=0) for time, position in runs])
    return replace(rig, train=replace(rig.train, q=q, v=v))


MORE, MORE_WINDOWS = 6, 3
"""Rows for every point, and windows of 2 nodes: kernel matrices of the size that windows of 6 nodes have."""


@dataclass(frozen=True)
class Source:
    """What is learned from: rows after a low-pass [Hz], windows, or nothing; `times` as many as there are points."""

    how: float | Literal["auto"] | Windows | None
    times: int = 1


def sources(rig: Rig) -> Iterator[tuple[str, Source]]:
    """Filtered rows by their cut-off, then windows."""
    yield "nothing: rigid bodies alone", Source(None)
    yield "filtered, automatic cut-off", Source("auto")
    for cutoff in rig.cutoffs:
        yield f"filtered at {cutoff:g} Hz", Source(cutoff)
    yield f"filtered at {rig.reference:g} Hz, {MORE} x the points", Source(rig.reference, MORE)
    for seconds in rig.seconds:
        yield f"weak form, q, {seconds:g} s", Source(Windows(seconds))
    short = Windows(min(rig.seconds), nodes=2)
    yield f"weak form, {short.seconds:g} s, {MORE_WINDOWS} x the points", Source(short, MORE_WINDOWS)


def fitted(rig: Rig, source: Source, points: int, seed: int) -> Posterior:
    how, points = source.how, source.times * points
    if how is None:
        return fit(rig.train.model.with_forces(noise=Noise(1.0)), rig.train, points=2)
    model = rig.train.model.with_forces(rig.forces)
    model = model if rig.mean else model.without_mean()
    if isinstance(how, Windows):
        noise = None if rig.force_noise is None else Noise(None, rig.force_noise, learn=True)
        return fit(replace(model, noise=noise), _later(rig.train, 5 * seed), how, points=points, restarts=1)
    rows = Preparation(cutoff=how, trim=TRIM).apply(rig.train)
    noise = Noise(1.0, rig.force_noise, learn=True)
    return fit(replace(model, noise=noise), farthest_rows(rows, points, start=seed), restarts=1)


def _later(raw: Dataset, rows: int) -> Dataset:
    """Without the first rows of every run, so that all windows begin elsewhere."""
    keep = np.concatenate([np.arange((raw.episode == number).sum()) >= rows for number in raw.episodes])
    return raw.rows(keep)


@dataclass(frozen=True)
class Targets:
    """The test runs after the reference filter, and raw motions that begin at its states."""

    rows: Dataset
    motions: RecordedMotions

    @classmethod
    def of(cls, rig: Rig) -> Targets:
        filtered = Preparation(cutoff=rig.reference, trim=TRIM).apply(rig.test)
        stamps = zip(rig.test.episode, rig.test.time, strict=True)
        raw = {(number, round(t, 6)): row for row, (number, t) in enumerate(stamps)}
        at = [raw[number, round(t, 6)] for number, t in zip(filtered.episode, filtered.time, strict=True)]
        motions = recorded_motions(replace(filtered, u=rig.test.u[at]), STARTS, max(HORIZONS))
        target = recorded_motions(replace(filtered, q=rig.test.q[at]), STARTS, max(HORIZONS))
        begin = motions.q[:, :1]
        return cls(filtered.rows(slice(None, None, 10)), replace(motions, q=np.hstack([begin, target.q[:, 1:]])))

    def scores(self, posterior: Posterior) -> list[float]:
        """nRMSE of the acceleration per joint, then RMSE of q after each horizon (both joints together)."""
        rows, motions = self.rows, self.motions
        error = posterior.predict(rows.q, rows.v, rows.u, covariance=False).mean.numpy() - rows.a
        normalised = np.sqrt(np.square(error).mean(axis=0)) / rows.a.std(axis=0)
        run = posterior.rollout(motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt, integrator="rk4")
        apart = np.square(run.q.numpy() - motions.q)
        at = [round(seconds / motions.dt) for seconds in HORIZONS]
        return [*normalised, *np.sqrt([apart[:, k].mean() for k in at])]


def compare(rig: Rig, points: int, seeds: int, only: str) -> None:
    """Fit and score sources with `only` in their names; print medians and the range of the longest horizon."""
    targets = Targets.of(rig)
    print(f"{'learned from':34} {'nRMSE a':>13} " + " ".join(f"q {h:4.2f} s" for h in HORIZONS) + "  range, CPU s")
    for label, source in sources(rig):
        if only not in label:
            continue
        begin, found = time.process_time(), []
        for seed in range(seeds if source.how is not None else 1):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NumericalWarning)
                warnings.simplefilter("ignore", DataWarning)
                found.append(targets.scores(fitted(rig, source, points, seed)))
        table = np.array(found)
        middle, last = np.median(table, axis=0), table[:, -1]
        joints = "/".join(f"{value:.3f}" for value in middle[: -len(HORIZONS)])
        ahead = " ".join(f"{value:8.4f}" for value in middle[-len(HORIZONS) :])
        seconds = (time.process_time() - begin) / len(found)
        print(f"{label:34} {joints:>13} {ahead}  {last.min():.4f}-{last.max():.4f} {seconds:5.0f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with dfki_double_pendulum and multiarm_pendulum")
    parser.add_argument("--rig", choices=tuple(RIGS), action="append")
    parser.add_argument("--points", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", default="", metavar="TEXT", help="only what is learned from sources of that name")
    parser.add_argument("--encoder", type=int, metavar="COUNTS", help="round the training positions to such an encoder")
    given = parser.parse_args()
    if not given.folder.is_dir():
        sys.exit(f"{given.folder} does not exist; give the folder with the logs of real robots")
    torch.set_num_threads(1)
    with threadpool_limits(1):
        for name in given.rig or RIGS:
            coarser = "" if given.encoder is None else f", training positions rounded to {given.encoder} counts"
            print(f"{name}: {given.points} points, medians of {given.seeds} seeds{coarser}", flush=True)
            rig = RIGS[name](given.folder)
            compare(rig if given.encoder is None else coarse(rig, given.encoder), given.points, given.seeds, given.only)


if __name__ == "__main__":
    main()
