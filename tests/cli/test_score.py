"""`forcegp score` from end to end: models of a small arm whose truth is known, fitted by it or before."""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
from tests.cli.one_line import assert_refused
from tests.data.samples import dataset
from tests.posterior.arm import URDF
from tests.scores.moving_arm import moving_arm

from forcegp import Dataset, load_posterior, score
from forcegp.data import Preparation

MODELS = ("given", "gp:joint-friction", "identified,gp:joint-friction")
FORCES = [word for name in MODELS for word in ("--forces", name)]
QUICK = ("--points", 40, "--restarts", 1, "--iterations", 8, "--horizon", "0.1,0.3", "--starts", 2)


@pytest.fixture(scope="module")
def folder(forcegp, tmp_path_factory):
    path = tmp_path_factory.mktemp("score")
    (path / "arm.urdf").write_text(URDF)
    log = moving_arm(1.5, 2)
    log.save(path / "log.h5")
    log.select_episodes([1]).save(path / "test.h5")
    log.select_episodes([0]).save(path / "train.h5")
    dataset().save(path / "other.h5")
    dataclasses.replace(log, noise_std=None, metadata={"rig": "small"}).save(path / "raw.h5")
    for name in ("friction", "joint"):
        words = ("--forces", f"gp:{name.replace('friction', 'joint-friction')}", "--points", 30, "--iterations", 5)
        forcegp("fit", "train.h5", *words, "--restarts", 1, "--out", name, folder=path).ok()
    return path


@pytest.fixture(scope="module")
def found(forcegp, folder):
    words = ("score", "joint", "log.h5", "--split", "episodes:1", "--every", 2, "--seeds", 2, *QUICK, *FORCES)
    return json.loads(forcegp(*words, "--out", "results", "--json", folder=folder).ok().stdout)


def test_what_is_known_of_the_arm_comes_out(found):
    """The URDF lacks friction and mass: identifying them helps, and so does a process that learns the friction."""
    models = found["models"]
    assert list(models) == ["identified", "joint", *(name.replace(",", "+") for name in MODELS)]
    each = {name: model["scores"] for name, model in models.items()}
    for quantity, name in (("acceleration", "nrmse"), ("force", "rmse"), ("position after 0.3 s", "rmse")):
        median = {model: each[model][quantity][name]["all"]["median"] for model in models}
        assert median["identified"] < median["given"]
        assert median["identified+gp:joint-friction"] < median["gp:joint-friction"]
    assert found["recommended"] in models
    assert found["winner"]["difference"]["runs"] == 2


def test_the_folder_holds_the_page_the_numbers_and_the_model_from_all_rows(found, folder):
    page = (folder / "results" / "report.md").read_text()
    assert "Preparation: cutoff None, every 2." in page
    assert "the same 40 rows" in page
    assert re.search(r"^\*\*[\w@:+-]+\*\*: .*error of predicted motions", page, re.M)
    for name in found["models"]:
        assert re.search(rf"^\| {re.escape(name)} \| [*\d]", page, re.M)
    stored = json.loads((folder / "results" / "results.json").read_text())
    told = {name: value for name, value in found.items() if name != "warnings"}  # in words of the command
    assert {name: stored[name] for name in told} == told
    assert stored["configuration"]["points"] == 40
    rows, model = Dataset.load(folder / "log.h5"), load_posterior(folder / "results" / "model")
    assert np.abs(rows.a - model.predict(rows.q, rows.v, rows.u).mean.numpy()).mean() < 0.5 * np.abs(rows.a).mean()


def test_the_same_command_resumes_and_another_is_refused(forcegp, found, folder):
    words = ("score", "joint", "log.h5", "--split", "episodes:1", "--every", 2, "--seeds", 2, *FORCES)
    (lost,) = (folder / "results" / "jobs").glob("*seed1-given")
    shutil.rmtree(lost)
    done = forcegp(*words, *QUICK, "--out", "results", "--json", folder=folder).ok()
    told = json.loads(done.stdout)
    for name in found["models"]:
        assert told["models"][name]["scores"] == found["models"][name]["scores"]
    done = forcegp(*words, *[39 if word == 40 else word for word in QUICK], "--out", "results", folder=folder)
    done.refused("holds results with another points")
    assert done.stdout == ""


def test_a_raw_log_is_filtered_and_cut_into_blocks_with_a_guard(forcegp, folder):
    words = ["score", "raw.h5", "--robot", "arm.urdf", "--out", "raw", "--seeds", 1, *QUICK, "--forces", "given"]
    words += ["--identification", "viscous@accelerations"]
    words += ["--cutoff", 15, "--trim", 0.1, "--every", 2, "--split", "blocks:4:2", "--guard", 0.01]
    assert re.search(r"given\s+\d+\.\d+", forcegp(*words, folder=folder).ok().stdout)
    page = (folder / "raw" / "report.md").read_text()
    assert "Preparation: cutoff 15.0, " in page
    assert "every episode cut into 4 consecutive blocks of equal duration, block 2 held out" in page
    assert "within 0.054" in page, "two time constants of the filter"
    stored = json.loads((folder / "raw" / "results.json").read_text())
    assert stored["runs"]["given"][0]["motions"]["dt"] == pytest.approx(0.01), "at the full rate"


def test_runs_alone_are_scored_on_the_whole_log(forcegp, folder):
    done = forcegp("score", "friction", "joint", "test.h5", "--horizon", ".1,.3", folder=folder).ok()
    assert re.search(r"^ *friction +\d+\.\d+ .*\n *joint +\d+\.\d+", done.stdout, re.M), done.stdout
    assert re.search(r"^take friction: .*error of predicted motions, friction / joint = ", done.stdout, re.M)
    one = forcegp("score", "friction", "test.h5", "--horizon", ".1", "--integrator", "symplectic-euler", folder=folder)
    assert re.search(r"position after 0\.1 s +– +\d\S* +", one.stdout), one.stdout
    log, learned = Dataset.load(folder / "test.h5"), load_posterior(folder / "friction")
    first, thinned = log.time < log.time[0] + 0.3, log.rows(slice(None, None, 2))
    seen, filtered = learned.update(log.rows(first)), Preparation(cutoff=9.0).apply(log)
    each = (seen, log.rows(~first)), (learned, thinned), (learned, filtered)
    for option, scored in zip(("--observe=.3", "--every=2", "--cutoff=9"), each, strict=True):
        told = forcegp("score", "friction", "test.h5", option, "--json", folder=folder)
        scores = json.loads(told.stdout)["models"]["friction"]["scores"]["acceleration"]["mae"]["each"]
        np.testing.assert_allclose(scores, score(*scored).columns("mae"), rtol=1e-6)


OUT = "--out never"
WRONG = [
    ("score missing.h5", "missing.h5 does not exist"),
    ("score friction", "friction is a folder; give a dataset (.h5) last"), ("score log.h5", "give --out FOLDER"),
    ("score friction other.h5", "joints shoulder, elbow; the model was trained on pan, lift, bend"),
    ("score friction test.h5 --horizon 7", "not predicted: 7 s; held-out stretches last"),
    ("score friction test.h5 --observe 99", "--observe is 99 s; give seconds that one record is longer than"),
    ("score friction test.h5 --gravity 0,0,9.81", "a RUN has its own robot"),
    ("score friction test.h5 --every 0", "--every 0 must be an integer of at least 1"),
    (f"score friction test.h5 {OUT} --integrator euler", "did you mean 'symplectic-euler'"),
    *((f"score friction test.h5 {OUT} --horizon={x}", "give positive numbers of seconds") for x in ("inf", "nan", 0)),
    (f"score log.h5 {OUT} --forces=gp:joint,@", "holds an empty entry; write one comma between two entries"),
    (f"score log.h5 {OUT} --split thirds", "the split is 'thirds'"), (f"score log.h5 {OUT} --points 500", "two thirds"),
    (f"score log.h5 {OUT} --horizon soon", "'soon' is no list of numbers"),
    (f"score log.h5 {OUT} --forces given --forces given", "named twice"),
    (f"score log.h5 {OUT} --forces identifed", "give given, identified or FORCES"),
    (f"score log.h5 {OUT} --identification magic", "no force 'magic'"),
    ("score log.h5 --out log.h5", "log.h5 would be written over log.h5"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "message"), WRONG, ids=[words for words, _ in WRONG])
def test_a_wrong_command_is_one_line_and_exit_code_2(folder, monkeypatch, capfd, words, message):
    monkeypatch.chdir(folder)
    assert_refused(words, message, folder, capfd)
