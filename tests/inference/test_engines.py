"""Which engine is taken, what memory each asks for, and which settings are refused."""

import math
from dataclasses import replace

import pytest
import torch

from forcegp.errors import InvalidInput, NotEnoughMemory
from forcegp.inference import engines, memory
from forcegp.inference.engines import Exact, Inducing, ProblemSize, choose_engine, engine_from_dict

CPU = torch.device("cpu")
SIZE = ProblemSize(rows=1000, outputs=2, rank=2, latents=3, features=9)
GIB = 2**30


@pytest.fixture
def free(monkeypatch):
    """A function that sets how many bytes are free."""

    def to(size):
        for module in (engines, memory):
            monkeypatch.setattr(module, "free_memory", lambda device: size)

    to(1000 * GIB)
    return to


@pytest.mark.parametrize(
    ("engine", "matrices"),
    [
        (Exact(), [(2000, 2000), (3000, 1000)]),
        (Inducing(100), [*[(300, 300)] * 3, (20_000, 100), (12 * 1000, 3 * 2)]),
        # its batch: ten matrices of the points and the rows of all latents
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_memory_is_that_of_the_matrices(engine, matrices):
    assert engine.required_bytes(SIZE) == sum(8 * rows * columns for rows, columns in matrices)


def test_learning_needs_two_more_matrices_for_each_latent():
    assert Exact().bytes_to_learn(SIZE) - Exact().required_bytes(SIZE) == 2 * 8 * 3 * 1000**2


def test_the_engine_follows_rows_features_and_memory(free):
    assert choose_engine(replace(SIZE, rows=1500), CPU).engine == Exact()
    assert choose_engine(replace(SIZE, rows=8000), CPU).engine == Exact()  # rN = 16,000
    assert choose_engine(replace(SIZE, rows=8001), CPU).engine == Inducing(points=1000, refine=0)
    assert choose_engine(replace(SIZE, rows=60_000), CPU).engine == Inducing(points=1000, refine=0)
    assert choose_engine(replace(SIZE, rows=1501, features=3), CPU).engine == Inducing()
    assert choose_engine(replace(SIZE, rows=1501, features=4), CPU).engine == Exact()
    assert choose_engine(replace(SIZE, rows=1501, features=3), CPU, inducing=False).engine == Exact()
    assert choose_engine(replace(SIZE, rows=10**6, latents=0), CPU).engine == Exact()
    few = replace(SIZE, features=2)
    free(Exact().required_bytes(few))  # 90 % of it may be planned with
    assert choose_engine(few, CPU).engine == Inducing()
    free(math.ceil(Exact().required_bytes(SIZE) / 0.9))
    assert choose_engine(SIZE, CPU).engine == Exact()
    free(1000)
    with pytest.raises(NotEnoughMemory, match="N=1000 rows"):
        choose_engine(SIZE, CPU)


@pytest.mark.parametrize(
    ("kind", "fine", "wrong"),
    [
        (Inducing, {"points": 1}, {"points": 0}),
        (Inducing, {"tolerance": 0.0}, {"tolerance": -1e-9}),
        (Inducing, {"refine": 0}, {"refine": -1}),
    ],
    ids=str,
)
def test_settings_up_to_their_bounds(kind, fine, wrong):
    engine = kind(**fine)
    assert engine_from_dict(engine.to_dict()) == engine
    ((name, value),) = wrong.items()
    with pytest.raises(InvalidInput, match=f"{name} is {value!r}"):
        kind(**wrong)


@pytest.mark.parametrize("stored", [None, ["exact"], {"name": "gone"}, {"name": "exact", "points": 3}, {"points": 3}])
def test_what_is_no_stored_engine_is_refused(stored):
    with pytest.raises(InvalidInput, match="exact, inducing"):
        engine_from_dict(stored)
