"""Thousands of updates in a row: no drift, no growth, and the predictor is that of the rows held."""

import numpy as np
import pytest
from tests.fuzz import soak


def run(updates: int, looks: int) -> None:
    """So many updates by a row each, looked at now and then."""
    posterior, rows = soak.start()
    order = np.random.default_rng(3).integers(soak.BUDGET, len(rows), updates)
    worst, before, numbers = 0.0, None, None
    for count, number in enumerate(order, 1):
        posterior = posterior.update(rows[number], soak.BUDGET)
        if count % (updates // looks) == 0:
            worst = max(worst, soak.drift(posterior))
            numbers = numbers or soak.tensors(posterior)
            assert soak.tensors(posterior) == numbers
            before = before or soak.memory()
    assert worst <= 1e-8, worst
    assert soak.predictor_error(posterior) <= 1e-8
    assert posterior.settings["points"] == soak.BUDGET
    assert posterior.settings["rows_added"] == updates
    grown = soak.memory() - before
    assert grown < 16 * 2**20, grown
    print(f"{updates} updates: drift {worst:.1e}, {grown / 2**20:.1f} MiB more")


def test_updates_do_not_drift():
    run(50, 5)


@pytest.mark.nightly
def test_twenty_thousand_updates_do_not_drift():
    run(20_000, 40)
