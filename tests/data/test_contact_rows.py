import dataclasses

import numpy as np
import pytest
import torch

from forcegp.data import Dataset, contact_rows, rows_in_contact
from forcegp.errors import ContactError
from forcegp.mechanics import Contact, Plane
from forcegp.simulation import KukaSurfaceConfig, QuadrupedConfig, simulate_kuka_surface, simulate_quadruped


@pytest.fixture(scope="module")
def hopping() -> Dataset:
    """A quarter of the rows has the acceleration of a tool that the surface does not hold, some are 3 cm above it."""
    data = simulate_kuka_surface(KukaSurfaceConfig(seconds=8.0, seed=5, friction="coulomb"))
    q, v, u = (torch.tensor(x) for x in (data.q, data.v, data.u))
    free = data.model.with_contacts(()).dynamics(q, v, u)
    released = free.acceleration(torch.zeros_like(v)).numpy() + data.a - data.truth["a"]
    acts = np.arange(len(data)) % 400 >= 100
    raised = np.arange(len(data)) % 400 < 50
    J = free.state.kinematics.frame_jacobian("lbr_iiwa_link_7", (0.0, 0.0, 0.1))[:, 2:3]
    away = 0.03 * torch.linalg.pinv(J)[..., 0].numpy() * raised[:, None]
    a = np.where(acts[:, None], data.a, released)
    return dataclasses.replace(data, q=data.q + away, a=a, truth={"in_contact": acts[:, None].astype(float)})


@pytest.mark.parametrize("noise_is_known", [True, False])
def test_rows_in_contact_are_those_where_the_simulator_pushed(hopping, noise_is_known):
    data = hopping if noise_is_known else dataclasses.replace(hopping, noise_std=None)
    true, found = data.truth["in_contact"].astype(bool), contact_rows(data)
    assert true.mean() < 0.95
    assert (found & true).sum() / found.sum() > 0.98
    assert (found & true).sum() / true.sum() > 0.98
    kept = rows_in_contact(data)
    np.testing.assert_array_equal(kept.time, data.time[found[:, 0]])


def test_flags_decide_where_a_contact_has_a_switch():
    """Noise of a foot's velocity is no reason to leave its stance out, which would leave swing to learn from."""
    walk = simulate_quadruped(QuadrupedConfig(seconds=1.0, seed=1))
    noisy = dataclasses.replace(walk, v=walk.v + 0.05 * np.random.default_rng(0).normal(size=walk.v.shape))
    assert contact_rows(noisy).all()


@pytest.mark.parametrize("surface", ["plane", "tilted"])
def test_an_ideal_contact_keeps_its_rows(surface):
    data = simulate_kuka_surface(KukaSurfaceConfig(seconds=4.0, seed=6, surface=surface))
    assert contact_rows(data).mean() > 0.999


def test_a_row_that_leaves_the_constraint_does_not_count():
    data = simulate_kuka_surface(KukaSurfaceConfig(seconds=2.0, seed=6, noise=0.0))
    dynamics = data.model.dynamics(*(torch.tensor(getattr(data, name)) for name in "qvu"))
    pull = 1.0 * torch.linalg.pinv(dynamics.A[50])[:, 0].numpy()  # 1 m/s^2 along the normal
    a = data.a.copy()
    a[50] += pull
    before, after = (contact_rows(dataclasses.replace(data, a=each, truth={}, noise_std=None)) for each in (data.a, a))
    assert before[50]
    assert np.flatnonzero(before != after).tolist() == [50]


def test_a_surface_in_the_wrong_place_is_told(hopping):
    (contact,) = hopping.model.contacts
    wrong = Contact(contact.frame, contact.point, Plane((0.0, 0.0, 1.0), 0.5))
    data = dataclasses.replace(hopping, model=hopping.model.with_contacts([wrong]))
    with pytest.raises(ContactError, match=r"contact 0 \(frame 'lbr_iiwa_link_7'\).*0\.445 m") as error:
        rows_in_contact(data)
    assert "leave this contact out" in str(error.value)


def test_every_contact_has_a_column_and_all_must_act(hopping):
    (contact,) = hopping.model.contacts
    here = contact_rows(hopping)[:, 0]
    both = dataclasses.replace(hopping, truth={}, model=hopping.model.with_contacts([contact, contact]))
    np.testing.assert_array_equal(contact_rows(both), np.stack([here, here], axis=1))
    assert len(rows_in_contact(both)) == here.sum()
