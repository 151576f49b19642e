"""The picture of docs/how-to/friction.md: what a gear does after a reversal, and what friction learns of it.

python -m benchmarks.friction_reversals log.h5 --robot panda.urdf --joint fer_joint4 --out reversals.png

Learned from the first two thirds of a log, drawn on the last: torque beyond that of bodies, offset and viscous friction
over the way since a reversal, by friction of velocity and by friction that remembers.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from forcegp import Dataset, Model, Robot, Torques, fit
from forcegp.data import with_memory, with_strokes
from forcegp.evidence import motion_residuals
from forcegp.forces import Coulomb, GearFriction, RigidBodies, parse_forces
from forcegp.scores import save_figure

LAWS = {"friction of velocity": "viscous,coulomb,offset,rotor", "friction that remembers": "viscous,gear,offset,rotor"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--robot", type=Path, required=True)
    parser.add_argument("--joint", required=True)
    parser.add_argument("--way", type=float, default=0.03, help="rad or m after a reversal that are drawn")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    model = Model(Robot.from_file(given.robot, inertias="nearest"))
    log = with_strokes(replace(Dataset.load(given.log), model=model))
    j, cut = log.joint_names.index(given.joint), 2 * len(log) // 3
    train, test = log.rows(slice(0, cut)), log.rows(slice(cut, len(log)))
    bodies = model.with_forces(RigidBodies("all"))
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.4), sharey=True, layout="constrained")
    for ax, (title, laws) in zip(axes, LAWS.items(), strict=True):
        found = fit(bodies.with_forces(parse_forces(laws)), train, Torques()).model
        dry = next(law for law in found.laws if isinstance(law, Coulomb | GearFriction))
        seen = with_memory(test, found)
        left = motion_residuals(seen, found)[0][:, j]
        state = found.state(*(np_tensor(x) for x in (seen.q, seen.v, seen.u)))
        learned = -dry.force(state).numpy()[:, j]
        way = test.strokes[:, j, 0]
        near = np.abs(way) < given.way
        ax.plot(1e3 * way[near], (learned + left)[near], ".", color="0.6", markersize=2, label="measured")
        band = 1.96 * left.std()
        ax.errorbar(1e3 * way[near], learned[near], band, fmt="none", ecolor="C0", alpha=0.04)
        ax.plot(1e3 * way[near], learned[near], ".", color="C0", markersize=2, label="learned, 95 %")
        ax.set(title=f"{title}: {left.std():.2g} Nm left", xlabel="since the reversal [mrad]")
        print(f"{title}: {left.std():.4g} left of {test.u[:, j].std():.4g}")
    axes[0].set_ylabel(f"dry friction of {given.joint} [Nm]")
    axes[1].legend(markerscale=6, loc="lower right")
    given.out.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, given.out)


def np_tensor(values: np.ndarray):
    import torch

    return torch.tensor(np.array(values))


if __name__ == "__main__":
    main()
