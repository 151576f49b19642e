"""`forcegp rollout` from end to end, and whatever can be asked wrongly."""

import dataclasses
import json
import re

import h5py
import numpy as np
import pytest
from tests.posterior.arm import arm_data

from forcegp.cli.main import main
from forcegp.data import Dataset
from forcegp.mechanics import Baumgarte
from forcegp.posterior import load_posterior

PNG = b"\x89PNG\r\n\x1a\n"
QUICK = ("--points", "8", "--iterations", "2", "--restarts", "1")


def test_rollouts_are_compared_with_the_recording_and_written(workshop, forcegp, tmp_path):
    out = tmp_path / "out"
    words = ("rollout", "run", "test.h5", "--start-rows", "0,100,200", "--seconds", 0.25, "--baumgarte", "10,1")
    done = forcegp(*words, "--samples", 3, "--seed", 1, "--out", out, "--json", folder=workshop)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary == json.loads((out / "rollout.json").read_text())
    assert (summary["rows"], summary["steps"], summary["samples"]) == ([0, 100, 200], 60, 3)
    assert summary["baumgarte"] == {"omega": 10.0, "zeta": 1.0}
    assert (out / "rollout.png").read_bytes().startswith(PNG)
    files = {"rollout.json", "rollout.h5", "rollout.png", "config.json", "SHA256SUMS"}
    assert {file.name for file in out.iterdir()} == files
    assert sorted(json.loads((out / "config.json").read_text())["files"]) == sorted(files)

    data, rows = Dataset.load(workshop / "test.h5"), [0, 100, 200]
    u = np.stack([data.u[row : row + 60] for row in rows])
    posterior = load_posterior(workshop / "run")
    expected = posterior.rollout(data.q[rows], data.v[rows], u, 1 / 240, baumgarte=Baumgarte(10.0), samples=3, seed=1)
    with h5py.File(out / "rollout.h5") as file:
        np.testing.assert_allclose(file["q"][()], expected.q, atol=1e-9)
        np.testing.assert_allclose(file["samples/q"][()], expected.samples.q, atol=1e-9)
        np.testing.assert_array_equal(file["recorded/q"][:, -1], data.q[[60, 160, 260]])
    worst = np.abs(expected.q[:, -1].numpy() - data.q[[60, 160, 260]]).max(-1)
    last = summary["moments"][-1]
    assert last["joint_error_max"] == pytest.approx(worst.max(), rel=1e-6)
    assert last["joint_error_median"] == pytest.approx(np.median(worst), rel=1e-6)
    assert last["lasting"] == 3
    assert last["constraint_max"] == pytest.approx(float(expected.constraint.abs().max()), rel=1e-6)

    again = forcegp(*words, "--out", out, folder=workshop)
    assert (again.returncode, again.stdout) == (2, "")
    assert "--overwrite" in again.stderr


def test_the_table_is_for_people(workshop, forcegp, tmp_path):
    words = ("rollout", "run", "test.h5", "--starts", 2, "--seconds", 0.1, "--integrator", "projected")
    done = forcegp(*words, "--out", tmp_path / "out", folder=workshop)
    assert done.returncode == 0, done.stderr
    told = done.stdout
    assert re.search(r"^2 motions against test.h5; joint error: the worst joint, rad\s*$", told, re.M)
    assert re.search(r"^\s*0\.1 s\s+2\s+\S+\s+\S+\s+\S+ mm\s+\S+e-\d\d mm", told, re.M), told
    assert re.search(r"diverged\s+0 of 2", told)
    assert re.search(r"initial states\s+moved onto the contacts by up to \S+ rad", told)


@pytest.fixture
def folder(tmp_path, monkeypatch, capfd):
    """A model of the arm, and recordings with two episodes, with a gap, backwards and of another robot."""
    monkeypatch.chdir(tmp_path)
    data = arm_data(20, seed=0)
    data.save("arm.h5")
    dataclasses.replace(data, episode=np.repeat([0, 1], 10)).save("two.h5")
    dataclasses.replace(data, time=np.delete(np.arange(21) * 0.01, 7)).save("gap.h5")
    data.rows(np.arange(20)[::-1]).save("backwards.h5")
    dataclasses.replace(data, model=None, joint_names=("a", "b", "c")).save("other.h5")
    assert main(["fit", "arm.h5", *QUICK, "--out", "run"]) == 0
    capfd.readouterr()
    return tmp_path


WRONG = [
    ("rollout run arm.h5 --start-rows 15 --seconds 0.1", "only 0.04 s are left from row 15 to the end of its episode"),
    ("rollout run two.h5 --start-rows 5 --seconds 0.05", "start at row 4 or before"),
    ("rollout run two.h5 --seconds 0.15", "no episode lasts 0.15 s: the longest has 0.09 s"),
    ("rollout run arm.h5 --start-rows 20 --seconds 0.05", "row 20 does not exist; the dataset has rows 0 to 19"),
    ("rollout run arm.h5 --start-rows -1 --seconds 0.05", "row -1 does not exist"),
    ("rollout run arm.h5 --start-rows first --seconds 0.05", "'first' is no list of whole numbers"),
    ("rollout run arm.h5 --start-rows 1 --starts 2 --seconds 0.05", "--start-rows and --starts were both given"),
    ("rollout run arm.h5 --starts 0 --seconds 0.05", "the number of starts is 0"),
    ("rollout run arm.h5 --starts 1 --seconds 0", "at least one step of the recording, 0.01 s"),
    ("rollout run arm.h5 --starts 1 --seconds nan", "the length is nan s"),
    ("rollout run gap.h5 --start-rows 5 --seconds 0.05", "the time steps are uneven: 0.02 s after row 6"),
    ("rollout run backwards.h5 --starts 1 --seconds 0.05", "not in the order of time"),
    ("rollout run other.h5 --starts 1 --seconds 0.05", "joints a, b, c; the model was trained on pan, lift, bend"),
    (
        "rollout run arm.h5 --starts 1 --seconds 0.05 --integrator euler",
        "did you mean 'symplectic-euler'",
    ),
    ("rollout run arm.h5 --starts 1 --seconds 0.05 --baumgarte strong", "--baumgarte is 'strong'; give none, OMEGA"),
    ("rollout run arm.h5 --starts 1 --seconds 0.05 --baumgarte 1,2,3", "--baumgarte is '1,2,3'"),
    ("rollout run arm.h5 --starts 1 --seconds 0.05 --baumgarte -1", "Baumgarte omega is -1.0"),
    ("rollout run arm.h5 --starts 1 --seconds 0.05 --samples -1", "--samples=-1 must be an integer of at least 0"),
    ("rollout missing arm.h5", "missing does not exist"),
    ("rollout run missing.h5", "missing.h5 is not a file"),
]


def test_whatever_is_wrong_is_one_line_and_exit_code_2(folder, capfd):
    before = sorted(folder.rglob("*"))
    for wrong, message in WRONG:
        assert main([*wrong.split(), "--out", "out"]) == 2, wrong
        told = capfd.readouterr()
        assert told.out == "", wrong
        assert told.err.startswith("forcegp: "), told.err
        assert told.err.count("\n") == 1, told.err
        assert message in told.err, told.err
        assert sorted(folder.rglob("*")) == before, wrong


@pytest.mark.parametrize(("starts", "lasting"), [("0,6", 1), ("0,1", 0)])
def test_a_model_that_diverges_is_still_drawn_and_said(folder, forcegp, starts, lasting):
    data = Dataset.load("arm.h5")
    u = np.array(data.u)
    u[:3] += 5000.0  # Nm: more than 100 rad/s within a step or two
    dataclasses.replace(data, u=u).save("fast.h5")
    words = ("rollout", "run", "fast.h5", "--start-rows", starts, "--seconds", 0.05, "--samples", 2, "--out", "out")
    done = forcegp(*words, folder=folder)
    assert done.returncode == 0, done.stderr
    assert f"warning: {2 - lasting} of 2 rollouts diverged, the first at step" in done.stderr
    assert done.stderr.count("arning") == 2, done.stderr  # of the means and of the samples, and none of numpy's
    assert re.search(rf"diverged\s+{2 - lasting} of 2", done.stdout)
    summary = json.loads((folder / "out" / "rollout.json").read_text())
    assert summary["diverged_at"][0] >= 1
    assert summary["moments"][-1]["lasting"] == lasting
    assert (folder / "out" / "rollout.png").read_bytes().startswith(PNG)
