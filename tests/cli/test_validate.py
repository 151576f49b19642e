"""`forcegp validate` from end to end: a small arm whose truth is known."""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
from tests.cli.one_line import assert_refused
from tests.posterior.arm import URDF
from tests.validation.moving_arm import moving_arm

from forcegp import Dataset, load_posterior
from forcegp.validation import recommended

MODELS = ("given", "identified", "gp:joint-friction", "identified+gp:joint-friction")
QUICK = ("--points", 40, "--restarts", 1, "--iterations", 30, "--horizon", "0.1,0.3", "--starts", 2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("validate")
    (path / "arm.urdf").write_text(URDF)
    log = moving_arm(2.0, 2)
    log.save(path / "log.h5")
    dataclasses.replace(log, model=None, noise_std=None, metadata={"rig": "small"}).save(path / "raw.h5")
    return path


@pytest.fixture(scope="module")
def found(forcegp, folder):
    words = (
        "validate",
        "log.h5",
        "--split",
        "episodes:1",
        "--every",
        2,
        "--seeds",
        2,
        *QUICK,
        "--models",
        ",".join(MODELS),
    )
    done = forcegp(*words, "--out", "results", "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_what_is_known_of_the_arm_comes_out(found):
    """The URDF lacks friction and mass: identifying them helps, and so does a process that learns the friction."""
    models = found["models"]
    median = {name: {score: models[name][score]["median"] for score in ("nrmse", "force_rms")} for name in MODELS}
    for score in ("nrmse", "force_rms"):
        assert median["identified"][score] < median["given"][score]
        assert median["gp:joint-friction"][score] < median["given"][score]
        assert median["identified+gp:joint-friction"][score] < median["gp:joint-friction"][score]
    assert median["identified"]["force_rms"] < 0.2 * median["given"]["force_rms"]
    assert models["identified"]["motions"]["rms"][1]["median"] < 0.1 * (models["given"]["motions"]["rms"][1]["median"])
    answers = {
        answer["score"]: (answer["value"] < 0.2, answer["wins"], answer["runs"])
        for item in found["verdicts"]
        if item["question"] == "Is the identified model better than the system as given?"
        for answer in item["answers"]
    }
    assert answers["nrmse"] == answers["force_rms"] == (True, 2, 2)
    assert found["against_baseline"]["baseline"] == "identified"


def test_the_page_says_what_was_done(found, folder):
    page = (folder / "results" / "report.md").read_text()
    assert "trained on whole episodes (episode 0), tested on others (episode 1)" in page
    assert "no filter; every 2nd row." in page
    assert "the same 40 rows" in page
    assert re.search(r"^\| error of predicted motions \| \*\*[\w@:+-]+\*\* \| ", page, re.M)
    assert found["winners"]["motion"]["model"] in MODELS
    assert "the model identified from all training rows (bodies+viscous+coulomb+rotor@accelerations)" in page
    for name in MODELS:
        assert re.search(rf"^\| {re.escape(name)} \| [*\d]", page, re.M)
    assert "Does a Gaussian process on forces beat the best parametric model?\n  * **" in page
    stored = json.loads((folder / "results" / "results.json").read_text())
    assert {name: stored[name] for name in found if name != "out"} == {k: v for k, v in found.items() if k != "out"}
    assert len(stored["source"]["sha256"]) == 64
    assert stored["configuration"]["points"] == 40
    assert (
        len(list((folder / "results" / "jobs").glob("*/job.json"))) == 1 + len(MODELS) + 1
    )  # one seed of what uses all rows
    for name in ("errors", "calibration", "motions"):
        assert f"({name}.png)" in page
        assert (folder / "results" / f"{name}.png").stat().st_size > 5000


def test_the_recommended_model_is_written_from_all_rows(found, folder):
    model = load_posterior(folder / "results" / "model")
    assert recommended(found) in MODELS
    assert recommended({"winners": {"nrmse": {"model": "a"}, "motion": {"model": "b"}}}) == "b"
    assert recommended({"winners": {}}) is None
    rows = Dataset.load(folder / "log.h5")
    error = np.abs(rows.a - model.predict(rows.q, rows.v, rows.u).mean.numpy()).mean()
    assert error < 0.3 * np.abs(rows.a).mean()


def test_the_same_command_goes_on_and_another_is_refused(forcegp, found, folder):
    words = ("validate", "log.h5", "--split", "episodes:1", "--every", 2, *QUICK, "--out", "results")
    (lost,) = (folder / "results" / "jobs").glob("*seed1-given")
    shutil.rmtree(lost)
    done = forcegp(*words, "--seeds", 2, "--models", ",".join(MODELS), "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    for name in MODELS:
        for score in ("nrmse", "force_rms", "nlpd", "motions"):
            assert told["models"][name][score] == found["models"][name][score]
    other = (39 if word == 40 else word for word in words)
    done = forcegp(*other, "--seeds", 2, "--models", ",".join(MODELS), folder=folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert "holds results with another points" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_raw_log_is_filtered_and_cut_into_blocks_with_a_guard(forcegp, folder):
    words = ["validate", "raw.h5", "--robot", "arm.urdf", "--out", "raw", "--seeds", 1, *QUICK]
    words += ["--cutoff", 15, "--trim", 0.1, "--every", 2, "--split", "blocks:4:2", "--guard", 0.05]
    done = forcegp(*words, "--models", "given,identifed", folder=folder)
    assert done.returncode == 2
    assert "did you mean 'identified'" in done.stderr
    done = forcegp(*words, "--models", "given,payload:hand", folder=folder)
    assert done.returncode == 0, done.stderr
    assert re.search(r"given\s+\d+\.\d+", done.stdout)
    page = (folder / "raw" / "report.md").read_text()
    assert "zero-phase Butterworth low-pass of order 4 at 15 Hz on q and u, v and a from it by central" in page
    assert "every episode cut into 4 consecutive blocks of equal duration, block 2 held out" in page
    assert "within 0.05 s of them left out" in page
    assert "The filter took" in page
    stored = json.loads((folder / "raw" / "results.json").read_text())
    assert stored["models"]["given"]["motions"]["dt"] == pytest.approx(0.01), "at the full rate"
    assert stored["splits"][0]["guard"] == 0.05


OUT = "--out never"
WRONG = [
    (f"validate missing.h5 {OUT}", "missing.h5 is not a file"),
    (f"validate raw.h5 {OUT}", "does not carry its robot; add --robot"),
    (f"validate log.h5 {OUT} --split thirds", "the split is 'thirds'"),
    (f"validate log.h5 {OUT} --split episodes:9", "no episode or log is called so"),
    (f"validate log.h5 {OUT} --split blocks:5:9", "name some of 1 to 5"),
    (f"validate log.h5 {OUT} --every 0", "--every 0 must be an integer of at least 1"),
    (f"validate log.h5 {OUT} --split blocks:5:3 --guard -1", "guard is -1"),
    (f"validate log.h5 {OUT} --points 500", "two thirds"),
    (f"validate log.h5 {OUT} --seeds 0", "number of seeds is 0"),
    (f"validate log.h5 {OUT} --horizon soon", "'soon' is no list of numbers"),
    (f"validate log.h5 {OUT} --horizon 0", "horizons are [0.0]"),
    (f"validate log.h5 {OUT} --models given,given", "named twice"),
    (f"validate log.h5 {OUT} --models identifed", "did you mean 'identified'"),
    (f"validate log.h5 {OUT} --identification magic", "no force 'magic'"),
    (f"validate log.h5 {OUT} --cutoff 80", "cutoff is 80.0 Hz"),
    ("validate log.h5 --out log.h5", "log.h5 would be written over log.h5"),
]


@pytest.mark.parametrize(("words", "message"), WRONG, ids=[words for words, _ in WRONG])
def test_a_wrong_command_is_one_line_and_exit_code_2(folder, monkeypatch, capfd, words, message):
    monkeypatch.chdir(folder)
    assert_refused(words, message, folder, capfd)
