"""Refinement on recorded motions where the base moves: derivatives, what is recovered, and turns of the world."""

import numpy as np
import pytest
import torch
from tests.fit.test_motion_fit import refined
from tests.posterior import floating_arm

from forcegp import Dataset
from forcegp.data.views import all_motions
from forcegp.fit import fit as fit_model
from forcegp.fit.motion_fit import MotionFit, Unknowns
from forcegp.mechanics import fixed_point
from forcegp.model import Model


def with_switch(log: Dataset) -> Dataset:
    """The tip of the arm is held in some rows: an array of derivatives, not a motion that could be."""
    model = log.model
    held = Model(model.robot, fixed_point("arm", (0.4, 0.0, 0.0), switch="held"), model.forces)
    u = np.concatenate([log.u, (np.arange(len(log)) % 5 < 2)[:, None].astype(float)], axis=1)
    return Dataset(q=log.q, v=log.v, u=u, a=log.a, time=log.time, model=held, noise_std=[0.05] * 7)


@pytest.mark.parametrize("switched", [False, True])
def test_derivatives_in_every_unknown_and_start(switched):
    """Of whitened residuals by finite differences, away from the recorded motions."""
    log = floating_arm.recording(3, 0.5, floating_arm.satellite())
    log = with_switch(log) if switched else log
    posterior = fit_model(log.model, log, points=20, restarts=1)
    unknowns = Unknowns.of(posterior, log, True)
    recorded, stride = all_motions(log, 0.16, 0.04)
    assert stride == 2
    fit = MotionFit(recorded, stride, unknowns)
    generator, noise = torch.Generator().manual_seed(0), torch.linspace(0.5, 2.0, 7, dtype=torch.float64)
    x = torch.as_tensor(unknowns.space.start) + 0.05 * torch.rand(
        unknowns.space.size, generator=generator, dtype=torch.float64
    )
    states = fit.start + 0.1 * torch.rand(fit.start.shape, generator=generator, dtype=torch.float64)
    here, small = fit.at(x, states, noise, noise, None), 1e-5
    assert bool(here.motions.found.all())
    _, in_states, in_x = fit.whitened(here, noise)

    def differences(change: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        ends = []
        for sign in (small, -small):
            at = (x, states + sign * change) if vector is states else (x + sign * change, states)
            ends.append(fit.whitened(fit.at(*at, noise, noise, here.motions), noise)[0])
        return (ends[0] - ends[1]) / (2.0 * small)

    for vector, derivatives in ((states, in_states), (x, in_x)):  # a direction shows a fault in any of its entries
        along = torch.randn(derivatives.shape[-1], generator=generator, dtype=torch.float64)
        expected, scale = differences(along, vector), float(derivatives.abs().max())
        torch.testing.assert_close(derivatives @ along, expected, rtol=1e-4, atol=1e-6 * scale)


@pytest.mark.nightly
def test_friction_and_mass_are_recovered_in_any_axes_of_the_world():
    given = floating_arm.satellite(0.1, 0.2, mass=7.0)
    log = floating_arm.recording(1, 2.0, given, bump=0.0)
    rough = fit_model(given, log, points=40, restarts=1)
    fits = [refined(rough, rows, 0.5) for rows in (log, floating_arm.turned(log))]
    found, again = ({each.name: each.value for each in better.parameters.values()} for better in fits)
    assert found["viscous.shoulder"] == pytest.approx(0.2, rel=0.02)
    assert found["coulomb.level.shoulder"] == pytest.approx(0.3, rel=0.02)
    of_laws = [name for name in found if "shoulder" in name]
    assert [again[name] for name in of_laws] == pytest.approx([found[name] for name in of_laws], rel=1e-4)
    masses = [[better.model.robot.link(name).mass for name in ("hull", "arm")] for better in fits]
    assert sum(masses[0]) == pytest.approx(10.0, rel=0.01)
    assert masses[1] == pytest.approx(masses[0], rel=1e-4)
