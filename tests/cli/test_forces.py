"""Forces by themselves and other systems, on the command line: files of a small arm."""

import dataclasses
import json

import pytest
from tests.posterior.arm import URDF, arm_model
from tests.scores.friction import friction_data

from forcegp import Dataset, load_posterior, score
from forcegp.mechanics import Contact, Plane
from forcegp.robots import Robot

PNG = b"\x89PNG\r\n\x1a\n"
QUICK = ("--points", "30", "--iterations", "25", "--restarts", "1")


def other_system():
    """The same arm with a heavier hand, on a lower, level plane."""
    robot = Robot.from_urdf_text(URDF.replace('mass value="0.6"', 'mass value="1.2"'))
    return arm_model().with_robot(robot).with_contacts([Contact("hand", (0.0, 0.0, 0.2), Plane((0.0, 0.0, 1.0), 0.3))])


@pytest.fixture(scope="module")
def arm(forcegp, tmp_path_factory):
    """A folder with train.h5, test.h5, other.h5 (another robot and plane) and the model `run` with joint friction."""
    folder = tmp_path_factory.mktemp("arm")
    friction_data(60, seed=0).save(folder / "train.h5")
    friction_data(50, seed=1).save(folder / "test.h5")
    other = friction_data(50, seed=2, model=other_system())
    # friction_data knows the tool's friction on its own plane only
    dataclasses.replace(other, truth={"a": other.truth["a"], "lambda": other.truth["lambda"]}).save(folder / "other.h5")
    words = ("--forces", "gp:joint-friction,gp:contact-friction:kernel=linear", *QUICK)
    fitted = forcegp("fit", "train.h5", *words, "--out", "run", folder=folder)
    assert fitted.returncode == 0, fitted.stderr
    return folder


def of(done) -> dict:
    """Quantity -> score -> median over all joints, of the one model."""
    (model,) = json.loads(done.stdout)["models"].values()
    return {
        quantity: {name: each["all"] and each["all"]["median"] for name, each in scores.items()}
        for quantity, scores in model["scores"].items()
    }


def test_another_contact_is_named_with_the_remedy_and_the_remedy_helps(arm, forcegp):
    default = forcegp("score", "run", "other.h5", "--json", folder=arm)
    assert default.returncode == 0, default.stderr
    (warning,) = [each for each in json.loads(default.stdout)["warnings"] if "not those of the data" in each]
    assert warning.startswith("the contacts of the model are not those of the data")
    assert "`posterior.with_model(dataset.model)`" in warning
    assert [line for line in default.stderr.splitlines() if "those of the data" in line] == [f"warning: {warning}"]
    data, before = Dataset.load(arm / "other.h5"), of(default)
    scores = score(load_posterior(arm / "run").with_model(data.model), data)
    assert not any("not those of the data" in each for each in scores.warnings)
    assert scores.value("mae", "true acceleration") < 0.2 * before["true acceleration"]["mae"]
    assert scores.value("mae", "constraint") < 1e-9 < before["constraint"]["mae"]
