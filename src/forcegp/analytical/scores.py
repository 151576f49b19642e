"""How well a system explains recorded motions, in joint forces and in accelerations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.data.dataset_arguments import dataset_first
from forcegp.mechanics import LoadJointFriction, MechanicalSystem


@dataset_first
def motion_residuals(
    dataset: Dataset, system: MechanicalSystem
) -> tuple[Float[np.ndarray, "rows nv"], Float[np.ndarray, "rows nv"]]:
    """Residuals of joint forces, Q_K - M a (Nm or N), and of accelerations, measured less predicted.

    Under contacts the force residual holds the contact forces as well. Under friction that grows with |u| it is what
    the measured u exceeds the u by that the model needs (`recorded_rows`), for the friction of the measured |u| shrinks
    the residual of any model.
    """
    q, v, u, a = (torch.tensor(np.array(getattr(dataset, x)), device=system.robot.device) for x in ("q", "v", "u", "a"))
    dynamics = system.dynamics(q, v, u)
    force = dynamics.Q_K - (dynamics.M @ a[..., None])[..., 0]
    for friction in system.known_forces:
        if isinstance(friction, LoadJointFriction):
            idle, loaded = (friction.force(replace(dynamics.state, u=u)) for u in (0.0 * u, torch.ones_like(u)))
            without_load = u + (loaded - idle) * u.abs() - force  # z = u - g |u| - force
            force = u - without_load / (1.0 + (loaded - idle) * without_load.sign())
    return force.cpu().numpy(), (a - dynamics.acceleration_map().offset).cpu().numpy()


def residual_scores(
    force: Float[np.ndarray, "rows nv"], acceleration: Float[np.ndarray, "rows nv"], dataset: Dataset
) -> dict[str, list[float]]:
    """Per joint: rms of both residuals, and that of the acceleration over its standard deviation (nRMSE)."""
    rms = np.sqrt((acceleration**2).mean(0))
    spread = dataset.a.std(0)
    return {
        "force_rms": np.sqrt((force**2).mean(0)).tolist(),
        "acceleration_rms": rms.tolist(),
        "acceleration_nrmse": np.divide(rms, spread, out=np.full_like(rms, np.nan), where=spread > 0.0).tolist(),
    }
