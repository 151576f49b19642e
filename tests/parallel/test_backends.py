"""Backends on this machine keep the promises of all backends; wrong arguments are told in one sentence."""

import inspect
import os

import pytest
from tests.parallel import tasks
from tests.parallel.conformance import BackendConformance, WorkersConformance

from forcegp.errors import InvalidInput
from forcegp.parallel import Joblib, Serial, backend_for


class TestSerial(BackendConformance):
    @pytest.fixture
    def backend(self):
        return Serial()

    def test_it_computes_here_and_nothing_before_it_is_asked_for(self, backend, tmp_path):
        outcomes = backend.map(tasks.mark, [tmp_path / "a", tmp_path / "b"])
        assert next(outcomes) == tmp_path / "a"
        assert not (tmp_path / "b").exists()
        assert list(backend.map(tasks.process, [0])) == [os.getpid()]


class TestJoblib(WorkersConformance):
    @pytest.fixture
    def backend(self):
        return Joblib(2)

    def test_it_computes_in_so_many_other_processes(self, backend):
        found = set(backend.map(tasks.process, range(8)))
        assert len(found) == 2
        assert os.getpid() not in found


def test_backends_by_name():
    assert backend_for("serial") == Serial() == backend_for("serial", 1)
    assert backend_for("joblib", 3) == Joblib(3)
    assert backend_for("joblib") == Joblib(os.cpu_count())


def test_what_functions_mean_by_jobs_and_backend():
    assert backend_for(None) == backend_for(None, 1) == Serial()
    assert (
        backend_for(None, 2)
        == Joblib(2)
        == backend_for("joblib", 2)
        == backend_for(Joblib(2))
        == backend_for(Joblib(2), 2)
    )
    with pytest.raises(InvalidInput, match=r"jobs=3 contradicts backend=Joblib\(jobs=2\)"):
        backend_for(Joblib(2), 3)
    with pytest.raises(InvalidInput, match=r"int; .*Serial\(\), Joblib\(jobs\)"):
        inspect.unwrap(backend_for)(2)  # without the run-time checks of tests, which users do not have


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: backend_for("dask"), "no backend 'dask'; choose serial, joblib"),
        (lambda: backend_for("joblib", 0), "jobs is 0; give the number of tasks at once, at least 1"),
        (lambda: backend_for(None, -2), "jobs is -2; give"),
        (lambda: Joblib(1.5), "jobs is 1.5; give"),  # type: ignore[arg-type]  # the mistake that is told
        (lambda: backend_for("serial", 2), "serial does one task at a time, not 2; choose joblib"),
    ],
)
def test_wrong_arguments_are_told(make, told):
    with pytest.raises(InvalidInput) as caught:
        make()
    assert told in str(caught.value)
