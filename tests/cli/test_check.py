"""`forcegp check`, and `forcegp import` of a dataset, from end to end: what they write, and how they refuse."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.checks.logs import arm, clean, column, late
from tests.goldens.compare import assert_unchanged, numbers_in

from forcegp import Dataset, Spring, Torques, fit, save_posterior
from forcegp.data import resample


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A clean log, one with two defects, and what is left of others."""
    place, data = tmp_path_factory.mktemp("check"), clean(1)
    data.save(place / "clean.h5")
    column(late(data, 0.02), "u", 1, np.negative).save(place / "defects.h5")
    noisy = replace(data, q=data.q + 1e-4 * np.random.default_rng(0).normal(size=data.q.shape))
    noisy.save(place / "noisy.h5")
    resample(noisy, 0.005).rows(np.delete(np.arange(1200), 600)).save(place / "lost.h5")
    (place / "arm.urdf").write_text(arm().robot.urdf_text)
    return place


def test_a_clean_log_is_told_so(forcegp, folder):
    done = forcegp("check", "clean.h5", "--robot", "arm.urdf", "--strict", folder=folder).ok()
    assert "clean.h5: 0 wrong, 0 to look at" in done.stdout
    assert "Torque of every joint; in Nm" in done.stdout
    line = next(line for line in done.stdout.splitlines() if line.strip().startswith("lift"))
    assert line.split()[2] == "%"
    assert_unchanged("cli/check", numbers_in(done.stdout), rtol=1e-2)


@pytest.mark.nightly
def test_defects_are_told_but_are_no_error(forcegp, folder):
    done = forcegp("check", "defects.h5", "--json", folder=folder).ok()
    strict = forcegp("check", "defects.h5", "--strict", folder=folder)
    assert strict.returncode == 2
    assert strict.stderr.startswith("forcegp: defects.h5: ")
    told = json.loads(done.stdout)
    assert told["level"] == "wrong"
    found = {"joints": told["joints"], "doubts": [{**each, "what": None, "do": None} for each in told["doubts"]]}
    assert_unchanged("cli/defects", found, rtol=1e-2)
    subjects = {item["about"]: item for item in told["doubts"] if item["level"] != "ok"}
    assert subjects["torque sign"]["joints"] == ["lift"]
    assert subjects["delay"]["numbers"]["delay"] == pytest.approx(0.02, abs=0.005)


def test_prepare_writes_what_it_says(forcegp, folder):
    words = ("import", "noisy.h5", "--cutoff", "auto", "--delay", "auto", "--every", 4, "--trim", 0.2)
    told = json.loads(forcegp(*words, "--out", "data.h5", "--json", folder=folder).ok().stdout)["preparation"]
    data, raw = Dataset.load(folder / "data.h5"), Dataset.load(folder / "noisy.h5")
    assert told["rows"] == [len(raw), len(data)]
    assert_unchanged("cli/preparation", {**told, "why": None}, rtol=1e-2)
    assert json.loads(json.dumps(data.metadata["preparation"])) == told
    np.testing.assert_allclose(np.diff(data.time), 4 * (raw.time[1] - raw.time[0]))
    assert 1.0 < told["cutoff"] < 20.0
    assert max(told["acceleration_noise"]["after"]) < 0.1 * min(told["acceleration_noise"]["before"])
    again = forcegp("import", "noisy.h5", "--cutoff", 12, "--out", "data.h5", folder=folder)
    again.refused("data.h5 exists already; choose another name, or add --overwrite")
    shown = forcegp("import", "noisy.h5", "--cutoff", 12, "--out", "data.h5", "--overwrite", folder=folder).ok()
    assert re.search(r"noise of a +pan \S+ -> \S+, ", shown.stdout)
    assert Dataset.load(folder / "data.h5").metadata["preparation"]["cutoff"] == 12.0


REFUSALS = {
    ("import", "noisy.h5", "--out", "x.h5"): "nothing to do: give --cutoff, --delay, --lag, --stance",
    ("import", "noisy.h5", "--cutoff", "high", "--out", "x.h5"): "--cutoff is 'high'; give a frequency in Hz",
    ("import", "noisy.h5", "--cutoff", "500", "--out", "x.h5"): "it must be > 0 and below 100 Hz",
    ("import", "noisy.h5", "--delay", "0.1,x", "--out", "x.h5"): "--delay is '0.1,x'; give seconds",
    ("import", "lost.h5", "--cutoff", "9", "--out", "x.h5"): "not sampled uniformly: the step after row 599",
    ("import", "noisy.h5", "--cutoff", "-3", "--out", "x.h5"): "cutoff is -3.0",
    ("import", "noisy.h5", "--cutoff", "1e-300", "--out", "x.h5"): "more than 1e+15 are needed",
    ("check", "arm.urdf"): "is not an HDF5 file",
}


@pytest.mark.parametrize("words", REFUSALS)
def test_what_cannot_be_done_is_refused_in_one_line(forcegp, folder, words):
    done = forcegp(*words, folder=folder)
    done.refused(REFUSALS[words])
    assert not done.stdout
    assert not (folder / "x.h5").exists()


@pytest.mark.nightly
def test_laws_of_a_saved_posterior_belong_to_the_torques_that_are_expected(forcegp, folder):
    data = clean(1)
    sprung = replace(data, u=data.u + 40.0 * data.q, truth={})
    sprung.save(folder / "sprung.h5")
    assert "0 wrong, 0 to look at" not in forcegp("check", "sprung.h5", folder=folder).stdout
    save_posterior(fit(data.model.with_forces(Spring()), sprung, Torques()), folder / "springs")
    done = forcegp("check", "sprung.h5", "--identified", "springs", "--strict", folder=folder).ok()
    assert "0 wrong, 0 to look at" in done.stdout, done.stdout
