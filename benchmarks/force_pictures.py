"""The pictures of docs/how-to/forces.md: what every prior learns from few points, beside the truth.

python -m benchmarks.force_pictures                          all of them, into docs/how-to/forces
python -m benchmarks.force_pictures joint-friction normal-force   these

The KUKA of `forcegp simulate kuka-surface`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch
from threadpoolctl import threadpool_limits

from forcegp import ContactFriction, Dataset, JointFriction, KukaSurfaceConfig, fit, simulate_kuka_surface
from forcegp.forces import Unknown
from forcegp.scores import friction_curves_figure, normal_force_figure, save_figure


@cache
def recording(seed: int, **options: Any) -> Dataset:
    return simulate_kuka_surface(KukaSurfaceConfig(seconds=40.0, seed=seed, **options))


def fitted(data: Dataset, prior: Unknown | tuple[Unknown, ...], points: int) -> Any:
    assert data.model is not None
    model = data.model.with_forces(*(prior if isinstance(prior, tuple) else (prior,)))
    return fit(model, data, points=points, restarts=1)


def joint_friction() -> Any:
    data = recording(1, surface="none", joint_friction="stribeck")
    posterior = fitted(data, JointFriction(), 100)
    return friction_curves_figure(posterior, recording(2, surface="none", joint_friction="stribeck"))


def friction_curves() -> Any:
    """All friction of an arm that rubs on a surface, in its joints and at its tool, from one fit."""
    options = {"friction": "stribeck", "joint_friction": "stribeck"}
    posterior = fitted(recording(1, **options), (ContactFriction(load=True), JointFriction()), 200)
    return friction_curves_figure(posterior, recording(2, **options))


def normal_force() -> Any:
    """The force that presses the tool on its surface, which nobody measured."""
    posterior = fitted(recording(1, friction="stribeck"), ContactFriction(load=True), 60)
    return normal_force_figure(posterior, recording(2, friction="stribeck"))


FOLDER = Path(__file__).parent.parent / "docs" / "how-to" / "forces"
PICTURES: dict[str, Callable[[], Any]] = {
    "joint-friction": joint_friction,
    "friction-curves": friction_curves,
    "normal-force": normal_force,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("pictures", nargs="*", metavar="PICTURE", help=f"of {', '.join(PICTURES)}; default: all")
    for name in parser.parse_args().pictures or PICTURES:
        save_figure(PICTURES[name](), FOLDER / f"{name}.png")
        print(FOLDER / f"{name}.png", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    with threadpool_limits(1):
        main()
