from pathlib import Path

import h5py
import numpy as np
import pytest
from tests.data.samples import assert_equal, complete, dataset, model

from forcegp.data import Dataset, is_dataset
from forcegp.errors import FileFormatError


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "log.h5"
    complete().save(path)
    return path


def test_everything_comes_back(file):
    assert_equal(Dataset.load(file), complete())
    assert not Dataset.load(str(file)).q.flags.writeable


def test_a_sample_out_of_order_and_units_per_joint_come_back(tmp_path):
    data = dataset(model=model("prismatic"), truth={"lambda": np.zeros((40, 0))}).rows([9, 2, 30])
    data.save(tmp_path / "log.h5")
    assert_equal(Dataset.load(tmp_path / "log.h5"), data)


def test_equal_datasets_give_equal_bytes(file, tmp_path):
    complete().save(tmp_path / "again.h5")
    assert (tmp_path / "again.h5").read_bytes() == file.read_bytes()


# ---------------------------------------------------------------- files that cannot be read


def test_what_is_no_dataset_is_said(tmp_path):
    with pytest.raises(FileFormatError, match="is not a file"):
        Dataset.load(tmp_path / "absent.h5")
    with pytest.raises(FileFormatError, match="is not a file"):
        Dataset.load(tmp_path)
    text = tmp_path / "log.csv"
    text.write_text("q,v\n1,2\n")
    with pytest.raises(FileFormatError, match="is not an HDF5 file"):
        Dataset.load(text)
    text.write_bytes(b"")
    with pytest.raises(FileFormatError, match="is not an HDF5 file"):
        Dataset.load(text)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["q"] = np.zeros(3)
    with pytest.raises(FileFormatError, match="not a forcegp dataset"):
        Dataset.load(tmp_path / "other.h5")


def change(file: Path, name: str, values: object = None) -> None:
    """Delete a dataset, or put another in its place."""
    with h5py.File(file, "a") as opened:
        del opened[name]
        if values is not None:
            opened[name] = values


TWO = np.full(2, b"forcegp-dataset")
OTHERS = {
    "format": [np.bytes_("another"), "forcegp-dataset", TWO, 1.0, np.zeros(0), h5py.Empty("f8")],
    "format_version": [2, 1000, 0, -1, np.bytes_("one"), 1.5],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, each) for name, values in OTHERS.items() for each in values], ids=repr
)
def test_files_of_another_kind_or_version_are_refused(file, name, value):
    with h5py.File(file, "a") as opened:
        opened.attrs[name] = value
    assert is_dataset(file) == (name == "format_version")
    value = value.decode() if isinstance(value, bytes) else value
    said = rf"format version .*{value}.*; this forcegp .* reads 1\. Use what wrote"
    with pytest.raises(FileFormatError, match=said if name == "format_version" else "not a forcegp dataset"):
        Dataset.load(file)


@pytest.mark.parametrize("name", ["q", "v", "u", "a", "time", "episode", "metadata", "model"])
def test_a_missing_field_is_named(file, name):
    change(file, name)
    with pytest.raises(FileFormatError, match=rf"log.h5 has no {name}; a dataset needs"):
        Dataset.load(file)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("q", np.zeros((4, 2)), "not valid: v has 40 rows"),
        ("q", np.full((40, 2), np.nan), "not valid: q is nan at row 0"),
        ("q", np.full((40, 2), b"x"), "'q' must hold numbers"),
        ("episode", np.zeros(40), "episode must be an array of integers"),
        ("model", np.zeros(2), "'model' must hold text"), ("metadata", "{}", "must hold text of fixed length"),
        ("metadata", np.bytes_("{"), "is damaged"), ("metadata", np.bytes_("[1]"), "must be a JSON object"),
        ("metadata", np.full(2, b"{}"), "must hold one text"),
        ("truth/a", np.zeros((40, 9)), r"truth\['a'\] has shape"), ("truth", np.zeros(3), "'truth' must be a group"),
        ("strokes", np.zeros((40, 3)), "strokes have shape"),
        ("strokes", np.full((40, 2, 3), np.nan), "give finite numbers"),
        ("noise_std", -np.ones(2), "noise_std of joint 'shoulder' is -1.0"),
    ],
)  # fmt: skip
def test_wrong_contents_are_named(file, name, values, message):
    change(file, name, values)
    with pytest.raises(FileFormatError, match=message) as error:
        Dataset.load(file)
    assert str(file) in str(error.value)


def test_nothing_outside_the_file_is_read(file, tmp_path):
    np.zeros((40, 2)).tofile(tmp_path / "secret")
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["q"] = np.zeros((40, 2))
    for make in (
        lambda opened: opened.__setitem__("q", h5py.ExternalLink(str(tmp_path / "other.h5"), "/q")),
        lambda opened: opened.__setitem__("q", h5py.SoftLink("/v")),
        lambda opened: opened.create_dataset("q", (40, 2), "f8", external=str(tmp_path / "secret")),
        lambda opened: opened.create_group("q"),
    ):
        with h5py.File(file, "a") as opened:
            del opened["q"]
            make(opened)
        with pytest.raises(FileFormatError, match="'q' must be a dataset stored in this file"):
            Dataset.load(file)


@pytest.mark.parametrize(("rows", "words"), [(10**13, "claims the"), (11_100, "claims the"), (10_320, "not valid")])
def test_a_shape_that_the_file_does_not_hold_is_refused_before_memory_is_taken(file, rows, words):
    """Deflate makes 1032 bytes of one: the 160 of one chunk may be those of 10,320 rows, and not of many more."""
    with h5py.File(file, "a") as opened:
        del opened["q"]
        opened.create_dataset("q", (rows, 2), "f8", chunks=(10, 2))[:10] = 1.0
    with pytest.raises(FileFormatError, match=words):
        Dataset.load(file)


# ---------------------------------------------------------------- docs/how-to/data-format.md


def test_every_stored_name_is_in_the_docs(repository, file):
    text = (repository / "docs/how-to/data-format.md").read_text(encoding="utf-8")
    with h5py.File(file, "r") as opened:
        names = [*opened.attrs]
        opened.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    assert all(f"`{name}`" in text for name in names), names
