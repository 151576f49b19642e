"""`--motions` of `forcegp fit` and `forcegp identify`: what is refined, written and printed, and what is refused."""

import json

import pytest
from tests.models.test_motion_fit import line, recording

from forcegp import load_posterior


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """log.h5: a cart of 5 kg with friction of 3 Ns/m and 4 N; its system has the laws at 1 and 1."""
    place = tmp_path_factory.mktemp("motions")
    recording(line, 1, seconds=6.0).save(place / "log.h5")
    return place


def test_a_fit_refined_on_motions(forcegp, folder):
    done = forcegp(
        *("fit", "log.h5", "--prior", "joint-friction", "--points", 40, "--restarts", 1, "--motions", 0.5),
        *("--out", "run"),
        folder=folder,
    )
    assert done.returncode == 0, done.stderr
    assert "refined on motions" in done.stdout
    assert "11 windows of 0.5 s" in done.stdout
    posterior = load_posterior(folder / "run")
    found = posterior.settings["motions"]
    assert found["seconds"] == 0.5
    assert set(found["parameters"]) == {"viscous.x", "coulomb.x", "velocity_scale.x"}
    assert posterior.target is not None
    rolled = forcegp("rollout", "run", "log.h5", "--seconds", 0.5, "--starts", 3, "--out", "rolled", folder=folder)
    assert rolled.returncode == 0, rolled.stderr


def test_an_identification_refined_on_motions(forcegp, folder):
    done = forcegp(
        *("identify", "log.h5", "--model", "consistent", "--rotors", "none", "--motions", 0.5, "--out", "found"),
        folder=folder,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads((folder / "found" / "identification.json").read_text())["motions"]
    assert told["parameters"]["coulomb.x"] == pytest.approx(4.0, rel=0.05)
    forces = json.loads((folder / "found" / "system.json").read_text())["known_forces"]
    dry = next(force for force in forces if force["type"] == "coulomb-joint-friction")
    assert dry["coefficients"] == [told["parameters"]["coulomb.x"]]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fit", "log.h5", "--motions", 0, "--points", 20), "--motions is 0; give the length"),
        (("fit", "log.h5", "--motions", 99, "--points", 20), "no stretch of 99 s has equal steps"),
        (("fit", "log.h5", "--model", "independent-gp", "--motions", 1), "--motions means nothing to"),
        (("identify", "log.h5", "--model", "least-squares", "--motions", 1), "use --model consistent"),
        (("identify", "log.h5", "--model", "analytical", "--motions", 1), "use forcegp fit --motions"),
    ],
)
def test_what_motions_cannot_refine(forcegp, folder, words, message):
    done = forcegp(*words, "--out", "nothing", folder=folder)
    assert done.returncode == 2
    assert message in " ".join(done.stderr.split())
    assert not (folder / "nothing").exists()
