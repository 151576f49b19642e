"""What random inputs found, by name: each ended in an error in forcegp itself, or in one that was not forcegp's."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from tests.cli.test_import import FLAGS
from tests.durability.commands import FEW
from tests.fuzz.arguments import CALLS
from tests.fuzz.datasets import OTHERS
from tests.fuzz.made import INPUTS, PAIR
from tests.fuzz.oracle import require_ended_well
from tests.fuzz.stored import CHANGES, TENSORS
from tests.posterior.arm import URDF

import forcegp
import forcegp.inference
from forcegp.atomic_files import write_digests
from forcegp.errors import FileFormatError, ForceGPError, RobotModelError
from forcegp.model import Model

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.fixture
def place(tmp_path):
    """A folder so deep that `require_ended_well` may look above it."""
    folder = tmp_path / "some" / "folders" / "deep"
    folder.mkdir(parents=True)
    return folder


# ---------------------------------------------------------------- files


@pytest.mark.parametrize("encoding", ["punycode", ""])
def test_encodings_that_are_no_text_are_refused(tmp_path, encoding):
    text = f'<?xml version="1.0" encoding="{encoding}"?><robot name="\xe4\xff"><link name="a"/></robot>'
    (tmp_path / "arm.urdf").write_bytes(text.encode("latin-1"))
    with pytest.raises(RobotModelError, match="save the robot file as UTF-8"):
        forcegp.Robot.from_urdf(tmp_path / "arm.urdf")


def test_a_joint_beyond_the_moon_is_refused():
    with pytest.raises(RobotModelError, match=r"xyz \[1e\+200, 0.0, 0.0\]"):
        forcegp.Robot.from_urdf_text(URDF.replace('xyz="0 0 0.25"', 'xyz="1e200 0 0"'))


@pytest.mark.parametrize("where", ["header", "row"])
def test_fields_of_more_letters_than_csv_reads_are_refused_in_one_line(place, where):
    long = "1" * 140_000
    header, row = ("time,q_a,u_a" + f",{long}" * (where == "header")), "0,0," + ("0" if where == "header" else long)
    (place / "log.csv").write_text(f"{header}\n{row}\n0.1,0,0\n")
    words = ["import", "log.csv", "--time", "time", "--q", "q_a,q_a", "--u", "u_a,u_a", "--robot", "pair.urdf"]
    words += ["--out", "o.h5"]
    (place / "pair.urdf").write_text(PAIR)
    assert require_ended_well(words, place) == 2


CASES = [*zip(("fit", *("check", "import") * len(OTHERS)), OTHERS, strict=False)]


@pytest.mark.parametrize(("command", "stated"), CASES, ids=json.dumps)
def test_metadata_of_another_kind_do_not_matter(place, stated, command):
    INPUTS.free.save(place / "data.h5")
    with h5py.File(place / "data.h5", "r+") as file:
        del file["metadata"]
        file["metadata"] = np.bytes_(json.dumps(stated))
    more = {"check": "", "import": "--cutoff 20 --out o.h5", "fit": f"{FEW} --no-checks --out o"}
    assert require_ended_well([command, "data.h5", *more[command].split()], place) == 0


@pytest.mark.parametrize(
    "words", ["check bad\udcff.h5", "fit train.h5 --out bad\udcff", "import bad\udcff.csv --out o.h5"]
)
def test_names_that_are_no_text_are_refused_in_one_line(place, words):
    (place / "train.h5").write_bytes((INPUTS.folder / "train.h5").read_bytes())
    for name in ("bad\udcff.h5", "bad\udcff.csv"):
        (place / name).write_bytes(b"x")
    assert require_ended_well([*words.split(), *FLAGS * words.startswith("import")], place) == 2


@pytest.fixture
def run(tmp_path):
    return Path(shutil.copytree(INPUTS.folder / "structured", tmp_path / "run"))


def assert_refused(run, message):
    write_digests(run)
    with pytest.raises(FileFormatError, match=message):
        forcegp.load_posterior(run)


@pytest.mark.parametrize(
    "content",
    ["[" * 100_000, '{"kind": ' + "9" * 5000 + "}", '{"kind": []}', '{"kind": {}}', '{"kind": "structured-gp"}'],
    ids=["deep", "digits", "list", "object", "no version"],
)
def test_documents_of_any_shape_are_refused(run, content):
    (run / "model.json").write_text(content)
    assert_refused(run, r"model\.json")


@pytest.mark.parametrize("text", ["[" * 100_000, '{"urdf": ' + "9" * 5000 + "}"], ids=["deep", "digits"])
def test_systems_of_any_shape_are_refused(text):
    with pytest.raises(FileFormatError, match="stored model"):
        Model.from_json(text)


@pytest.mark.parametrize(
    "stated",
    [{"data": {"episodes": value}} for value in (5, [[]], ["x"], {"a": 1}, None)]
    + [{"widening": value} for value in ("x", -1.0, float("nan"), None)]
    + [{"rows_added": "x"}, {"correlated_rows": "2"}, {"air": {"wind": [0.0] * 3}}]
    + [{"motion_intervals": {"horizons": [1.0], "rms": [[[1.0]] * 2], "factors": [[[[1.0]] * 2]] * 2}}],
    ids=str,
)
def test_settings_of_another_kind_are_refused(run, stated):
    document = json.loads((run / "model.json").read_text())
    document["settings"] |= stated
    (run / "model.json").write_text(json.dumps(document))
    assert_refused(run, r"model\.json")


TENSORS_OF = ("training.q", "training.v", "parameters.noise.log_force")
CHANGED = [(name, how) for name in TENSORS_OF for how in ("longer", "float32", "nan")]
CHANGED += [("training.v", "fewer rows"), ("training.u", "huge")]


@pytest.mark.parametrize(("name", "how"), CHANGED)
def test_tensors_of_other_shapes_and_kinds_are_refused(run, name, how):
    tensors = load_file(run / TENSORS)
    save_file(tensors | {name: CHANGES[how](tensors[name]).contiguous()}, run / TENSORS)
    assert_refused(run, "fit the model again")


# ---------------------------------------------------------------- arguments

WRONG = {
    "curve": {"latent": 1}, "components": {"covariance": np.array(["a", "b"])},
    "predict": {"q": torch.ones(3, device="meta")}, "predict ": {"q": torch.ones(2, 3).to_sparse()},
    "predictor": {"covariance": 0.1}, "predictor()": {"q": "abc"}, "rollout": {"baumgarte": 3},
    "Dataset": {"truth": 5}, "Dataset ": {"model": ()},
    "Dataset.rows": {"index": torch.ones(3, requires_grad=True)}, "Dataset.load": {"path": 7},
    "load_posterior": {"path": 7}, "Robot.from_urdf": {"path": "a\0b"}, "Robot.from_urdf_text": {"text": None},
    "Robot.from_urdf_text ": {"inertias": np.ones((3, 3))}, "normalized": {"q": torch.zeros(7).double()},
    "Model.from_file": {"path": 7}, "Thrusters": {"names": ("one", 2)},
    "Plane": {"normal": torch.tensor([0.0, 0.0, 1.0]).to_sparse()},
    "with_armature": {"armature": torch.ones(2, 3).to_sparse()}, "Model": {"contacts": torch.tensor(1.0)},
    "fit": {"options": "fast"}, "fit ": {"start": ["a"]}, "fit  ": {"engine": np.zeros(3, [("a", "f8")])},
    "Noise": {"acceleration": torch.ones(3, device="meta")}, "fit (laws)": {"rows": 1.5}, "Torques": {"mean": "x"},
    "Motions": {"seconds": "x"}, "IndependentAccelerations": {"inputs": np.zeros(3, [("a", "f8")])},
    "ContactFriction": {"load": np.ones(3)}, "ToolForces": {"inputs": np.ones(3)}, "Baumgarte": {"omega": 1e308},
    "Payload": {"mass": np.ones(3)}, "parse_forces": {"expression": 5},
    "Preparation": {"trim": 10**30, "delay": 10**30}, "split_named": {"guard": {}}, "ColumnMapping": {"unit": 5},
    "ColumnMapping ": {"q": torch.zeros(3).to_sparse()}, "ColumnMapping  ": {"step": torch.ones(()).to_sparse()},
    "score": {"starts": []}, "ImportOptions": {"gap": "x"}, "KukaSurfaceConfig": {"tool_mass": None},
    "JointFriction": {"joints": torch.tensor(5.0)}, "rollout ": {"dt": ""}, "MPPI": {"integrator": torch.zeros(4)},
}  # fmt: skip


@pytest.mark.parametrize("call", WRONG)
def test_values_of_another_kind_are_refused_in_one_sentence(call):
    function, arguments = CALLS[call.strip()]
    with pytest.raises(ForceGPError) as refused:
        function(**{**arguments(), **WRONG[call]})
    assert str(refused.value).strip()
