"""The pictures of docs/how-to/forces.md: what every prior learns from few points, beside the truth.

python -m benchmarks.force_pictures                          all of them, into docs/how-to/forces
python -m benchmarks.force_pictures joint-forces joint-ripple     these
python -m benchmarks.force_pictures --out elsewhere

The KUKA of `forcegp simulate kuka-surface`. Where that scenario has no such force, the states of a recording keep their
torques, and the acceleration is computed anew with the force (`with_force`).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from benchmarks.force_recordings import (
    F64,
    Law,
    across_the_strip,
    fitted,
    on_a_rough_strip,
    plane_of,
    recording,
    roughness,
    turntable,
    visited,
    with_force,
)
from forcegp import ContactFriction, JointForces, JointFriction, KukaSurfaceConfig, ToolForces
from forcegp.forces import JointAccelerations, PeriodicJointForces
from forcegp.forces.contact_friction import ExpectedFriction
from forcegp.scores import friction_curves_figure, normal_force_figure, save_figure
from forcegp.scores.figures.style import (
    KNOWN_PHYSICS,
    MEASUREMENT,
    NORMAL,
    PREDICTION,
    TRUTH,
    new_figure,
    quiet,
    window,
)

BAND = 1.959963984540054


def draw_curve(axes: Any, curve: Any, law: Law | None, ticks: np.ndarray | None = None) -> None:
    """Mean, band, truth and where the training points were."""
    at, mean, std = curve.features[:, 0].numpy(), curve.mean.numpy(), curve.std.numpy()
    if law is not None:
        axes.plot(at, law(curve.features[:, 0]).numpy(), color=TRUTH, linewidth=3.5, alpha=0.3, label="true")
    band = BAND * std
    axes.fill_between(at, mean - band, mean + band, color=PREDICTION, alpha=0.3, linewidth=0, label="95 % band")
    axes.plot(at, mean, color=PREDICTION, linewidth=1.5, label="learned")
    if ticks is not None:
        at_bottom = np.full(len(ticks), 0.02)
        style: dict[str, Any] = {"markersize": 6, "alpha": 0.6, "color": TRUTH, "markeredgewidth": 0.7}
        axes.plot(ticks, at_bottom, "|", transform=axes.get_xaxis_transform(), label="training points", **style)
    axes.axhline(0.0, color="#B8BCC2", linewidth=0.8, zorder=1)
    axes.margins(x=0)


def finish(figure: Any, *axes: Any) -> Any:
    """One legend below all panels."""
    known: dict[str, Any] = {}
    for one in axes:
        for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
            known.setdefault(label, handle)
    figure.legend(
        known.values(), known.keys(), loc="outside lower center", ncols=len(known), fontsize=NORMAL, frameon=False
    )
    return figure


def joint_forces() -> Any:
    """Left: a torque of an arm on a surface over time. Right: what a turning joint gains from sines and cosines."""
    data, test = recording(1), window(recording(2), 4.0, 3.0)
    force = fitted(data, JointForces(), 100).predict(test.q, test.v, test.u).unknown_force
    figure = new_figure(10.0, 3.2)
    left, *right = figure.subplots(1, 3, width_ratios=(1.5, 1.0, 1.0))
    joint = 0
    seconds = torch.tensor(test.time - test.time[0])[:, None]
    drawn = _Line(seconds, force.mean[:, joint], force.std[:, joint])
    draw_curve(left, drawn, lambda _: torch.tensor(test.truth["Q_U"][:, joint]))
    quiet(left, title="KUKA, joint 1: unknown torque, 100 points", x="time [s]", y="torque [Nm]")

    def torque(q: torch.Tensor) -> torch.Tensor:
        return 2.0 * torch.sin(q) + 0.8 * torch.cos(2.0 * q)

    rows = turntable(torque)
    turn = torch.linspace(-math.pi, 3.0 * math.pi, 300, dtype=F64)[:, None]
    for axes, angles in zip(right, ("plain", "sin-cos"), strict=True):
        posterior = fitted(rows, JointForces(inputs=("q",), angles=angles), 25)
        there = posterior.predict(turn, 0.0 * turn, 0.0 * turn).unknown_force
        draw_curve(axes, _Line(turn, there.mean[:, 0], there.std[:, 0]), torque, rows.q[:, 0])
        axes.set_xticks([-math.pi, 0.0, math.pi, 2.0 * math.pi, 3.0 * math.pi], ["−π", "0", "π", "2π", "3π"])
        axes.set_ylim(-4.5, 4.5)
        quiet(axes, title=f"turntable, angles={angles}", x="joint position [rad]", y="torque [Nm]")
    return finish(figure, left, *right)


def joint_friction() -> Any:
    data = recording(1, surface="none", joint_friction="stribeck")
    posterior = fitted(data, JointFriction(), 100)
    return friction_curves_figure(posterior, recording(2, surface="none", joint_friction="stribeck"))


def tool_forces() -> Any:
    """Left: the two friction curves. Right: a force that depends on the place."""
    plain = fitted(recording(1), ToolForces(), 20)
    rough = on_a_rough_strip()
    kernel = "matern-3/2"
    posterior = fitted(rough, ToolForces(inputs=("velocity", "position"), kernel=kernel), 300)
    figure = new_figure(10.0, 3.2)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.4))
    speed = torch.linspace(-2.8, 2.8, 121, dtype=F64)
    features = torch.stack([speed, torch.zeros_like(speed)], -1)
    curve = plain.curve("force-tangent-1", features)
    draw_curve(left, curve, lambda v: -v, visited(plain, 0))
    quiet(left, title="tool-friction, 20 points", x="velocity along tangent-1 [m/s]", y="force along tangent-1 [N]")
    tangents, visited_x = plane_of(posterior)
    x, place = across_the_strip()
    one_along = torch.tensor([1.0, 0.0], dtype=F64).expand(len(x), 2)
    curve = posterior.curve("force-tangent-1", torch.cat([one_along, place @ tangents], -1))
    draw_curve(right, _Line(x, curve.mean, curve.std), lambda p: -roughness(p), visited_x)
    quiet(
        right,
        title="tool-forces across a rough strip, 300 points",
        x="position x [m]",
        y="force at 1 m/s [N]",
    )
    return finish(figure, left, right)


def contact_friction() -> Any:
    """Isotropic, two axes, and in proportion to the normal force."""
    figure = new_figure(11.0, 3.4)
    one, two, three = figure.subplots(1, 3)

    def stribeck(level: float) -> Law:
        return lambda v: torch.tanh(v / 0.05) * level * (1.0 + 0.6 * torch.exp(-((v / 0.15) ** 2)))

    isotropic = ContactFriction()
    posterior = fitted(with_force(recording(1), isotropic, stribeck(4.0)), isotropic, 100)
    draw_curve(one, posterior.curve("sliding"), stribeck(4.0), visited(posterior, 0))
    quiet(one, title="axes=isotropic: one curve, 100 points", x="sliding speed [m/s]", y="force [N]")

    grain = ContactFriction(axes="two-axis")
    posterior = fitted(with_force(recording(1), grain, stribeck(4.0), stribeck(2.0)), grain, 100)
    for name, level in (("tangent-1", 4.0), ("tangent-2", 2.0)):
        draw_curve(two, posterior.curve(name), stribeck(level))
        two.annotate(name, (0.5, level), (0.6, level - 1.0), fontsize=NORMAL, color=TRUTH)
    quiet(two, title="axes=two-axis: a grain, 100 points", x="velocity along the tangent [m/s]", y="force [N]")

    data = recording(1, friction="stribeck")
    config = KukaSurfaceConfig(friction="stribeck")
    low, high = config.coulomb_coefficient, config.static_coefficient

    def coefficient(v: torch.Tensor) -> torch.Tensor:
        level = low + (high - low) * torch.exp(-((v / config.breakaway_velocity) ** 2))
        return level * v / torch.sqrt(v**2 + config.friction_smoothing**2)

    nominal = fitted(data, ContactFriction(load=True, expected=ExpectedFriction.of(0.0)), 60).curve("sliding")
    posterior = fitted(data, ContactFriction(load=True), 60)
    draw_curve(three, posterior.curve("sliding"), coefficient, visited(posterior, 0))
    three.plot(
        nominal.features[:, 0], nominal.mean, color=KNOWN_PHYSICS, linewidth=1.2, label="without load refinement"
    )
    three.set_ylim(0.0, 0.55)
    quiet(three, title="load=true: a coefficient, 60 points", x="sliding speed [m/s]", y="friction / normal force")
    return finish(figure, one, two, three)


def joint_ripple() -> Any:
    """Cogging of two joints with 12 pole pairs, of which the data saw a part of the turn only."""
    joints = ("lbr_iiwa_joint_1", "lbr_iiwa_joint_4")
    prior = PeriodicJointForces(2.0 * math.pi / 12.0, joints)

    def cogging(q: torch.Tensor) -> torch.Tensor:
        return 0.8 * torch.sin(12.0 * q) + 0.3 * torch.sin(24.0 * q + 1.0)

    free = recording(1, surface="none")
    posterior = fitted(with_force(free, prior, cogging, cogging), prior, 25)
    figure = new_figure(10.0, 3.2)
    grid = figure.subplots(1, 2)
    for index, (axes, joint) in enumerate(zip(grid, joints, strict=True)):
        at = visited(posterior, index)
        curve = posterior.curve(joint, torch.linspace(at.min() - 0.8, at.max() + 0.8, 400, dtype=F64))
        draw_curve(axes, curve, cogging, at)
        quiet(axes, title=f"joint {joint[-1]}, 25 points", x="joint position [rad]", y="torque [Nm]")
    return finish(figure, *grid)


def joint_accelerations() -> Any:
    """Two joints over the same seconds as in the picture of `no_forces`."""
    test = window(recording(2), 4.0, 2.5)
    predicted = fitted(recording(1), JointAccelerations(), 100, "zero").predict(test.q, test.v, test.u)
    figure = new_figure(10.0, 3.2)
    grid = figure.subplots(1, 2)
    seconds = torch.tensor(test.time - test.time[0])[:, None]
    for axes, joint in zip(grid, (4, 6), strict=True):
        axes.plot(seconds[:, 0], test.a[:, joint], ".", color=MEASUREMENT, markersize=2, label="measured", zorder=1)
        truth = torch.tensor(test.truth["a"][:, joint])
        draw_curve(axes, _Line(seconds, predicted.mean[:, joint], predicted.std[:, joint]), lambda _, a=truth: a)
        quiet(axes, title=f"joint {joint + 1}, 100 points, mean=zero", x="time [s]", y="acceleration [rad/s²]")
    return finish(figure, *grid)


def no_forces() -> Any:
    """What known physics leaves unexplained."""
    test = window(recording(2), 4.0, 2.5)
    predicted = fitted(recording(1), (), 100).predict(test.q, test.v, test.u).mean.numpy()
    figure = new_figure(10.0, 3.2)
    grid = figure.subplots(1, 2)
    seconds = test.time - test.time[0]
    for axes, joint in zip(grid, (4, 6), strict=True):
        own, truth = predicted[:, joint], test.truth["a"][:, joint]
        axes.fill_between(seconds, truth, own, color=KNOWN_PHYSICS, alpha=0.2, linewidth=0, label="left to be learned")
        axes.plot(seconds, truth, color=TRUTH, linewidth=3.5, alpha=0.3, label="true")
        axes.plot(seconds, own, color=KNOWN_PHYSICS, linewidth=1.5, label="known physics alone")
        axes.margins(x=0)
        quiet(axes, title=f"joint {joint + 1}", x="time [s]", y="acceleration [rad/s²]")
    return finish(figure, *grid)


def friction_curves() -> Any:
    """All friction of an arm that rubs on a surface, in its joints and at its tool, from one fit."""
    options = {"friction": "stribeck", "joint_friction": "stribeck"}
    posterior = fitted(recording(1, **options), (ContactFriction(load=True), JointFriction()), 200)
    return friction_curves_figure(posterior, recording(2, **options))


def normal_force() -> Any:
    """The force that presses the tool on its surface, which nobody measured."""
    posterior = fitted(recording(1, friction="stribeck"), ContactFriction(load=True), 60)
    return normal_force_figure(posterior, recording(2, friction="stribeck"))


def friction_map() -> Any:
    """Viscous friction with a rough strip, under two kernels."""
    rough = on_a_rough_strip()
    figure = new_figure(7.5, 3.2)
    grid = figure.subplots(1, 2)
    x, place = across_the_strip()
    for axes, kernel in zip(grid, ("squared-exponential", "matern-3/2"), strict=True):
        posterior = fitted(rough, ContactFriction(viscous=True, inputs=("position",), kernel=kernel), 100)
        tangents, visited_x = plane_of(posterior)
        curve = posterior.curve("sliding", place @ tangents)
        draw_curve(axes, _Line(x, curve.mean, curve.std), roughness, visited_x)
        axes.set_ylim(0.0, 6.0)
        quiet(axes, title=f"{kernel}, 100 points", x="position x [m]", y="coefficient [N/(m/s)]")
    return finish(figure, *grid)


class _Line:
    """What `draw_curve` needs of a curve."""

    def __init__(self, features: torch.Tensor, mean: torch.Tensor, std: torch.Tensor) -> None:
        self.features, self.mean, self.std = features, mean, std


PICTURES: dict[str, Callable[[], Any]] = {
    "joint-forces": joint_forces,
    "joint-friction": joint_friction,
    "tool-forces": tool_forces,
    "contact-friction": contact_friction,
    "friction-map": friction_map,
    "joint-ripple": joint_ripple,
    "joint-accelerations": joint_accelerations,
    "no-forces": no_forces,
    "friction-curves": friction_curves,
    "normal-force": normal_force,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("pictures", nargs="*", metavar="PICTURE", help=f"of {', '.join(PICTURES)}; default: all")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent.parent / "docs" / "how-to" / "forces")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.pictures or PICTURES:
        save_figure(PICTURES[name](), given.out / f"{name}.png")
        print(given.out / f"{name}.png", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    with threadpool_limits(1):
        main()
