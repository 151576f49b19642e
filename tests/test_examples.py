"""The scripts in examples/: short, listed in their README, and each runs and finds what it is about.

tests/test_pages.py runs the two swing-ups, and benchmarks/payload.py the log of the UR5.
"""

import re
from pathlib import Path

import pytest
from tests.examples import run_example

FOLDER = Path(__file__).resolve().parents[1] / "examples"
GENERATORS = {"ur5_log.py"}  # longer: nobody reads a generator of data to learn from it


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return lambda name: run_example((FOLDER / name).read_text(encoding="utf-8"), tmp_path)


def test_scripts_are_short():
    lengths = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in FOLDER.glob("*.py")}
    assert {name for name, lines in lengths.items() if lines >= 40} == GENERATORS


def test_all_are_listed():
    listed = set(re.findall(r"`(\w+\.py)`", (FOLDER / "README.md").read_text(encoding="utf-8")))
    assert listed == {path.name for path in FOLDER.glob("*.py")}


@pytest.mark.nightly
def test_a_first_model(run, tmp_path):
    urdf, learned = (float(error) for error in re.findall(r"error (\S+)", run("first_model.py")))
    assert learned < 0.05 * urdf
    assert (tmp_path / "friction.png").stat().st_size > 10_000


def test_the_check_of_a_log(run):
    assert run("check_log.py").startswith("torque sign: the torque of elbow has the opposite sign")


def test_a_payload(run):
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'forcegp[mujoco]'")
    printed = run("payload.py")
    mass, margin, x, _, z = (float(x) for x in re.findall(r"-?\d+\.?\d*", printed))
    assert abs(mass - 0.7) <= margin
    assert (x, z) == (pytest.approx(20.0, abs=3.0), pytest.approx(50.0, abs=3.0))


@pytest.mark.nightly
def test_computed_torque(run):
    urdf, learned = (float(error) for error in re.findall(r": (\S+) mrad", run("computed_torque.py")))
    assert learned < 0.05 * urdf


def test_a_prior_of_ones_own(run):
    named, own = (float(error) for error in re.findall(r"error (\S+)", run("custom_prior.py")))
    assert own < 0.1 * named
