"""A fitted model on disk: what comes back predicts the same, and damage is named."""

import json
import os
import random
from functools import reduce
from operator import getitem

import pytest
import torch
from tests.posterior.arm import URDF, arm_data, arm_model

from forcegp.atomic_files import SUMS, require_unchanged, write_digests
from forcegp.errors import ContactError, FileFormatError
from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions
from forcegp.mechanics import Baumgarte, Contact, ImplicitSurface, Sphere
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior import load_posterior, save_posterior
from forcegp.robots import Robot

FILES = {"model.json", "tensors.safetensors", "robot.urdf", "SHA256SUMS"}
OPTIONS = OptimizerOptions(iterations=3)


@pytest.fixture(scope="module")
def data():
    return arm_data(20, seed=5)


@pytest.fixture(scope="module")
def posterior(data):
    model = data.model.with_forces(JointForces(), noise=Noise((0.05, 0.06, 0.07), 0.02, learn=True)).without_mean()
    return fit(model, data, points=15, restarts=1, options=OPTIONS)


@pytest.fixture
def run(posterior, tmp_path):
    save_posterior(posterior, tmp_path / "run")
    return tmp_path / "run"


def assert_same(mine, theirs):
    for name in ("multiplier", "contact_force", "unknown_force", "measurement"):
        assert torch.equal(getattr(mine, name).mean, getattr(theirs, name).mean), name
        assert torch.equal(getattr(mine, name).covariance, getattr(theirs, name).covariance), name


def test_what_comes_back_is_the_same(posterior, run, data):
    loaded = load_posterior(run)
    states = data.q, data.v, data.u
    mine, theirs = posterior.predict(*states), loaded.predict(*states)
    assert_same(mine, theirs)
    assert loaded.result.history == posterior.result.history
    assert json.loads(json.dumps(posterior.settings)) == loaded.settings
    assert loaded.model.carries_known_forces
    assert loaded.model.noise == posterior.model.noise


def test_nothing_is_overwritten_unasked(posterior, run):
    with pytest.raises(FileFormatError, match="exists already"):
        save_posterior(posterior, run)
    save_posterior(posterior, run, overwrite=True)
    (run / "model.json").unlink()
    with pytest.raises(FileFormatError, match="was not written by forcegp"):
        save_posterior(posterior, run, overwrite=True)


@pytest.mark.parametrize("name", sorted(FILES))
def test_a_flipped_bit_in_any_file_is_noticed(run, name):
    content, generator = (run / name).read_bytes(), random.Random(name)
    for _ in range(12):
        place, bit = generator.randrange(len(content)), 1 << generator.randrange(8)
        (run / name).write_bytes(content[:place] + bytes([content[place] ^ bit]) + content[place + 1 :])
        with pytest.raises(FileFormatError):
            load_posterior(run)
    (run / name).write_bytes(content)
    load_posterior(run)


@pytest.mark.parametrize(
    "line", [None, "", "0" * 64 + "  ../run/model.json\n", "0" * 64 + "  /dev/zero\n", "0" * 64 + "  pipe\n", "\udcff"]
)
def test_digests_that_lead_elsewhere_are_refused_without_reading(run, line):
    os.mkfifo(run / "pipe")
    (run / SUMS).unlink()
    if line is not None:
        (run / SUMS).write_bytes(line.encode("utf-8", "surrogateescape"))
    with pytest.raises(FileFormatError, match=r"SHA256SUMS"):
        load_posterior(run)


@pytest.mark.parametrize("what", ["write", "rename"])
def test_the_old_model_can_be_loaded_after_an_overwrite_that_failed(posterior, carried, run, monkeypatch, what):
    before = {file.name: file.read_bytes() for file in run.iterdir()}

    def fail(*_):
        monkeypatch.undo()
        raise OSError("disk full")

    monkeypatch.setattr(
        {"write": "forcegp.posterior.storage.save", "rename": "forcegp.atomic_files._swapped"}[what], fail
    )
    with pytest.raises(OSError, match="disk full"):
        save_posterior(carried, run, overwrite=True)
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before
    assert load_posterior(run).target is None
    assert [path.name for path in run.parent.iterdir()] == ["run"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "diary"}, "not a stored forcegp"), ({"format_version": 99}, "format version 99"),
        ({"format_version": 7}, "format version 7, .* reads 1; use the version that wrote it .* or fit again"),
        ({"model": {}}, "incomplete or damaged"), ({"settings": 5}, "incomplete or damaged"),
        ({"settings": {"points": "many"}}, "points is many"),
        ({"result": {"value": "abc"}}, "incomplete or damaged"),
        ({"model/gravity": [0.0, 0.0, 1e300]}, "gravity 2 is 1e\\+300, more than 1e\\+09 in SI units"),
        ({"model/gravity": [0.0, 0.0, 2000.0]}, "gravity is .*; give m/s"),
        ({"model/forces/0/gain": 1e300}, "forces 0 gain is 1e"),
        ({"model/noise/acceleration": [1e300] * 3}, "noise acceleration 0 is 1e"),
    ],
)  # fmt: skip
def test_a_changed_document_is_refused(run, change, message):
    document = json.loads((run / "model.json").read_text())
    for path, value in change.items():
        *holders, last = (int(key) if key.isdigit() else key for key in path.split("/"))
        reduce(getitem, holders, document)[last] = value
    (run / "model.json").write_text(json.dumps(document))
    write_digests(run)
    with pytest.raises(FileFormatError, match=message):
        load_posterior(run)


def test_not_a_folder(tmp_path):
    with pytest.raises(FileFormatError, match="does not exist"):
        load_posterior(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(FileFormatError, match="is a file"):
        load_posterior(tmp_path / "file")
    with pytest.raises(FileFormatError, match=r"holds no model\.json"):
        load_posterior(tmp_path)


def test_a_surface_that_is_code_cannot_be_stored(tmp_path):
    surface = ImplicitSurface(lambda p: p[2] + 0.2 * p[0] - 0.4)
    model = arm_model().with_contacts((Contact("hand", (0.0, 0.0, 0.2), surface),))
    fitted = fit(model.with_forces(JointForces()), arm_data(12, 6, model), restarts=1, options=OPTIONS)
    with pytest.raises(ContactError, match="never code"):
        save_posterior(fitted, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def carried(data):
    """A model with an analytical mean, carried to a sphere, a heavier tool and another stabilisation."""
    fitted = fit(data.model.with_forces(JointForces()), data, points=12, restarts=1, options=OPTIONS)
    robot = Robot.from_urdf_text(URDF.replace('mass value="0.6"', 'mass value="0.9"'), gravity=(0.0, 0.0, -9.0))
    contact = Contact("hand", (0.0, 0.01, 0.2), Sphere((0.0, 0.0, 0.1), 0.6))
    return fitted.with_model(Model(robot, (contact,), data.model.forces, baumgarte=Baumgarte(3.0)))


def test_a_model_that_was_carried_to_another_system_predicts_there_after_loading(carried, data, tmp_path):
    save_posterior(carried, tmp_path / "run")
    assert {path.name for path in (tmp_path / "run").iterdir()} == FILES | {"target.urdf"}
    loaded = load_posterior(tmp_path / "run")
    states = data.q, data.v, data.u
    assert_same(carried.predict(*states), loaded.predict(*states))
    there = carried.conditioned(
        carried.trained, carried.training, carried.hyperparameters, carried.result, carried.settings
    )
    assert (there.predict(*states).mean - loaded.predict(*states).mean).abs().max() > 0.1  # not the old system
    assert (loaded.model.to_dict(), loaded.trained.to_dict()) == (carried.model.to_dict(), carried.trained.to_dict())
    again = tmp_path / "again"
    save_posterior(loaded, again)
    assert torch.equal(load_posterior(again).predict(*states).mean, loaded.predict(*states).mean)


def test_pipes_and_files_too_large_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "model.json")
    with pytest.raises(FileFormatError, match=r"holds no model\.json"):
        load_posterior(tmp_path)
    os.mkfifo(tmp_path / SUMS)
    with pytest.raises(FileFormatError, match=f"{SUMS} is not a regular file; fit again"):
        require_unchanged(tmp_path, "fit again")
    for name in (SUMS, "model.json"):  # which a sparse file costs nothing to claim
        (tmp_path / name).unlink()
        with (tmp_path / name).open("wb") as file:
            file.truncate(2**40)
        with pytest.raises(FileFormatError, match=f"{name} holds 1048576 MiB, more than the 32 MiB"):
            require_unchanged(tmp_path, "fit again") if name == SUMS else load_posterior(tmp_path)
