"""The laws that a scenario simulated, as the curves that a prior with the same meaning should find."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from forcegp.models.structured.components import term_slices
from forcegp.priors import ContactFriction, JointFriction
from forcegp.simulation import KukaSurfaceConfig
from forcegp.simulation.friction_laws import DryFriction, ViscousFriction
from forcegp.simulation.kuka_motion import joint_friction_of, tool_friction_of

Law = Callable[[np.ndarray], np.ndarray]


def true_curves(posterior: Any) -> dict[str, Law]:
    """Latent -> true resisting force over its velocity; latents without a true law of their own are left out.

    Those are priors that differ from the simulation, for example a friction that does not grow with the load.
    """
    system = getattr(posterior.model, "system", None)
    prior = getattr(posterior.model, "prior", None)
    if prior is None or system is None:
        return {}
    config = KukaSurfaceConfig(**_tuples(posterior.settings["data"]["metadata"]["config"]))
    out: dict[str, Law] = {}
    names = posterior.latent_names
    for _, term, which in term_slices(prior, system.robot):
        if isinstance(term, JointFriction):
            for joint, name in zip(term.latent_names(system.robot), names[which], strict=True):
                out[name] = _joint_law(config, system.robot.joint_names.index(joint))
        elif isinstance(term, ContactFriction) and term.axes == "isotropic" and term.inputs == ("velocity",):
            law = _tool_law(config, term.load)
            if law is not None:
                out[names[which][0]] = _per_speed(law) if term.viscous else law
    return out


def _joint_law(config: KukaSurfaceConfig, joint: int) -> Law:
    law = joint_friction_of(config)
    if law is None:
        return np.zeros_like

    def resisting(v: np.ndarray) -> np.ndarray:
        return -law.force(np.asarray(v)[:, None] * np.ones(len(law.coulomb)))[:, joint]

    return resisting


def _tool_law(config: KukaSurfaceConfig, load: bool) -> Law | None:
    if config.contact != "ideal":
        return None  # PyBullet's solver has no law with a curve
    law = tool_friction_of(config)
    if isinstance(law, DryFriction) and load:
        return law.coefficient
    if isinstance(law, ViscousFriction) and not load and config.patch_factor == 1.0:
        return lambda speed: law.coefficient * np.asarray(speed)
    return None


def _per_speed(law: Law) -> Law:
    return lambda speed: law(speed) / speed


def _tuples(config: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list | tuple) else value for name, value in config.items()}
