"""A prior that forcegp does not bring is one short file, found by name and in stored models, and shown in the docs."""

import re

import pytest
import torch
from tests.forces.third_party_unknown import AirDrag
from tests.posterior.arm import arm_data

from forcegp.data import Dataset
from forcegp.fit import fit
from forcegp.forces import force_to_dict, parse_forces
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise


@pytest.fixture(scope="module")
def text(repository):
    return (repository / "tests/forces/third_party_unknown.py").read_text(encoding="utf-8")


def test_the_page_on_forces_shows_the_same_short_file(repository, text):
    assert len(text.splitlines()) < 60
    page = (repository / "docs" / "how-to" / "forces.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert [block for block in blocks if "class AirDrag" in block] == [text]


def test_it_is_found_by_name_and_can_be_stored():
    assert parse_forces("gp:air-drag:frame=hand") == (AirDrag("hand"),)
    assert parse_forces("gp:air-drag:frame=hand,kernel=constant,gp:joint-friction")[0] == AirDrag("hand", "constant")
    assert force_to_dict(AirDrag("hand")) == {"type": "air-drag", "frame": "hand", "kernel": AirDrag("hand").kernel}


def test_it_finds_the_drag_that_acts():
    data = arm_data(40, 1)
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    dynamics = data.model.dynamics(*states)
    tip = dynamics.state.kinematics.frame_jacobian("hand")[..., :3, :]
    velocity = (tip @ states[1][..., None])[..., 0]
    force = -1.7 * velocity.norm(dim=-1, keepdim=True) * velocity
    a = dynamics.acceleration((tip.mT @ force[..., None])[..., 0])
    rows = Dataset(q=data.q, v=data.v, u=data.u, a=a.numpy(), time=data.time, model=data.model)
    model = data.model.with_forces(AirDrag("hand", kernel="constant"), noise=Noise(1e-3))
    part = fit(model, rows, restarts=1, options=OptimizerOptions(iterations=20)).components(*states)["air-drag"]
    torch.testing.assert_close(part.latents.mean, torch.full((40, 1), 1.7).double(), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(part.point_force.mean, force, rtol=1e-3, atol=1e-4)
