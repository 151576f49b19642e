"""Verdicts against Student's paired test of scipy, and the models that they are about."""

import numpy as np
import pytest
from scipy.stats import ttest_rel

from forcegp.validation.paired_tests import against_baseline, best_of, conclusions, paired_test


@pytest.mark.parametrize("score", ["nlpd", "force_rms"])
def test_intervals_are_those_of_the_paired_test(score):
    generator = np.random.default_rng(1)
    other = generator.uniform(1.0, 2.0, 6)
    one = other * generator.uniform(0.7, 1.05, 6)
    found = paired_test(score, "a", "b", one.tolist(), other.tolist())
    change = (lambda x: x) if score == "nlpd" else np.log
    interval = ttest_rel(change(one), change(other)).confidence_interval(0.95)
    back = (lambda x: x) if score == "nlpd" else np.exp
    assert np.allclose(found.interval, [back(interval.low), back(interval.high)])
    assert found.value == pytest.approx(back(np.mean(change(one) - change(other))))
    assert (found.runs, found.wins) == (6, int((one < other).sum()))


def test_the_verdict_needs_an_interval_on_one_side():
    better = paired_test("nrmse", "a", "b", [0.5, 0.52, 0.48], [1.0, 1.0, 1.0])
    assert better.outcome == "better"
    assert better.sentence.startswith("**Yes** by the normalised error of the acceleration: a / b = 0.5")
    assert paired_test("nrmse", "a", "b", [1.0, 1.0, 1.0], [0.5, 0.52, 0.48]).outcome == "worse"
    assert paired_test("nlpd", "a", "b", [-2.0, 3.0, 1.0], [0.0, 0.0, 0.0]).outcome == "undecided"
    one = paired_test("nrmse", "a", "b", [0.1], [1.0])
    assert (one.outcome, one.interval) == ("undecided", None)
    assert "one run, so no interval" in one.sentence
    assert paired_test("nrmse", "a", "b", [], []) is None
    assert paired_test("nrmse", "a", "b", [0.0], [1.0]) is None


def cell(seed: int, force: float | None, diverged: int = 0, motion: float | None = 0.1) -> dict:
    if force is None:
        return {"split": "s", "seed": seed, "result": None}
    motions = {"rms": [motion], "diverged": [diverged]}
    result = {"nrmse": [force], "force_rms": [force, force], "nlpd": -1.0 / force, "motions": motions}
    result["stretches"] = {name: [force, 0.7] for name in ("nrmse", "force_rms", "nlpd")}  # equal in the second
    return {"split": "s", "seed": seed, "result": result}


def summary(kinds: dict[str, str], cells: dict[str, list[dict]]) -> dict:
    out = {}
    for name, kind in kinds.items():
        results = [each["result"] for each in cells[name] if each["result"] is not None]
        lost = sum(result["motions"]["diverged"][-1] for result in results)
        out[name] = {"kind": kind, "runs": len(results), "motions": {"diverged": [lost]} if results else None}
    return out


KINDS = {"urdf": "given", "ls": "identified", "ls2": "identified", "gp": "force prior", "net": "black box"}


def test_every_question_is_answered_by_the_best_of_each_kind():
    cells = {
        "urdf": [cell(k, 4.0 + 0.1 * k) for k in range(3)],
        "ls": [cell(k, 1.0 + 0.01 * k) for k in range(3)],
        "ls2": [cell(0, 0.01), cell(1, None), cell(2, 0.01)],  # better, but failed once
        "gp": [cell(k, 0.5 + 0.01 * k, diverged=k) for k in range(3)],
        "net": [cell(k, None) for k in range(3)],
    }
    told = summary(KINDS, cells)
    assert best_of(told, cells, ("identified",), "force_rms") == "ls"
    assert best_of(told, cells, ("black box",), "force_rms") is None
    found = conclusions(told, cells)
    assert [item["question"] for item in found] == [
        "Is the identified model better than the system as given?",
        "Does a Gaussian process on forces beat the identified model?",
    ]
    for item in found:
        assert {a["score"]: a["verdict"] for a in item["answers"] if a["score"] != "motion"} == dict.fromkeys(
            ("nrmse", "force_rms", "nlpd"), "better"
        )
    against = against_baseline(told, cells)
    assert against["baseline"] == "ls"
    assert set(against["models"]) == {"urdf", "ls2", "gp"}
    assert against["models"]["ls2"]["force_rms"]["runs"] == 2
    assert against["models"]["urdf"]["force_rms"]["verdict"] == "worse"
    gp, urdf = (against["models"][name]["force_rms"] for name in ("gp", "urdf"))
    assert (gp["ahead"], urdf["ahead"], gp["stretches"]) == (1, 0, 2)
    assert "better in 3 of 3 runs and in 1 of 2 held-out stretches of time" in gp["sentence"]
    assert "stretches" not in against["models"]["gp"]["motion"]["sentence"]


def test_a_model_whose_motions_diverge_is_not_the_best():
    kinds = {"a": "force prior", "b": "force prior"}
    cells = {"a": [cell(0, 1.0, diverged=3, motion=0.01)], "b": [cell(0, 1.0, diverged=0, motion=0.5)]}
    assert best_of(summary(kinds, cells), cells, ("force prior",), "motion") == "b"


def test_without_identification_the_system_as_given_is_the_baseline():
    cells = {"urdf": [cell(0, 1.0)], "gp": [cell(0, 0.5)]}
    told = summary({"urdf": "given", "gp": "force prior"}, cells)
    assert against_baseline(told, cells)["baseline"] == "urdf"
    assert against_baseline({"gp": told["gp"]}, cells) is None
