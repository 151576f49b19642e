"""Motions end where they diverge, say so, and leave the others alone."""

import pytest
import torch

from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.integration import (
    SPEED_LIMIT,
    ImplicitMidpoint,
    RungeKutta4,
    SymplecticEuler,
    integrate,
)


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def explosive(q, v, u):
    """Grows without bound from v > 0, and is not finite beyond q = 1; decays for v <= 0."""
    assert bool(torch.isfinite(q).all() and torch.isfinite(v).all())
    return torch.where(v > 0, 40.0 * v, -v) / (q < 1.0)


@pytest.mark.parametrize("integrator", [SymplecticEuler(), RungeKutta4()], ids=["euler", "rk4"])
def test_a_diverging_motion_is_nan_from_where_it_says_and_the_others_go_on(integrator):
    q0, v0, force = column(0.0, 0.0, 0.5), column(1.0, -1.0, -2.0), torch.zeros(100, 3, 1, dtype=torch.float64)
    with pytest.warns(NumericalWarning, match=r"1 of 3 motions .*step \d+"):
        motion = integrate(integrator, explosive, q0, v0, force, 0.01)
    row = int(motion.diverged_at[0])
    assert 0 < row < 100
    assert motion.diverged_at[1:].tolist() == [-1, -1]
    for rows in (motion.q, motion.v):
        assert torch.isfinite(rows[:row, 0]).all()
        assert torch.isnan(rows[row:, 0]).all()
    assert torch.isnan(motion.a[row:, 0]).all()
    assert (motion.v[:row, 0].abs() <= SPEED_LIMIT).all()
    alone = integrate(integrator, explosive, q0[1:], v0[1:], force[:, 1:], 0.01)
    # vector instructions round a batch of three otherwise than one of two, at each of 100 steps
    torch.testing.assert_close(motion.q[:, 1:], alone.q, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(motion.a[:, 1:], alone.a, rtol=1e-11, atol=1e-11)


def test_a_motion_whose_implicit_step_has_no_solution_ends_with_that_reason():
    """Dry friction that jumps at rest has none where the motion stops."""
    q0, v0, force = column(0.0, 0.0), column(0.05, 5.0), torch.zeros(3, 2, 1, dtype=torch.float64)
    with pytest.warns(
        NumericalWarning, match=r"1 of 2 .* Newton's method found no solution of the implicit step\. They"
    ):
        motion = integrate(ImplicitMidpoint(), lambda q, v, u: -10.0 * v.sign(), q0, v0, force, 0.04)
    assert motion.diverged_at.tolist() == [1, -1]
    torch.testing.assert_close(motion.v[:, 1, 0], 5.0 - 0.4 * torch.arange(4, dtype=torch.float64))


def test_a_start_in_other_units_is_refused():
    force = torch.zeros(4, 1, 1, dtype=torch.float64)
    with pytest.raises(InvalidInput, match=r"v0 has a joint velocity of 150; .* check its units"):
        integrate(SymplecticEuler(), lambda q, v, u: -q, column(1.0), column(150.0), force, 0.1)
