"""`forcegp fit --measured-torque`: stored with the model, refused where it means nothing."""

import pytest
from tests.models.arm import arm_data

from forcegp.models import load_posterior

FIT = ("fit", "arm.h5", "--points", 20, "--iterations", 3, "--restarts", 1, "--measured-torque")


@pytest.fixture
def folder(tmp_path):
    arm_data(30, seed=0).save(tmp_path / "arm.h5")
    return tmp_path


def test_it_is_stored_with_the_model(forcegp, folder):
    done = forcegp(*FIT, "--force-noise", 0.3, "--out", "run", folder=folder)
    assert done.returncode == 0, done.stderr
    noise = load_posterior(folder / "run").model.noise
    assert (noise.measured_torque, noise.force) == (True, 0.3)
    assert forcegp("evaluate", "run", "arm.h5", folder=folder).returncode == 0


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ((), "--measured-torque needs the noise of the torque sensors; add --force-noise SIGMA."),
        (("--model", "independent-gp"), "--measured-torque means nothing to --model independent-gp"),
    ],
    ids=["no force noise", "no mass matrix"],
)
def test_it_is_refused_where_it_means_nothing(forcegp, folder, more, said):
    done = forcegp(*FIT, *more, "--out", "run", folder=folder)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert said in done.stderr
    assert not (folder / "run").exists()
