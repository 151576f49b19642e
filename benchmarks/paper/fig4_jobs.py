"""The jobs of figure 4: roll models out from rows of a test trajectory and compare with what was recorded."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.paper.data import test_trajectory
from benchmarks.paper.fits import MODEL
from forcegp.data import Dataset
from forcegp.data.views import recorded_motions
from forcegp.integration import Feedback, integrate, integrator_named
from forcegp.jobs import JobStore
from forcegp.mechanics import Baumgarte
from forcegp.model import Model
from forcegp.posterior import load_posterior

BAUMGARTE = Baumgarte(10.0, 1.0)  # as in the paper, K = 100 and D = 20, and as in the simulation itself
OFFSET = 1e-3  # how far off the surface the displaced motions begin [m]
FREQUENCY = 20.0  # natural frequency of the feedback [rad/s], critically damped; the simulated controller has 100
PERTURBATIONS = (1e-8, 1e-6, 1e-4)  # of the true dynamics' initial positions: standard deviations [rad]
ARRAYS = "rollout.npz"
CONTROLS = {"open-loop": "recorded torques", "closed-loop": "recorded torques and feedback"}
VARIANTS = {
    "baumgarte": "Baumgarte",
    "off-surface": "Baumgarte, start 1 mm off the surface",
    "none": "not stabilised",
}


def roll(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Roll a fitted model out from evenly spaced rows of its test trajectory."""
    posterior = load_posterior(results.place(spec["fit"]) / MODEL)
    recorded = _Recorded(test_trajectory(results, spec["data"]), spec["starts"], max(spec["seconds"]))
    q0 = _displaced(posterior.model, recorded.q[:, 0]) if spec["variant"] == "off-surface" else recorded.q[:, 0]
    rollout = posterior.rollout(
        q0,
        recorded.v[:, 0],
        recorded.u,
        recorded.dt,
        baumgarte=BAUMGARTE if spec["variant"] in ("baumgarte", "off-surface") else None,
        feedback=recorded.feedback() if spec["control"] == "closed-loop" else None,
    )
    error = (rollout.q - recorded.q).abs().mean(-1).numpy()
    contact, kinematics = recorded.model.contacts[0], recorded.model.robot.kinematics(rollout.q)
    c = contact.distance(kinematics).abs().numpy()  # also of a model that knows no contact
    np.savez_compressed(folder / ARRAYS, time=rollout.time.numpy(), joint_error=error, constraint=c)
    scores = {f"{second:g}": _scores(error, c, round(second / recorded.dt)) for second in spec["seconds"]}
    return {"scores": scores, "diverged": int((rollout.diverged_at >= 0).sum())}


def truth(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The true dynamics, friction included, from the recorded states with a tiny change, under the recorded torques."""
    trajectory = test_trajectory(results, spec["data"])
    recorded = _Recorded(trajectory, spec["starts"], max(spec["seconds"]))
    assert trajectory.model is not None
    model = replace(trajectory.model, baumgarte=BAUMGARTE)
    contact, friction = model.contacts[0], trajectory.metadata["config"]["viscous_coefficient"]

    def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        dynamics = model.dynamics(q, v, u)
        J = dynamics.state.kinematics.frame_jacobian(contact.frame, contact.point)[..., :3, :]
        return dynamics.acceleration(-friction * (J.mT @ (J @ v[..., None]))[..., 0])

    euler, generator = integrator_named("symplectic-euler", model), torch.Generator().manual_seed(0)
    change = torch.randn(recorded.q[:, 0].shape, generator=generator, dtype=torch.float64)
    errors: dict[str, dict[str, list[float | None]]] = {}
    with torch.no_grad():
        for size in (0.0, *PERTURBATIONS):
            start = (recorded.q[:, 0] + size * change, recorded.v[:, 0])
            motion = integrate(euler, acceleration, *start, recorded.u.movedim(0, 1), recorded.dt)
            error = (motion.q.movedim(0, 1) - recorded.q).abs().mean(-1).numpy()
            errors[f"{size:g}"] = {f"{x:g}": _finite(error[:, round(x / recorded.dt)]) for x in spec["seconds"]}
    c = contact.distance(model.robot.kinematics(recorded.q)).abs().numpy()
    constraint = {"largest": float(c.max()), "median": float(np.median(c))}
    return {"joint_error": errors, "recorded_constraint": constraint}


class _Recorded:
    """Motions cut out of a trajectory: q, v (n, T+1, nv), u (n, T, nv)."""

    def __init__(self, trajectory: Dataset, starts: int, seconds: float) -> None:
        assert trajectory.model is not None
        self.model = trajectory.model
        motions = recorded_motions(trajectory, starts, seconds)
        self.dt = motions.dt
        self.q, self.v, self.u = (torch.tensor(np.asarray(x)) for x in (motions.q, motions.v, motions.u))

    def feedback(self) -> Feedback:
        """M (omega^2 (q_recorded - q) + 2 omega (v_recorded - v)) with the recorded M: the same for every model."""
        M = self.model.robot.mass_matrix(self.q)

        def feedback(k: int, at: Tensor, rate: Tensor) -> Tensor:
            wanted = FREQUENCY**2 * (self.q[:, k] - at) + 2.0 * FREQUENCY * (self.v[:, k] - rate)
            return (M[:, k] @ wanted[..., None])[..., 0]

        return feedback


def _scores(error: np.ndarray, c: np.ndarray, step: int) -> dict[str, list[float | None]]:
    """Per motion: error at `step` (None if it diverged before), median and largest |c| up to there, or to its end."""
    until = c[:, : step + 1]
    return {
        "joint_error": _finite(error[:, step]),
        "constraint_median": np.nanmedian(until, axis=1).tolist(),
        "constraint_largest": np.nanmax(until, axis=1).tolist(),
    }


def _finite(errors: Float[np.ndarray, " n"]) -> list[float | None]:
    return [float(error) if np.isfinite(error) else None for error in errors]


def _displaced(model: Model, q: Float[Tensor, "n nv"]) -> Float[Tensor, "n nv"]:
    """The nearest postures with the first contact's point OFFSET off its surface, by Newton's method."""
    contact, rest = model.contacts[0], torch.zeros_like(q)
    for _ in range(20):
        A = model.dynamics(q, rest, rest).A[:, :1]
        missing = contact.distance(model.robot.kinematics(q)) - OFFSET
        q = q - (torch.linalg.pinv(A) @ missing[:, None, None])[..., 0]
    return q
