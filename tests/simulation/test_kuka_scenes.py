"""The scenario's kinds of friction, surface and contact: the physics by forcegp's own robot."""

import numpy as np
import pytest
import torch

from forcegp.errors import InvalidInput
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface


@pytest.mark.parametrize(
    "scene",
    [
        {"friction": "stribeck", "joint_friction": "stribeck"},
        {"surface": "tilted", "friction": "coulomb"},
        {"surface": "none", "joint_friction": "stribeck"},
    ],
)
def test_the_equations_of_motion_hold_in_every_row(scene):
    data = simulate_kuka_surface(KukaSurfaceConfig(seconds=1.0, settle_seconds=1.5, seed=5, **scene))
    q, v, u = (torch.tensor(getattr(data, name)) for name in "qvu")
    dynamics, a = data.model.dynamics(q, v, u), torch.tensor(data.truth["a"])
    force = u + torch.tensor(data.truth["Q_U"])
    if data.model.contacts:
        force = force + (dynamics.A.mT @ torch.tensor(data.truth["lambda"])[..., None])[..., 0]
        np.testing.assert_allclose((dynamics.A @ a[..., None])[..., 0], dynamics.b, rtol=0, atol=1e-10)
    np.testing.assert_allclose(data.model.robot.inverse_dynamics(q, v, a), force, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"friction": "wet"}, "no friction .wet. in the tool"), ({"surface": "cone"}, "no surface 'cone'")],
)
def test_parts_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(InvalidInput, match=message):
        KukaSurfaceConfig(**changes)
