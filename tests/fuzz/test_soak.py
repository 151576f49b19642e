"""Thousands of updates in a row: no drift from a fit to the rows held, no growth, and the predictor is that of them."""

import dataclasses
import resource
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data, arm_model

from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions
from forcegp.posterior import Posterior

BUDGET = 8
POOL = 80
"""Rows that are shown again and again, each time in a different company."""


def start() -> tuple[Posterior, list]:
    """A posterior of a few rows, and single rows to learn from."""
    data = arm_data(POOL, 1, arm_model(0))
    posterior = fit(
        data.model.with_forces(JointForces()),
        data.rows(slice(0, BUDGET)),
        restarts=1,
        options=OptimizerOptions(iterations=8),
    )
    return posterior, [data.rows([k]) for k in range(POOL)]


def drift(posterior: Posterior) -> float:
    """The largest difference of a mean or covariance to conditioning on its rows at once, relative to the largest."""
    training = posterior.training
    settings = {"widening": posterior.widening}
    fresh = posterior.conditioned(posterior.trained, training, posterior.hyperparameters, posterior.result, settings)
    states = tuple(torch.tensor(x) for x in _states())
    mine, theirs = posterior.predict(*states), fresh.predict(*states)
    return max(
        float((getattr(mine, name) - getattr(theirs, name)).abs().max() / getattr(theirs, name).abs().max())
        for name in ("mean", "covariance")
    )


def predictor_error(posterior: Posterior) -> float:
    """The largest difference of the means of its predictor to `predict`, relative to the largest."""
    states = tuple(torch.tensor(x) for x in _states())
    mean = posterior.predict(*states).mean
    predictor = posterior.predictor(compile=False)
    there = torch.stack([predictor.mean(*(x[k] for x in states)) for k in range(len(mean))])
    return float((there - mean).abs().max() / mean.abs().max())


def memory() -> int:
    """Bytes that this process holds now."""
    status = Path("/proc/self/statm")
    if status.exists():
        return int(status.read_text().split()[1]) * resource.getpagesize()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def tensors(posterior: Posterior) -> int:
    """Numbers that its rows and those that standardise hold: they must not become more."""
    rows = posterior.training
    return sum(
        getattr(part, item.name).numel()
        for part in (rows, rows.reference)
        if part is not None
        for item in dataclasses.fields(part)
        if isinstance(getattr(part, item.name), torch.Tensor)
    )


def _states() -> tuple[np.ndarray, ...]:
    test = arm_data(5, 2, arm_model(0))
    return test.q, test.v, test.u


def run(updates: int, looks: int) -> None:
    """So many updates by a row each, looked at now and then."""
    posterior, rows = start()
    order = np.random.default_rng(3).integers(BUDGET, len(rows), updates)
    worst, before, numbers = 0.0, None, None
    for count, number in enumerate(order, 1):
        posterior = posterior.update(rows[number], BUDGET)
        if count % (updates // looks) == 0:
            worst = max(worst, drift(posterior))
            numbers = numbers or tensors(posterior)
            assert tensors(posterior) == numbers
            before = before or memory()
    assert worst <= 1e-8, worst
    assert predictor_error(posterior) <= 1e-8
    assert posterior.settings["points"] == BUDGET
    assert posterior.settings["rows_added"] == updates
    grown = memory() - before
    assert grown < 16 * 2**20, grown
    print(f"{updates} updates: drift {worst:.1e}, {grown / 2**20:.1f} MiB more")


def test_updates_do_not_drift():
    run(50, 5)


@pytest.mark.nightly
def test_twenty_thousand_updates_do_not_drift():
    run(20_000, 40)
