"""What every backend promises. A backend of your own: subclass this and give the fixture `backend`."""

from functools import partial

import pytest
from tests.parallel import tasks

from forcegp.errors import BackendError, WorkerWarning
from forcegp.parallel import MOST_DEATHS, Serial


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

    def test_tasks_of_a_pool_are_submitted_while_others_are_at_work(self, backend):
        """Each task needs the outcome of the one before."""
        numbers = [1, 2, 3]
        with backend.pool() as pool:
            pool.submit("a", lambda shared, extra: sum(shared) + extra, numbers, 10)
            [(key, future)] = pool.finished()
            assert (key, future.result(), len(pool)) == ("a", 16, 0)
            pool.submit("b", lambda extra, shared: sum(shared) + extra, future.result(), numbers)
            [(key, future)] = pool.finished()
            assert (key, future.result()) == ("b", 22)
            assert pool.free > 0


class WorkersConformance(BackendConformance):
    """More that backends promise which compute elsewhere than in this process."""

    def test_workers_are_kept_between_calls_and_compute_on_one_thread(self, backend):
        first = set(backend.map(tasks.process, range(6)))
        again = set(backend.map(tasks.process, range(6)))
        assert first & again
        [counts] = backend.map(tasks.threads, [0])
        assert len(counts) > 1
        assert set(counts) == {1}

    def test_a_worker_that_is_killed_is_replaced_and_the_run_completes(self, backend, tmp_path):
        arguments = [tmp_path / "marker", *(tmp_path / f"done{index}" for index in range(3))]
        for path in arguments[1:]:
            path.touch()  # these survive at once
        with pytest.warns(WorkerWarning, match="a process died while task"):
            found = list(backend.map(tasks.die_once, arguments))
        assert found == ["survived"] * 4

    @pytest.mark.nightly
    @pytest.mark.filterwarnings("ignore:a process died while:forcegp.errors.WorkerWarning")
    def test_a_task_that_always_kills_its_worker_ends_in_an_error(self, backend, tmp_path):
        with pytest.raises(BackendError, match=rf"{MOST_DEATHS + 1} times"):
            list(backend.map(tasks.die, [tmp_path]))
        assert len(list(tmp_path.iterdir())) == MOST_DEATHS + 1
        assert list(backend.map(tasks.slow_first, [0, 1])) == [0, 1]
