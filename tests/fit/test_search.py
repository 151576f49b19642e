"""Several starts of one search: when they end, which are dropped; the same in any number of processes."""

import pytest
import torch
from tests.posterior.arm import arm_data

from forcegp.fit import fit
from forcegp.fit.search import AT_ONCE, best_value, run_restarts
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions, minimize_objective


@pytest.fixture(scope="module")
def train():
    return arm_data(40, seed=1)


def valley(parameters):
    """Two basins along x, at 0 and, 40 higher, at 4; narrow and bent across."""
    x, y = parameters["x"]
    return 10.0 * x + 5.0 * (x * (x - 4.0)) ** 2 + 50.0 * (y - x**2) ** 2


def from_place(index, before=(), *, options, places=(0.5, 4.5, 5.0, -0.5, 5.5)):
    start = {"x": torch.tensor([places[index], 2.0], dtype=torch.float64)}
    return minimize_objective(valley, start, options, rival=best_value(before))


def test_starts_behind_those_before_are_dropped_and_say_so():
    options = OptimizerOptions(patience=5)
    found = run_restarts(lambda index, **how: from_place(index, **how, options=options), 5, 5, 1)
    assert [each.status.startswith("dropped: 5 iterations") for each in found] == [False, False, True, False, True]
    alone = from_place(2, options=options)
    assert alone.converged
    assert not found[2].converged
    assert found[2].evaluations < alone.evaluations
    assert found[2].history == alone.history[: len(found[2].history)]


def test_a_fit_reports_the_end_of_every_start(train):
    model, options = train.model.with_forces(JointForces()), OptimizerOptions(patience=1)
    posterior = fit(model, train, restarts=4, seed=1, options=options)
    statuses, values = posterior.settings["restart_status"], posterior.settings["restart_objective"]
    assert len(statuses) == len(values) == 4
    dropped = [status.startswith("dropped") for status in statuses]
    assert not any(dropped[:AT_ONCE])
    assert any(dropped[AT_ONCE:])
    assert f"best of 4 starts, {sum(dropped)} of them dropped" in posterior.result.status
    assert all(value > posterior.result.value for value, drop in zip(values, dropped, strict=True) if drop)


def test_who_is_compared_with_whom_does_not_depend_on_the_processes_or_the_number_of_starts():
    def seen(index, before):
        return index, list(before)

    serial = run_restarts(seen, 5, 100, 1)
    assert [len(before) for _, before in serial] == [0, 0, 2, 2, 4]
    assert (serial, serial[:3]) == (run_restarts(seen, 5, 100, 2), run_restarts(seen, 3, 100, 1))
    assert all(before == [] for _, before in run_restarts(seen, 5, 0, 1))
