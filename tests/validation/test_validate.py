"""A whole comparison: one file per piece of work, resumed, extended, refused, and with a model that fails."""

import json
import shutil

import pytest
from tests.validation.moving_arm import given_system, moving_arm

from forcegp.errors import FileFormatError, InvalidInput, OutdatedWarning
from forcegp.fit import fit as fit_model
from forcegp.jobs import JobStore, code_digest
from forcegp.validation import (
    CANDIDATES,
    Candidate,
    Comparison,
    Training,
    split_named,
    validate,
)
from forcegp.validation.run import KIND

MODELS = ("given", "gp:joint-friction", "broken")
USUAL = "bodies+viscous+coulomb+rotor@accelerations"


@pytest.fixture(scope="module")
def data():
    return moving_arm(0.6, 2)


def comparison(data, **changes) -> Comparison:
    how = {"points": 15, "horizons": (0.1, 0.2), "starts": 2, "restarts": 1, "iterations": 5, **changes}
    return Comparison(data, data, given_system(), split_named(data, "episodes:1"), **how)


@pytest.fixture(autouse=True)
def model_of_somebody_else(monkeypatch):
    def fit_broken(training: Training):
        if training.seed == 1:
            raise ZeroDivisionError("nothing left")
        model = training.given.with_forces(noise=5.0)
        return fit_model(model, training.rows, restarts=1)

    monkeypatch.setitem(CANDIDATES, "broken", Candidate("fails with seed 1", "given", fit_broken))


def changed(folder) -> dict[str, int]:
    return {file.parent.name: file.stat().st_mtime_ns for file in (folder / "jobs").glob("*/job.json")}


def test_a_run_goes_on_where_it_was_and_grows(data, tmp_path):
    folder, notes = tmp_path / "out", []
    first = validate(comparison(data), folder, models=MODELS[:1], seeds=1, progress=lambda *told: notes.append(told))
    assert notes[-1][0] == notes[-1][1]
    kept = changed(folder)
    assert set(kept) == {  # the identification for the mass matrix, and the model
        f"episodes-1-seed0-identification-{USUAL}",
        "episodes-1-seed0-given",
    }
    assert set(first.document["models"]) == {"given"}
    grown = validate(comparison(data), folder, models=MODELS, seeds=2)
    assert {name: changed(folder)[name] for name in kept} == kept, "finished pieces are not computed again"
    assert len(changed(folder)) == 2 * len(MODELS), "an identification, and one seed of what uses all rows"
    before = changed(folder)
    (lost,) = (folder / "jobs").glob("episodes-1-seed0-gp_joint-friction*")
    shutil.rmtree(lost)
    (folder / "jobs" / f".{lost.name}.abc.tmp").mkdir()  # of a killed run
    again = validate(comparison(data), folder, models=MODELS, seeds=2)
    after = changed(folder)
    assert {name for name in before if before[name] != after[name]} == {lost.name}
    assert not list(folder.rglob("*.tmp"))
    for name in MODELS[:2]:
        for score in ("nrmse", "force_rms", "nlpd"):
            assert again.document["models"][name][score] == grown.document["models"][name][score]


def test_a_model_that_fails_is_a_row_that_says_why(data, tmp_path):
    found = validate(comparison(data), tmp_path / "out", models=MODELS, seeds=2)
    broken = found.document["models"]["broken"]
    assert broken["runs"] == 1
    assert broken["failures"] == [{"split": "episodes-1", "seed": 1, "error": "ZeroDivisionError: nothing left"}]
    page = (tmp_path / "out" / "report.md").read_text()
    assert "| broken (1 of 2 runs) |" in page
    assert "**broken** failed in 1 of 2 runs (episodes-1, seed 1): ZeroDivisionError: nothing left" in page
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == json.loads(json.dumps(found.document))
    for name in found.document["figures"]:
        assert (tmp_path / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"({name}.png)" in page


@pytest.mark.nightly
def test_processes_find_the_same_as_this_one(data, tmp_path):
    models = ("bodies+viscous@torques", "identified+gp:joint-friction")
    one, two = (validate(comparison(data), tmp_path / str(jobs), models=models, seeds=2, jobs=jobs) for jobs in (1, 2))
    assert len(list((tmp_path / "2" / "jobs").glob("*identification-bodies+viscous@torques"))) == 1, (
        "of all rows, so once"
    )
    for name in models:
        assert two.document["models"][name]["runs"] == 2
        for score in ("nrmse", "force_rms", "nlpd", "motions"):
            here, there = (each.document["models"][name][score] for each in (one, two))
            assert numbers(here) == pytest.approx(numbers(there), rel=1e-6)  # searches end where rounding lets them


def numbers(document) -> list[float]:
    """All numbers of a document, in its order."""
    if isinstance(document, dict):
        return [number for value in document.values() for number in numbers(value)]
    if isinstance(document, list):
        return [number for value in document for number in numbers(value)]
    return [document] if isinstance(document, int | float) else []


def test_all_that_failed_still_makes_a_page(data, tmp_path):
    def fit(training: Training):
        raise InvalidInput("not today")

    CANDIDATES["broken"] = Candidate("fails always", "given", fit)  # put back by the fixture
    found = validate(comparison(data), tmp_path / "out", models=("broken",), seeds=1)
    assert found.verdicts == []
    assert "not today" in (tmp_path / "out" / "report.md").read_text()


def test_another_configuration_is_refused_and_overwritten_on_demand(data, tmp_path):
    folder = tmp_path / "out"
    validate(comparison(data), folder, models=("given",), seeds=1)
    with pytest.raises(InvalidInput, match=r"points \(15, not 16\), restarts \(1, not 2\).*`folder`"):
        validate(comparison(data, points=16, restarts=2), folder, models=("given",), seeds=1)
    shorter = moving_arm(0.5, 2)
    with pytest.raises(InvalidInput, match=r"another recording_sha256.*, rows_sha256"):
        validate(comparison(shorter), folder, models=("given",), seeds=1)
    with JobStore(folder, KIND).locked(), pytest.raises(InvalidInput, match="another `forcegp validate` is at work"):
        validate(comparison(data), folder, models=("given",), seeds=1)
    found = validate(comparison(data, points=16), folder, models=("given",), seeds=1, overwrite=True)
    assert found.document["points"] == 16
    (folder / "jobs" / "episodes-1-seed0-given" / "job.json").write_text('{"name": ')
    with pytest.raises(FileFormatError, match="half written or damaged"):
        validate(comparison(data, points=16), folder, models=("given",), seeds=1)


def test_folders_of_others_are_not_touched(data, tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    for overwrite in (False, True):
        with pytest.raises(InvalidInput, match="was not written by `forcegp validate`"):
            validate(comparison(data), tmp_path, models=("given",), seeds=1, overwrite=overwrite)
    (tmp_path / "configuration.json").write_text("{}")
    with pytest.raises(InvalidInput, match="was not written by `forcegp validate`"):
        validate(comparison(data), tmp_path, models=("given",), seeds=1, overwrite=True)
    assert (tmp_path / "mine.txt").read_text() == "precious"


def test_an_identification_that_fails_leaves_the_mass_matrix_as_given_and_its_models_without_a_mean(
    data, tmp_path, monkeypatch
):
    def fail(name, model, rows):
        raise InvalidInput("too still")

    monkeypatch.setattr("forcegp.validation.jobs.identified_model", fail)
    models = ("given", "identified", "identified+gp:joint-friction")
    found = validate(comparison(data), tmp_path / "out", models=models, seeds=1)
    told = found.document["mass_matrix"]
    assert told == ["the model as given, because its identification failed (too still)"]
    for name in models[1:]:
        failure = found.document["models"][name]["failures"][0]
        assert failure["error"] == "the identification that it rests on failed: too still"
    assert found.document["models"]["given"]["runs"] == 1
    assert (
        f"the {USUAL} identification failed (episodes-1, seed 0): too still" in (tmp_path / "out/report.md").read_text()
    )


WRONG = [
    ({"models": ()}, "no model is named"),
    ({"models": ("given", "given")}, "named twice"),
    ({"models": ("identifed",)}, "did you mean 'identified'"),
    ({"models": ("gp:joint@measured",)}, "no evidence 'measured'"),
    ({"models": ("gp:joint:colour=red",)}, "cannot take 'colour=red'"),
    ({"models": ("identified+viscous",)}, "`identified` has its laws already"),
    ({"models": ("given@motions:1",)}, "nothing to refine on motions"),
    ({"seeds": 0}, "number of seeds is 0"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG, ids=[message for _, message in WRONG])
def test_wrong_arguments_are_refused_before_anything_is_written(data, tmp_path, changes, message):
    with pytest.raises(InvalidInput, match=message):
        validate(comparison(data), tmp_path / "out", **{"models": ("given",), "seeds": 1, **changes})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": 1000}, "two thirds"),
        ({"horizons": ()}, "horizons are"),
        ({"starts": 0}, "number of starts"),
        ({"restarts": 0}, "restarts is 0"),
        ({"integrator": "euler"}, "euler"),
        ({"identification": "guessing"}, "no force 'guessing'"),
        ({"identification": "gp:joint"}, "nothing to identify, or unknown forces"),
        ({"identification": "viscous@windows:.1"}, "from windows; give accelerations or torques"),
    ],
)
def test_a_comparison_that_cannot_be_made_is_refused(data, changes, message):
    with pytest.raises(InvalidInput, match=message):
        comparison(data, **changes)


def test_only_what_depends_on_a_changed_model_of_somebody_else_is_computed_anew(data, tmp_path, monkeypatch):
    models = ("given", "broken")
    validate(comparison(data), tmp_path / "out", models=models, seeds=1)
    before = changed(tmp_path / "out")
    digest = code_digest
    own = CANDIDATES["broken"].fit.__module__
    monkeypatch.setattr("forcegp.jobs.job.code_digest", lambda *modules: "new" if own in modules else digest(*modules))
    with pytest.warns(OutdatedWarning, match="1 of the results in .* by other code"):
        validate(comparison(data), tmp_path / "out", models=models, seeds=1)
    after = changed(tmp_path / "out")
    assert {name for name in before if before[name] != after[name]} == {"episodes-1-seed0-broken"}
