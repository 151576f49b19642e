"""The pictures of docs/how-to/forces.md: what every prior learns from few points, beside the truth.

python -m benchmarks.force_pictures                          all of them, into docs/how-to/forces
python -m benchmarks.force_pictures joint-friction contact-friction   these
python -m benchmarks.force_pictures --out elsewhere

The KUKA of `forcegp simulate kuka-surface`. Where that scenario has no such force, the states of a recording keep their
torques, and the acceleration is computed anew with the force (`with_force`).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from forcegp import ContactFriction, Dataset, JointFriction, KukaSurfaceConfig, fit, simulate_kuka_surface
from forcegp.forces import Unknown
from forcegp.forces.contact_friction import ExpectedFriction
from forcegp.scores import friction_curves_figure, normal_force_figure, save_figure
from forcegp.scores.figures.style import (
    KNOWN_PHYSICS,
    NORMAL,
    PREDICTION,
    TRUTH,
    new_figure,
    quiet,
)

BAND = 1.959963984540054
NOISE = 0.1
"""rad/s^2"""

Law = Callable[[torch.Tensor], torch.Tensor]


@cache
def recording(seed: int, **options: Any) -> Dataset:
    return simulate_kuka_surface(KukaSurfaceConfig(seconds=40.0, seed=seed, **options))


def with_force(data: Dataset, prior: Unknown, *laws: Law, seed: int = 5) -> Dataset:
    """The states and torques of `data` with the acceleration under another unknown force, one law per latent."""
    assert data.model is not None
    q, v, u = (torch.tensor(x) for x in (data.q, data.v, data.u))
    dynamics = data.model.dynamics(q, v, u)
    latents = [law(z[:, 0]) for law, z in zip(laws, prior.features(dynamics), strict=True)]
    a = dynamics.acceleration((prior.direction(dynamics) @ torch.stack(latents, -1)[..., None])[..., 0]).numpy()
    return replace(data, a=a + NOISE * np.random.default_rng(seed).standard_normal(a.shape), truth={"a": a})


def fitted(data: Dataset, prior: Unknown | tuple[Unknown, ...], points: int) -> Any:
    assert data.model is not None
    model = data.model.with_forces(*(prior if isinstance(prior, tuple) else (prior,)))
    return fit(model, data, points=points, restarts=1)


def visited(posterior: Any, latent: int, feature: int = 0) -> np.ndarray:
    features = posterior.model.unknown.features(posterior.likelihood.dynamics)
    return features[latent][:, feature].numpy()


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


def joint_friction() -> Any:
    data = recording(1, surface="none", joint_friction="stribeck")
    posterior = fitted(data, JointFriction(), 100)
    return friction_curves_figure(posterior, recording(2, surface="none", joint_friction="stribeck"))


def contact_friction() -> Any:
    """A force, and in proportion to the normal force."""
    figure = new_figure(9.0, 3.4)
    one, three = figure.subplots(1, 2)

    def stribeck(level: float) -> Law:
        return lambda v: torch.tanh(v / 0.05) * level * (1.0 + 0.6 * torch.exp(-((v / 0.15) ** 2)))

    isotropic = ContactFriction()
    posterior = fitted(with_force(recording(1), isotropic, stribeck(4.0)), isotropic, 100)
    draw_curve(one, posterior.curve("sliding"), stribeck(4.0), visited(posterior, 0))
    quiet(one, title="a force, 100 points", x="sliding speed [m/s]", y="force [N]")

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
    return finish(figure, one, three)


def friction_curves() -> Any:
    """All friction of an arm that rubs on a surface, in its joints and at its tool, from one fit."""
    options = {"friction": "stribeck", "joint_friction": "stribeck"}
    posterior = fitted(recording(1, **options), (ContactFriction(load=True), JointFriction()), 200)
    return friction_curves_figure(posterior, recording(2, **options))


def normal_force() -> Any:
    """The force that presses the tool on its surface, which nobody measured."""
    posterior = fitted(recording(1, friction="stribeck"), ContactFriction(load=True), 60)
    return normal_force_figure(posterior, recording(2, friction="stribeck"))


PICTURES: dict[str, Callable[[], Any]] = {
    "joint-friction": joint_friction,
    "contact-friction": contact_friction,
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
