"""What `forcegp reproduce` refuses before it computes anything."""

import pytest
from tests.cli.one_line import assert_refused

pytest.importorskip("pybullet")

REFUSALS = [
    ("fig9", "no figure 'fig9'"),
    ("fig2b --preset huge", "no preset 'huge'"),
    ("fig2b --jobs -1", "jobs is -1; give the number of tasks at once, at least 1"),
    ("fig2b --backend dask", "no backend 'dask'; choose serial, joblib"),
    ("fig2b --preset smoke --points 500", "its data have 400 rows, so give 2 to 400"),
    ("fig2b --preset smoke --points 1", "asked for 1 training points"),
    ("fig2b --seed-list -3", "--seed-list"),
    ("friction", "no figure 'friction'"),
]


@pytest.mark.parametrize(("words", "message"), REFUSALS, ids=[words for words, _ in REFUSALS])
def test_it_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, capfd, words, message):
    monkeypatch.chdir(tmp_path)
    assert_refused(f"reproduce {words} --out new", message, tmp_path, capfd)
