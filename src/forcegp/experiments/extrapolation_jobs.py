"""The jobs of the extrapolation: split rows by where and how fast the tool is, fit, and score on both sides."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from forcegp.data import Dataset, farthest_rows
from forcegp.errors import InvalidInput
from forcegp.evaluation import evaluate
from forcegp.experiments.data import scored_rows, training_rows
from forcegp.experiments.fits import MODEL, fitted, search_report
from forcegp.jobs import JobStore
from forcegp.models import save_posterior

TRAIN_X, TEST_X = 0.0, 0.1  # training rows have their tool at x below the first, test rows above the second [m]
REGIONS = {"place": "other half of the table", "place-and-speed": "other half and faster"}
SIDES = ("inside", "outside")


def tool_motion(dataset: Dataset) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """x coordinate [m] and speed [m/s] of the first contact's point in every row."""
    system = dataset.system
    if system is None or not system.contacts:
        raise InvalidInput("the dataset has no contact, so there is no tool to ask for; give one with a contact.")
    contact = system.contacts[0]
    kinematics = system.robot.kinematics(torch.tensor(dataset.q), torch.tensor(dataset.v))
    velocity = kinematics.frame_jacobian(contact.frame, contact.point)[..., :3, :] @ torch.tensor(dataset.v)[..., None]
    return contact.position(kinematics)[..., 0].numpy(), torch.linalg.vector_norm(velocity[..., 0], dim=-1).numpy()


def split_by_region(train: Dataset, test: Dataset, region: str) -> dict[str, Dataset]:
    """Rows to train on, and to test inside and outside of where they lie."""
    (train_x, train_speed), (test_x, test_speed) = tool_motion(train), tool_motion(test)
    limit = np.median(train_speed) if region == "place-and-speed" else np.inf

    def rows(dataset: Dataset, where: Bool[np.ndarray, " rows"], what: str) -> Dataset:
        if not where.any():
            raise InvalidInput(f"no {what} rows in region {region!r}; make the trajectories longer.")
        return dataset.rows(where)

    fast = (test_speed > limit) | np.isinf(limit)
    return {
        "train": rows(train, (train_x < TRAIN_X) & (train_speed <= limit), "training"),
        "inside": rows(test, (test_x < TRAIN_X) & (test_speed <= limit), "inside"),
        "outside": rows(test, (test_x > TEST_X) & fast, "outside"),
    }


def fit(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Fit one model in the region and score it inside and outside."""
    everything = training_rows(results, spec["data"], None)
    parts = split_by_region(everything, scored_rows(results, spec["data"]), spec["region"])
    train = parts["train"]
    if spec["points"] is not None:
        if spec["points"] > len(train):
            raise InvalidInput(f"{spec['points']} training points are asked for, but the region has {len(train)} rows.")
        train = farthest_rows(train, spec["points"])
    posterior = fitted(spec, train)
    save_posterior(posterior, folder / MODEL)
    scores = {side: evaluate(posterior, parts[side]).to_dict() for side in SIDES}
    return {**scores, "points": len(train), "search": search_report(posterior)}


def scale(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Root mean square of what each model is left to learn, and the largest entry of H, on 2000 training rows."""
    train = training_rows(results, spec["data"], None)
    train = train.rows(slice(min(2000, len(train))))
    q, v, u, Q_U, a = (torch.tensor(x) for x in (train.q, train.v, train.u, train.truth["Q_U"], train.truth["a"]))
    assert train.system is not None
    dynamics = train.system.dynamics(q, v, u)
    forces = dynamics.Q_K + Q_U
    free = torch.linalg.solve(dynamics.M, forces[..., None])[..., 0]
    values = {"acceleration": a, "unconstrained_acceleration": free, "all_forces": forces, "unknown_force": Q_U}
    sizes = {name: float(value.square().mean().sqrt()) for name, value in values.items()}
    return sizes | {"largest_H": float(dynamics.H.abs().max())}
