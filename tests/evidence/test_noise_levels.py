"""Levels of noise that residuals were drawn with are found again, and whiten them."""

import dataclasses

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data, arm_model

from forcegp.errors import InvalidInput
from forcegp.evidence.least_squares import NoiseLevels
from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise

ACCELERATION, FORCE = np.array([0.5, 2.0]), np.array([0.3, 0.1])


def drawn(rows: int, acceleration, force, seed: int = 0):
    generator = np.random.default_rng(seed)
    factors = generator.normal(0.0, 0.5, (rows, 2, 2))
    M = factors @ factors.swapaxes(-1, -2) + np.diag([0.3, 0.01])
    noise = generator.normal(0.0, 1.0, (rows, 2)) * force
    return np.linalg.solve(M, noise[..., None])[..., 0] + generator.normal(0.0, 1.0, (rows, 2)) * acceleration, M


def test_no_levels_are_likelier():
    """The negative log likelihood, written with determinants, is smaller than at levels a little off."""
    residual, M = drawn(400, ACCELERATION, FORCE)
    found = NoiseLevels.of(residual, M)

    def cost(levels: NoiseLevels) -> float:
        inverse = np.linalg.inv(M)
        S = np.diag(levels.acceleration**2) + inverse @ np.diag(levels.force**2) @ inverse
        quadratic = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(S), residual)
        return float(0.5 * (quadratic + np.log(np.linalg.det(S))).sum())

    least = cost(found)
    for joint in range(2):
        for factor in (0.7, 1.4):
            off = np.ones(2)
            off[joint] = factor
            assert cost(NoiseLevels(found.acceleration * off, found.force)) > least
            assert cost(NoiseLevels(found.acceleration, found.force * off)) > least


def test_noise_of_forces_is_learned_beside_that_of_accelerations():
    data = arm_data(150, 6, arm_model(0))  # without contacts, for those hide what the forces do along their normal
    generator = np.random.default_rng(6)
    H = data.model.dynamics(*map(torch.tensor, (data.q, data.v, data.u))).H.numpy()
    moved = 0.02 * generator.normal(size=data.a.shape) + (H @ generator.normal(0.0, 0.3, (150, 3, 1)))[..., 0]
    noisy = dataclasses.replace(data, a=data.truth["a"] + moved, noise_std=np.full(3, 0.02))
    model = data.model.with_forces(JointForces(), noise=Noise(None, 0.1, learn=True))
    fitted = fit(model, noisy, restarts=1, options=OptimizerOptions(iterations=25))
    learned = fitted.hyperparameters["noise.log_force"].exp()
    assert bool(((learned > 0.15) & (learned < 0.6)).all())
    assert bool((fitted.noise_std < 0.2).all())


def test_a_noise_that_only_data_can_tell_is_none_without_them():
    with pytest.raises(InvalidInput, match="from the dataset of a fit"):
        Noise(None).parameters(3)
    assert Noise.from_dict(Noise(None, 0.1).to_dict()) == Noise(None, 0.1)
