"""Whatever goes wrong ends in one line that names it, exit code 2, and no output files."""

import dataclasses
import json
import os
import signal
import sys
import warnings

import numpy as np
import pytest
from tests.cli.one_line import assert_refused
from tests.posterior.arm import URDF, arm_data

from forcegp import scores
from forcegp.cli.main import main
from forcegp.errors import usable_arguments
from forcegp.model import Model
from forcegp.posterior import load_posterior
from forcegp.robots import Robot

QUICK = ("--no-checks", "--points", "8", "--iterations", "2", "--restarts", "1")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with good data, and with every kind of bad file; the current one."""
    monkeypatch.chdir(tmp_path)
    data = arm_data(20, seed=0)
    data.save("arm.h5")
    dataclasses.replace(data, noise_std=None).save("no_noise.h5")
    content = (tmp_path / "arm.h5").read_bytes()
    (tmp_path / "damaged.h5").write_bytes(content[: len(content) // 2])
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "other.urdf").write_text(URDF.replace('"bend"', '"wrist"'))
    (tmp_path / "zero.urdf").symlink_to("/dev/zero")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    return tmp_path


WRONG = [
    ("fit missing.h5 --out run", "missing.h5 is not a file"), ("fit damaged.h5 --out run", "damaged.h5 is damaged"),
    ("fit arm.h5 --robot other.urdf --out run", "other.urdf has joints pan, lift, wrist; arm.h5 has pan, lift, bend"),
    ("fit arm.h5 --points 1 --no-checks --out run", "--points 1 must be an integer from 2 to 20, the rows"),
    ("fit arm.h5 --noise loud --out run", "--noise is 'loud'; give learned, dataset or a number"),
    ("fit arm.h5 --contact hnd:plane:0,0,1,0 --out run", "no frame 'hnd' in arm; did you mean 'hand'?"),
    ("fit arm.h5 --out mine", "mine exists"),
    ("fit arm.h5 --out mine --overwrite", "was not written by `forcegp fit`"), ("fit arm.h5", "--out"),
    ("fit arm.h5 --device cuda:999 --out run", "device 'cuda:999' cannot be used here; there is cpu"),
    ("score mine arm.h5", "mine holds no model.json"),
    ("simulate kuka-surface --out arm.h5", "arm.h5 exists already"),
    ("simulate kuka-surface --out a.h5 --seconds -1", "seconds is -1.0; it must be one number, from"),
    ("robot zero.urdf", "is not a regular file"), ("check arm.h5 --identified /dev/zero", "is not a regular file"),
    ("fit --logs-from /dev/zero --out run", "it is not a regular file"),
    ("view arm.h5 --shapes zero.urdf", "is not a regular file"),
    ("simulate quadruped --surface tilted --out a.h5", "--surface means nothing to quadruped"),
    ("simulate quadruped --joint-friction lugre --out a.h5", "lugre"), ("simulate mars --out a.h5", "'mars'"),
    ("learn arm.h5", "Available subcommands: auto, demo, simulate, "),
]  # fmt: skip


@pytest.mark.parametrize(("words", "message"), WRONG, ids=[words or "nothing" for words, _ in WRONG])
def test_a_wrong_command_is_one_line_and_exit_code_2(folder, capfd, words, message):
    assert_refused(words, message, folder, capfd)


@pytest.mark.parametrize("words", ["--debug fit missing.h5 --out run", "fit missing.h5 --out run --debug"])
def test_debug_shows_the_traceback_before_the_line(folder, capfd, words):
    assert main(words.split()) == 2
    told = capfd.readouterr().err
    assert "Traceback (most recent call last)" in told
    assert told.splitlines()[-1].startswith("forcegp: missing.h5 is not a file")


def test_overwriting_needs_a_word_and_replaces_the_whole_run(folder, capfd):
    assert main(["fit", "arm.h5", *QUICK, "--out", "run"]) == 0
    assert main(["fit", "arm.h5", *QUICK, "--out", "run"]) == 2
    assert "run exists already; choose another name, or add --overwrite" in capfd.readouterr().err
    assert main(["fit", "arm.h5", *QUICK, "--forces", "only,gp:joint", "--out", "run", "--overwrite"]) == 0
    assert load_posterior("run").carries_known_forces
    assert not list(folder.glob(".*"))


def test_another_robot_keeps_gravity_armature_and_locked_joints_of_the_recording(folder):
    recorded = Robot.from_urdf_text(URDF, gravity=(0.0, 1.0, -9.0), armature=(0.1, 0.2), locked={"bend": 0.6})
    data = arm_data(20, seed=0)
    two = {name: getattr(data, name)[:, :2] for name in "qvua"}  # any numbers will do
    dataclasses.replace(data, **two, model=Model(recorded), noise_std=np.full(2, 0.5), truth={}).save("locked.h5")
    (folder / "heavier.urdf").write_text(URDF.replace('value="0.6"', 'value="0.9"'))
    assert main(["fit", "locked.h5", "--robot", "heavier.urdf", *QUICK, "--out", "run"]) == 0
    robot = load_posterior("run").model.robot
    np.testing.assert_allclose(robot.gravity, recorded.gravity)
    np.testing.assert_allclose(robot.armature, [0.1, 0.2])
    assert robot.locked == {"bend": 0.6}
    assert 'value="0.9"' in robot.urdf_text


@pytest.mark.parametrize("words", ["fit arm.h5 --out run --json", "fit missing.h5 --out run --json"])
def test_a_program_that_calls_main_goes_on_as_it_was(folder, capfd, words):
    def handler(number, frame):
        pass

    before = signal.signal(signal.SIGTERM, handler)
    shown, target, errors = warnings.showwarning, os.fstat(1), sys.stdout.errors
    try:
        main([*words.split(), *QUICK])
        assert signal.getsignal(signal.SIGTERM) is handler
    finally:
        signal.signal(signal.SIGTERM, before)
    assert (warnings.showwarning, sys.stdout.errors) == (shown, errors)
    assert os.path.samestat(os.fstat(1), target)
    capfd.readouterr()
    os.write(1, b"after")
    assert capfd.readouterr().out == "after"


def test_what_others_print_is_not_among_the_json(forcegp, folder, monkeypatch):
    own = scores.learn

    def noisy(*given, **more):
        os.write(1, b"of a library in C")
        print("of Python")
        return own(*given, **more)

    monkeypatch.setattr("forcegp.scores.learn", noisy)
    done = forcegp("fit", "arm.h5", *QUICK, "--out", "run", "--json", folder=folder)
    assert json.loads(done.stdout)["run"] == "run"
    assert "of a library in C" in done.stderr
    assert "of Python" in done.stderr


def test_interrupts_defects_and_a_lack_of_memory_are_told_apart(folder, monkeypatch, capfd):
    for error, code, told in (
        (KeyboardInterrupt(), 130, "interrupted; no partial output was kept"),
        (MemoryError("3 GiB"), 2, "out of memory (3 GiB); use fewer points or rows"),
        (RuntimeError("can't allocate memory: 9 B"), 2, "out of memory (can't allocate memory: 9 B); use fewer points"),
        (ImportError("libx: cannot open shared object file"), 2, "a library cannot be loaded"),
        (RuntimeError("two\nlines"), 1, "an error in forcegp itself, RuntimeError: two lines (--debug shows where)"),
        (OSError(28, "No space left"), 2, "free some space, or write elsewhere"),
        (PermissionError(13, "denied"), 2, "write to a folder where you may"),
    ):

        def fails(*_, error=error, **__):
            np.square([1e300])  # about which NumPy warns
            raise error

        monkeypatch.setattr("forcegp.check", fails)
        assert main(["check", "arm.h5"]) == code
        (line,) = capfd.readouterr().err.splitlines()
        assert told in line
    with pytest.raises(MemoryError), usable_arguments("excitation"):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory")
