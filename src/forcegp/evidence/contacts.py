"""Whether the rows that a model learns from touch its contacts."""

import warnings

import torch

from forcegp.errors import ContactError, DataWarning
from forcegp.evidence.training_data import TrainingData
from forcegp.model import Model

FAR_FROM_SURFACE = 0.01
"""Median distance of the training points from a contact's surface, in m, beyond which a warning is given."""


def check_distance(model: Model, training: TrainingData) -> None:
    """Refuse a surface that no training state touches, and warn where half of them are far from it."""
    kinematics = model.robot.kinematics(training.q)
    for index, contact in enumerate(model.contacts):
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
            _warn(
                f"half of the training points lie more than {distance:.3g} m from {what}; {remedy}, or train on the "
                "rows in contact only (forcegp.data.rows_in_contact)"
            )


def _warn(text: str) -> None:
    warnings.warn(text, DataWarning, stacklevel=6)
