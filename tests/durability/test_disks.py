"""Full and read-only disks: one line, exit code 2, the old output as it was, and the next run succeeds."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.durability.commands import COMMANDS, assert_one_line, leftovers, run, snapshot

SIZES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 0.9, 0.97)  # of what a run needs; what is left free on the disk
PAGE = 4096


@pytest.fixture
def disk(tmp_path) -> Iterator[Callable[[str], Path]]:
    """`disk("size=1m")`: a file system of its own with these options; again with others it is mounted anew."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = False

    def mount(options: str) -> Path:
        nonlocal mounted
        words = ["-o", f"remount,{options}"] if mounted else ["-t", "tmpfs", "-o", options, "tmpfs"]
        done = subprocess.run(["mount", *words, place], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            pytest.skip(f"file systems cannot be mounted here: {done.stderr.strip()}")
        mounted = True
        return place

    if shutil.which("mount") is None or os.geteuid() != 0:
        pytest.skip("file systems cannot be mounted here")
    yield mount
    if mounted:
        subprocess.run(["umount", place], check=True)


def used(place: Path) -> int:
    status = os.statvfs(place)
    return (status.f_blocks - status.f_bfree) * status.f_frsize


@pytest.mark.nightly
@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_full_disk_leaves_the_old_output(inputs, disk, name):
    command, place = COMMANDS[name], disk("size=256m")
    out = place / "out"
    code, errors = run(command.line(out), inputs)
    assert code == 0, errors
    old, size, refused = snapshot(out), used(place), 0
    for part in SIZES:
        if command.kind == "store":  # these go on; jobs that are there stay as they are
            shutil.rmtree(out / "jobs")
            (out / "jobs").mkdir()
            for text in (file for file in out.glob("*") if file.is_file() and file.name not in ("jobs.json", ".lock")):
                text.unlink()
            old = snapshot(out)
        disk(f"size={used(place) + int(part * size) // PAGE * PAGE}")
        code, errors = run(command.line(out, again=True), inputs)
        assert_one_line(code, errors)
        refused += code == 2
        if code == 2 and command.kind != "store":
            assert snapshot(out) == old, part
        if code == 0:
            old = snapshot(out)
        command.require_whole(out)
        assert not leftovers(place), part
        disk("size=256m")
    assert refused >= len(SIZES) // 2, "the disk was never full"
    code, errors = run(command.line(out, again=True), inputs)
    assert code == 0, errors
    command.require_whole(out)
    assert not leftovers(place)


@pytest.mark.nightly
@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_read_only_disk_is_one_line(inputs, disk, name):
    command, place = COMMANDS[name], disk("size=64m")
    (place / "deep").mkdir()
    disk("ro")
    for out in (place / "out", place / "deep" / "er" / "out"):
        code, errors = run(command.line(out), inputs)
        assert_one_line(code, errors)
        assert code == 2
    disk("rw")
    code, errors = run(command.line(place / "out"), inputs)
    assert code == 0, errors
    assert not leftovers(place)


@pytest.mark.nightly
def test_a_predictor_where_nothing_may_be_run(inputs, disk):
    place, code = disk("size=64m,noexec"), "import sys, forcegp; forcegp.load_posterior(sys.argv[1]).predictor()"
    environment = {**os.environ, "XDG_CACHE_HOME": str(place)}
    command = [sys.executable, "-c", code, inputs / "run"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "NumericalWarning: predictions are computed by torch" in done.stderr
    assert "XDG_CACHE_HOME" in done.stderr
    assert "compile=False" in done.stderr


@pytest.mark.nightly
@pytest.mark.parametrize("mebibytes", [300, 676, 750, 830, 900, 1000, 1200])
def test_a_limit_of_the_address_space_ends_in_one_line(inputs, tmp_path, mebibytes):
    line = COMMANDS["fit"].line(tmp_path / "out")
    limits = f'ulimit -v {mebibytes * 1024}; ulimit -t 60; exec "$0" "$@"'
    command = ["bash", "-c", limits, sys.executable, "-m", "forcegp", *line]
    done = subprocess.run(command, cwd=inputs, capture_output=True, text=True, check=False)
    if "OpenBLAS error" not in done.stderr:  # which ends the process by itself
        assert_one_line(done.returncode, done.stderr)
    assert not leftovers(tmp_path)
