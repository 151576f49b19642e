"""Log-Cholesky parameters, pseudo-inertia and (mass, centre of mass, inertia) are three names of one thing."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck

from forcegp.errors import InvalidInput
from forcegp.robots import parameters_from_physical, physical_from_parameters, pseudo_inertia_from_parameters
from forcegp.robots.inertia import rotation_from_rpy, rpy_from_rotation

values = st.floats(-3, 3)
parameters = st.lists(values, min_size=10, max_size=10).map(lambda x: torch.tensor(x, dtype=torch.float64))


@given(parameters)
def test_round_trip(given_parameters):
    mass, center, inertia = physical_from_parameters(given_parameters)
    back = parameters_from_physical(mass, center, inertia)
    torch.testing.assert_close(back[[0, 7, 8, 9]], given_parameters[[0, 7, 8, 9]], rtol=1e-14, atol=1e-14)
    again = physical_from_parameters(back)
    torch.testing.assert_close(again[0], mass, rtol=1e-14, atol=0)
    torch.testing.assert_close(again[2], inertia, rtol=1e-13, atol=1e-13 * inertia.abs().max().item())
    # a thin body's parameters amplify the rounding of its inertia by its slenderness, squared
    second_moment = 0.5 * inertia.trace() * torch.eye(3, dtype=torch.float64) - inertia
    slenderness = torch.linalg.cond(second_moment).item()
    torch.testing.assert_close(back, given_parameters, rtol=1e-14, atol=1e-15 * (10.0 + slenderness))


@given(parameters)
def test_every_parameter_vector_is_a_physical_body(given_parameters):
    mass, _, inertia = physical_from_parameters(given_parameters)
    moments = torch.linalg.eigvalsh(inertia)
    assert mass > 0
    assert moments[0] > 0
    assert moments[0] + moments[1] > moments[2] * (1 - 1e-12)


def test_pseudo_inertia_is_the_second_moment_of_the_mass():
    # four point masses: their homogeneous second moments, summed, are the pseudo-inertia
    masses = np.array([0.5, 1.0, 0.7, 0.3])
    points = np.array([[0.1, 0.2, 0.3], [-0.2, 0.4, 0.0], [0.3, -0.1, 0.2], [0.0, 0.1, -0.5]])
    mass = masses.sum()
    center = masses @ points / mass
    offsets = points - center
    inertia = sum(m * ((r @ r) * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, offsets, strict=True))
    homogeneous = np.c_[points, np.ones(4)]
    expected = homogeneous.T @ np.diag(masses) @ homogeneous
    ours = parameters_from_physical(torch.tensor(mass), torch.tensor(center), torch.tensor(inertia))
    np.testing.assert_allclose(pseudo_inertia_from_parameters(ours), expected, rtol=1e-13, atol=1e-15)


def test_batches_and_derivatives():
    x = torch.linspace(-1, 1, 60, dtype=torch.float64).reshape(2, 3, 10).requires_grad_()
    assert [part.shape for part in physical_from_parameters(x)] == [(2, 3), (2, 3, 3), (2, 3, 3, 3)[:4]]
    torch.testing.assert_close(parameters_from_physical(*physical_from_parameters(x)), x, rtol=1e-11, atol=1e-11)
    assert gradcheck(physical_from_parameters, [x])
    assert gradcheck(pseudo_inertia_from_parameters, [x])


@pytest.mark.parametrize("moments", [(1.0, 1.0, 2.0), (0.0, 1.0, 1.0), (1.0, 1.0, 2.5), (0.0, 0.0, 0.0)])
def test_flat_and_impossible_bodies_have_no_parameters(moments):
    inertia = torch.diag(torch.tensor(moments, dtype=torch.float64))
    with pytest.raises(InvalidInput, match="triangle inequality strictly"):
        parameters_from_physical(torch.ones((), dtype=torch.float64), torch.zeros(3, dtype=torch.float64), inertia)
    with pytest.raises(InvalidInput, match="positive mass"):
        parameters_from_physical(-torch.ones((), dtype=torch.float64), torch.zeros(3, dtype=torch.float64), inertia)


@pytest.mark.parametrize("pitch", [0.3, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, 2.5])
def test_angles_of_a_rotation_give_it_back(pitch):
    for roll, yaw in ((0.0, 0.0), (1.0, -2.0), (-3.0, 0.4)):
        rotation = rotation_from_rpy((roll, pitch, yaw))
        np.testing.assert_allclose(rotation_from_rpy(rpy_from_rotation(rotation)), rotation, atol=1e-15)
