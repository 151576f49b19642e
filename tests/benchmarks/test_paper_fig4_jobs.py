"""Rolling out: what the recorded motions, the true dynamics, the displaced starts and the feedback are."""

import numpy as np
import pytest
import torch
from benchmarks.paper import fig4_jobs
from benchmarks.paper.fig4_jobs import FREQUENCY, OFFSET, PERTURBATIONS
from tests.benchmarks.oracle import Tool
from tests.benchmarks.stored_jobs import DATA

SECONDS, STARTS = 0.2, 3


@pytest.fixture(scope="module")
def recorded(motion):
    return fig4_jobs._Recorded(motion, STARTS, SECONDS)


def test_recorded_motions_are_pieces_of_the_trajectory(recorded, motion):
    assert recorded.dt == pytest.approx(1 / 240)
    steps = round(240 * SECONDS)
    assert recorded.q.shape == recorded.v.shape == (STARTS, steps + 1, 7)
    assert recorded.u.shape == (STARTS, steps, 7)
    for piece, first in enumerate((0, 216, 431)):  # the first row, the middle, and the last that has a whole motion
        np.testing.assert_array_equal(recorded.q[piece], motion.q[first : first + steps + 1])
        np.testing.assert_array_equal(recorded.v[piece], motion.v[first : first + steps + 1])
        np.testing.assert_array_equal(recorded.u[piece], motion.u[first : first + steps])


def test_the_true_dynamics_reproduce_the_recording(run, tmp_path):
    found = fig4_jobs.truth(run, {"data": DATA, "starts": STARTS, "seconds": [0.1, SECONDS]}, tmp_path)
    errors = found["joint_error"]
    assert list(errors) == ["0", *(f"{size:g}" for size in PERTURBATIONS)]
    assert max(errors["0"]["0.2"]) < 1e-9
    for size in PERTURBATIONS:  # it is the start that is changed, by about as much as the name says
        assert 0.01 * size < np.median(errors[f"{size:g}"]["0.1"]) < 100.0 * size
    assert 0.0 < found["recorded_constraint"]["median"] <= found["recorded_constraint"]["largest"] < 5e-3


def test_displaced_starts_are_exactly_off_the_surface_and_as_near_as_can_be(motion, recorded):
    q = recorded.q[:, 0]
    displaced, tool = fig4_jobs._displaced(motion.model, q), Tool(motion.model)
    height = motion.model.contacts[0].surface.offset
    for before, after in zip(q.numpy(), displaced.numpy(), strict=True):
        assert tool.position(after)[2] - height == pytest.approx(OFFSET, abs=1e-12)
        gap = tool.position(before)[2] - height
        gradient = np.array(
            [(tool.position(before + h)[2] - tool.position(before - h)[2]) / 2e-6 for h in 1e-6 * np.eye(7)]
        )
        nearest = (OFFSET - gap) * gradient / (gradient @ gradient)  # to first order
        np.testing.assert_allclose(after - before, nearest, rtol=0, atol=0.02 * np.abs(nearest).max())


def test_the_feedback_is_that_of_its_formula_and_nothing_on_the_recording(recorded, motion):
    feedback, oracle = recorded.feedback(), Tool(motion.model).oracle
    dq, dv = torch.randn(2, STARTS, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for k in (0, 17):
        q, v = recorded.q[:, k], recorded.v[:, k]
        assert torch.equal(feedback(k, q, v), torch.zeros_like(q))
        M = torch.tensor(np.array([oracle.mass_matrix(row) for row in q.numpy()]))
        expected = torch.einsum("nij,nj->ni", M, -(FREQUENCY**2) * dq - 2.0 * FREQUENCY * dv)
        torch.testing.assert_close(feedback(k, q + dq, v + dv), expected, rtol=1e-9, atol=1e-9)
