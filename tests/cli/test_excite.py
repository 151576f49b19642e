"""`forcegp excite` from end to end, and whatever can be asked wrongly."""

import json

import numpy as np
import pytest
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import URDF, arm_data, arm_model

from forcegp import Dataset

QUICK = ("--points", 12, "--iterations", 2, "--restarts", 1, "--no-checks")
FEW = ("--seconds", 2, "--tries", 3, "--limits", "velocity=1.5,acceleration=9,9,8")


@pytest.fixture(scope="module")
def folder(forcegp, tmp_path_factory):
    place = tmp_path_factory.mktemp("excite")
    (place / "arm.urdf").write_text(URDF)
    arm_data(40, 0, arm_model(0)).save(place / "arm.h5")
    forcegp("fit", "arm.h5", "--forces", "gp:joint-friction", *QUICK, "--out", "run", folder=place).ok()
    return place


def test_the_next_motion_of_a_model_can_be_imported(forcegp, folder):
    words = ("excite", "run", *FEW, "--out", "next.csv")
    found = json.loads(forcegp(*words, "--json", folder=folder).ok().stdout)
    assert max(max(each) for each in found["usage"].values()) <= 1.0
    assert (np.array(found["spread"][1]) < found["spread"][0]).all()
    table = np.genfromtxt(folder / "next.csv", delimiter=",", skip_header=1)
    assert_unchanged("cli/excite", {**found, "table": table}, rtol=1e-2)
    names = ("--time", "t", *(x for what in "qvu" for x in (f"--{what}", f"{what}_{{joints}}")))
    words_of_import = ("import", "next.csv", *names, "--joints", "pan,lift,bend", "--robot", "arm.urdf")
    forcegp(*words_of_import, "--out", "next.h5", folder=folder).ok()
    data = Dataset.load(folder / "next.h5")
    assert len(data) >= 199
    assert np.abs(data.v).max() <= 1.5

    forcegp(*words, folder=folder).refused("add --overwrite")
    assert "spread of a" in forcegp(*words, "--overwrite", folder=folder).ok().stdout


def test_a_robot_without_a_model(forcegp, folder):
    words = ("excite", "--robot", "arm.urdf", *FEW, "--posture", "0,0.5,0.5", "--avoid", "hand:plane:0,0,1,-9")
    found = json.loads(forcegp(*words, "--out", "bare.csv", "--json", folder=folder).ok().stdout)
    assert found["spread"] is None
    assert found["condition"] > 1.0
    first, last = np.genfromtxt(folder / "bare.csv", delimiter=",", skip_header=1)[[0, -1]]
    np.testing.assert_allclose([first[1:7], last[1:7]], [[0.0, 0.5, 0.5, 0.0, 0.0, 0.0]] * 2, atol=1e-9)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "either the folder of a fitted model or --robot"),
        (("run", "--robot", "arm.urdf"), "either the folder of a fitted model or --robot"),
        (("run", "--limits", "velocity=fast"), "--limits velocity=fast: give numbers"),
        (("run", "--posture", "a,b"), "'a,b' is no list of numbers"),
        (("run", "--avoid", "hand@0,0,0.2:plane:0,0,1,0", "--clearance", "5"), "not 5, at the start"),
    ],
)
def test_what_is_refused(forcegp, folder, words, message):
    forcegp("excite", *words, "--seconds", 1, "--tries", 1, "--out", "never.csv", folder=folder).refused(message)
    assert not list(folder.glob("never*"))
