"""`forcegp monitor run`: a table of contacts, and refusals."""

import json

import numpy as np
import pytest
from tests.control.test_monitor import DT, URDF_ALONE, motion, posterior  # noqa: F401  # a fixture

from forcegp import Dataset, save_posterior
from forcegp.cli.main import main


def saved(path, given):
    q, v, u = given
    Dataset(q=q, v=v, u=u, a=np.gradient(v, DT, axis=0), time=DT * np.arange(len(q)), model=URDF_ALONE).save(path)


@pytest.fixture(scope="module")
def workshop(posterior, tmp_path_factory):  # noqa: F811  # the fixture
    folder = tmp_path_factory.mktemp("monitor")
    save_posterior(posterior, folder / "run")
    push = np.zeros((800, 2))
    push[300:400], push[600:700] = (1.0, 0.5), (-1.0, 0.5)
    saved(folder / "free.h5", motion(120.0, 1))
    q, v, u = motion(8.0, 7, push)
    saved(folder / "log.h5", (q, v, u))
    (folder / "log.csv").write_text("time,q1\n0,0\n")
    return folder


def test_a_log_becomes_a_table_of_contacts(workshop, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(workshop)
    out = tmp_path / "contacts"
    assert main(["monitor", "run", "log.h5", "--free", "free.h5", "--out", str(out)]) == 0
    shown, (q, v, u) = capsys.readouterr(), motion(8.0, 7)
    assert ("2 contacts in 8 s" in shown.out, "warning" in shown.err) == (True, False)
    saved("turned.h5", (q, v, -u))
    assert main(["monitor", "run", "turned.h5", "--free", "free.h5", "--out", str(tmp_path / "turned")]) == 0
    assert "warning: turned.h5: torque sign: the" in capsys.readouterr().err
    found = json.loads((out / "contacts.json").read_text())
    [best, side], rows = found["smallest_forces"]["fore"], found["contacts"]
    assert (best, side) == (pytest.approx(0.07, rel=0.2), None)
    assert len(rows) == 2
    assert [row["start"] for row in rows] == pytest.approx([3.0, 6.0], abs=0.1)
    assert [row["end"] for row in rows] == pytest.approx([4.0, 7.0], abs=0.3)  # it fades
    assert {"contacts.json", "config.json", "SHA256SUMS"} == {f.name for f in out.iterdir()}
    assert json.loads((out / "config.json").read_text())["bandwidth"] == 2.0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "--free S|FREE.h5"), (("--free", "nowhere.h5"), "give seconds above 0, or a dataset that is there"),
        *((("--free", "5"), "too short for a threshold"), (("--free", "-1"), "give seconds above 0")),
        (("--free", "log.csv"), "log.csv is not an HDF5 file"),
        (("--free", "free.h5", "--bandwidth", "500"), "below 50"),
    ],
)  # fmt: skip
def test_refusals_are_one_line(forcegp, workshop, tmp_path, words, message):
    forcegp("monitor", "run", "log.h5", *words, "--out", tmp_path / "out", folder=workshop).refused(message)
    assert not (tmp_path / "out").exists()
