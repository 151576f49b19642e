"""`forcegp fit` looks at its data: one line of what would spoil the model, none for a clean log, and none if asked."""

import numpy as np
import pytest
from tests.checks.corruptions import at, clean, on_a_line, two_links
from tests.checks.logs import column

QUICK = ("--points", 12, "--iterations", 2, "--restarts", 1)
FIT = (*QUICK, "--forces", "gp:joint-friction", "--overwrite", "--out", "run")


def looked(stderr: str) -> list[str]:
    """The warnings of the look; two iterations of a search do not converge, which is another one."""
    return [line for line in stderr.splitlines() if line.startswith("warning: ") and "did not converge" not in line]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place, data = tmp_path_factory.mktemp("looks"), clean(two_links(), 0, seconds=5.0)
    data.save(place / "clean.h5")
    column(at(data, "q", [1.0, 1.0]), "u", 1, np.negative).save(place / "sign.h5")
    on_a_line(0, seconds=5.0).save(place / "line.h5")
    return place


def test_a_clean_log_is_fitted_without_a_word_and_a_search_that_stopped_names_the_option(forcegp, folder):
    for name in ("line.h5", "clean.h5"):
        done = forcegp("fit", name, *FIT, folder=folder).ok()
        assert not looked(done.stderr)
    shown = " ".join(done.stdout.split())
    assert "not converged" in shown
    assert "raise --iterations" in shown
    assert "`" not in shown


def test_one_line_names_what_is_wrong_and_the_next_step(forcegp, folder):
    (line,) = looked(forcegp("fit", "sign.h5", *FIT, folder=folder).ok().stderr)
    assert line.startswith("warning: torque sign: the torque of joint2 has the opposite sign")
    assert "forcegp check sign.h5" in line
    assert not looked(forcegp("fit", "sign.h5", *FIT, "--no-checks", folder=folder).stderr)
    assert "sign.h5: torque sign: the" in forcegp("score", "run", "sign.h5", folder=folder).ok().stderr


def test_the_table_of_check_is_never_cut(forcegp, folder, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    done = forcegp("check", "clean.h5", folder=folder)
    (header,) = [line for line in done.stdout.splitlines() if line.split()[:2] == ["joint", "unexplained"]]
    rows = [line for line in done.stdout.splitlines() if line.startswith(" joint")][-2:]
    assert len(header.split()) == 4
    for row in rows:
        assert row.split()[2] == "%"
        assert len(row.split()) == 5


def test_the_next_step_shows_what_the_fit_found(forcegp, folder):
    """forcegp check looks at the robot of its own options, and has none for contacts: there the remedy stands."""
    done = forcegp("fit", "clean.h5", *FIT, "--gravity", "0,0,0", folder=folder)
    assert "See forcegp check clean.h5 --gravity=0,0,0 (--no-checks" in " ".join(done.stderr.split())
    done = forcegp("fit", "clean.h5", *FIT, "--contact", "link2@0,0,-0.3:plane:1,0,0,-0.07", folder=folder)
    said = " ".join(done.stderr.split())
    assert "warning: contact: " in said
    assert "See forcegp check" not in said
    assert "--contact" in said
