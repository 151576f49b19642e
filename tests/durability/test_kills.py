"""`kill -9` at any moment, and three writers at once: old outputs stay, and the next run leaves nothing behind."""

import random
import shutil
import time

import pytest
from tests.durability.commands import COMMANDS, KILLED, assert_one_line, leftovers, run, start

KILLS = 10  # of every command: 60 in all


@pytest.mark.nightly
@pytest.mark.parametrize("name", KILLED)
def test_a_kill_at_any_moment_costs_nothing_but_the_run(inputs, tmp_path, name):
    command, generator, out = COMMANDS[name], random.Random(name), tmp_path / "there" / "out"
    out.parent.mkdir()
    begin = time.monotonic()
    code, errors = run(command.line(out), inputs)
    assert code == 0, errors
    longest = time.monotonic() - begin
    for kill in range(KILLS):
        fresh = kill % 2 == 0
        if fresh:
            (out.unlink if out.is_file() else lambda: shutil.rmtree(out))()
        elif command.kind == "store":  # begin with a part of the jobs
            shutil.rmtree(next((out / "jobs").glob("*")))
        process, moment = start(command.line(out, again=not fresh), inputs), generator.uniform(0.2, 1.0) * longest
        time.sleep(moment)
        process.kill()
        process.communicate()
        if not fresh or (out.exists() and command.kind != "store"):
            command.require_whole(out)
        code, errors = run(command.line(out, again=out.exists()), inputs)
        assert code == 0, (kill, moment, errors)
        command.require_whole(out)
        assert not leftovers(tmp_path), (kill, moment)
        assert [entry.name for entry in out.parent.iterdir()] == ["out"]
    assert not leftovers(inputs)


@pytest.mark.nightly
@pytest.mark.parametrize("again", [False, True], ids=["new", "overwrite"])
@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_three_processes_at_one_output_leave_one_whole_output(inputs, tmp_path, name, again):
    command, out = COMMANDS[name], tmp_path / "out"
    if again:
        assert run(command.line(out), inputs)[0] == 0
    processes, codes = [start(command.line(out, again=again), inputs) for _ in range(3)], []
    for process in processes:
        _, errors = process.communicate()
        assert_one_line(process.returncode, errors)
        codes.append(process.returncode)
    assert 0 in codes
    if not again and command.kind != "store":
        assert codes.count(0) == 1, "one has replaced what another one had written"
    command.require_whole(out)
    assert not leftovers(tmp_path)
