"""Whether the rows bear out the contacts: how far they are from the surfaces, and what their accelerations show."""

from __future__ import annotations

import warnings

import torch

from forcegp.data import Dataset, contact_doubts
from forcegp.errors import ContactError, ContactWarning, DataWarning
from forcegp.mechanics import MechanicalSystem
from forcegp.models.training_data import TrainingData

FAR_FROM_SURFACE = 0.01
"""Median distance of the training points from a contact's surface, in m, beyond which a warning is given."""


def check_distance(system: MechanicalSystem, training: TrainingData) -> None:
    """Refuse a surface that no training state touches, and warn where half of them are far from it."""
    kinematics = system.robot.kinematics(training.q)
    for index, contact in enumerate(system.contacts):
        # divided by |s_p|, which is 1 for signed distances, the value of any surface is a distance near it
        size = torch.linalg.vector_norm(contact.surface.gradient(contact.position(kinematics)), dim=-1)
        distances = (contact.distance(kinematics) / size).abs()
        distance = float(distances.median())
        what = f"the surface of contact {index} (frame {contact.frame!r})"
        remedy = "check its surface, point and units (m), or leave the contact out"
        if float(distances.min()) > FAR_FROM_SURFACE:
            raise ContactError(
                f"no training point touches {what}: the nearest is {float(distances.min()):.3g} m away, half of them "
                f"more than {distance:.3g} m; {remedy}"
            )
        if distance > FAR_FROM_SURFACE:
            warnings.warn(
                f"half of the training points lie more than {distance:.3g} m from {what}; {remedy}, or train on the "
                "rows in contact only (forcegp.data.rows_in_contact)",
                DataWarning,
                stacklevel=4,
            )


def warn_of_contacts(system: MechanicalSystem, dataset: Dataset) -> None:
    """Warn where rows contradict the contacts, which a model would learn away as a force (`contact_doubts`)."""
    if ("ignore", None, ContactWarning, None, 0) in warnings.filters:
        return  # whoever wants none, as the command line after its own look, need not pay for it
    for doubt in contact_doubts(dataset, system):
        if doubt.numbers.get("distance", 0.0) > FAR_FROM_SURFACE:
            continue  # check_distance refuses the rows or warns
        warnings.warn(str(doubt), ContactWarning, stacklevel=4)
