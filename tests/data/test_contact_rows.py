"""Rows in which tools touch what they slide on."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from forcegp.data import Dataset, rows_in_contact
from forcegp.errors import ContactError
from forcegp.mechanics import Plane
from forcegp.simulation import KukaSurfaceConfig, QuadrupedConfig, simulate_kuka_surface, simulate_quadruped


@pytest.fixture(scope="module")
def sliding() -> Dataset:
    return simulate_kuka_surface(KukaSurfaceConfig(seconds=3.0, seed=5, surface="tilted"))


def test_rows_above_the_surface_are_left_out(sliding):
    assert len(rows_in_contact(sliding)) == len(sliding)
    raised = np.arange(len(sliding)) % 400 < 50
    state = sliding.model.state(*(torch.tensor(getattr(sliding, name)) for name in "qvu"))
    J = state.kinematics.frame_jacobian("lbr_iiwa_link_7", (0.0, 0.0, 0.1))[:, 2:3]
    away = torch.linalg.pinv(J)[..., 0].numpy() * raised[:, None]
    for name, size in (("q", 0.012), ("v", 0.3)):  # m, above the 5 mm that may be; m/s
        hopping = replace(sliding, **{name: getattr(sliding, name) + size * away}, truth={})
        np.testing.assert_array_equal(rows_in_contact(hopping).time, sliding.time[~raised])


def test_flags_decide_where_a_contact_has_a_switch():
    """Noise of a foot's velocity is no reason to leave its stance out, which would leave swing to learn from."""
    walk = simulate_quadruped(QuadrupedConfig(seconds=1.0, seed=1))
    noisy = replace(walk, v=walk.v + 0.05 * np.random.default_rng(0).normal(size=walk.v.shape))
    assert len(rows_in_contact(noisy)) == len(walk)


def test_a_surface_in_the_wrong_place_is_told(sliding):
    wrong = replace(sliding.model.contacts[0], surface=Plane((0.0, 0.0, 1.0), 0.5))
    both = replace(sliding, truth={}, model=sliding.model.with_contacts([*sliding.model.contacts, wrong]))
    with pytest.raises(ContactError, match=r"contact 1 \(frame 'lbr_iiwa_link_7'\).*leave the contact out"):
        rows_in_contact(both)
