"""What every backend promises. A backend of your own: subclass this and give the fixture `backend`."""

from functools import partial

import pytest
from tests.parallel import tasks

from forcegp.errors import BackendError
from forcegp.parallel import Serial


class BackendConformance:
    def test_outcomes_are_those_of_one_process_in_the_order_of_the_arguments(self, backend):
        seeds = [5, 3, 8, 1, 9]
        assert list(backend.map(tasks.seeded_sum, seeds)) == list(Serial().map(tasks.seeded_sum, seeds))
        assert list(backend.map(tasks.slow_first, range(4))) == [0, 1, 2, 3]

    def test_nothing_to_do_is_no_outcome(self, backend):
        assert list(backend.map(tasks.seeded_sum, [])) == []

    def test_functions_without_a_module_travel_too(self, backend):
        offset = 3
        assert list(backend.map(lambda number: number + offset, [1, 2])) == [4, 5]
        assert list(backend.map(partial(pow, 2), [3, 4])) == [8, 16]

    def test_an_exception_passes_through_in_its_place(self, backend, tmp_path):
        outcomes = backend.map(tasks.mark_or_fail, [tmp_path / "first", None, tmp_path / "third"])
        assert next(outcomes) == tmp_path / "first"
        with pytest.raises(tasks.TypedError, match="no luck") as caught:
            next(outcomes)
        assert caught.value.code == 7

    def test_outcomes_come_as_soon_as_they_are_there(self, backend, tmp_path):
        """The second task waits for what the caller does with the outcome of the first."""
        gate = tmp_path / "gate"

        def wait_for_the_gate(index):
            import time

            for _ in range(12_000):
                if index == 0 or gate.exists():
                    return index
                time.sleep(0.05)
            return "the gate stayed shut"

        outcomes = backend.map(wait_for_the_gate, [0, 1])
        assert next(outcomes) == 0
        gate.touch()
        assert next(outcomes) == 1

    def test_warnings_of_tasks_reach_the_caller(self, backend):
        with pytest.warns(UserWarning, match="look here"):
            assert list(backend.map(tasks.warn, [1])) == [1]

    def test_tasks_are_submitted_with_their_arguments(self, backend):
        future = backend.submit(lambda shared, extra: sum(shared) + extra, [1, 2, 3], 10)
        assert future.result() == 16


class WorkersConformance(BackendConformance):
    """More that backends promise which compute elsewhere than in this process."""

    def test_workers_are_kept_between_calls_and_compute_on_one_thread(self, backend):
        first = set(backend.map(tasks.process, range(6)))
        again = set(backend.map(tasks.process, range(6)))
        assert first & again
        [counts] = backend.map(tasks.threads, [0])
        assert len(counts) > 1
        assert set(counts) == {1}

    def test_a_worker_that_is_killed_is_an_error_and_the_next_call_has_another(self, backend, tmp_path):
        with pytest.raises(BackendError, match=r"processes broke off, .*try fewer jobs"):
            list(backend.map(tasks.die, [tmp_path]))
        assert len(list(tmp_path.iterdir())) == 1
        assert list(backend.map(tasks.slow_first, [0, 1])) == [0, 1]
