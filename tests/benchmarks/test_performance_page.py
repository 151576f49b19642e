"""docs/benchmarks/performance.md equals its JSON; each number has a meaning and a question that measures it."""

import json
from importlib.util import find_spec

import pytest
from benchmarks.__main__ import RESULTS
from benchmarks.performance_page import PAGE, QUESTIONS, kept, performance_page

ABOUT_ALL = {"machine", "date"}


@pytest.fixture(scope="module")
def results():
    return json.loads(RESULTS.read_text(encoding="utf-8"))


def test_the_page_equals_its_numbers(results):
    assert PAGE.read_text(encoding="utf-8") == performance_page(results)


def test_every_number_has_a_meaning_and_every_question_a_module(results):
    assert set(results) - {key for asked in QUESTIONS.values() for key in asked if key != "title"} == ABOUT_ALL
    assert all(find_spec(f"benchmarks.{question}") for question in QUESTIONS)


@pytest.mark.parametrize(
    ("value", "bound", "expected"),
    [
        (0.5, "<= 0.5", "yes"), (0.51, "<= 0.5", "**no**"), (2.0, ">= 1.6", "yes"), (1.0, ">= 1.6", "**no**"),
        (1.0, "", ""),
    ],
)  # fmt: skip
def test_bounds(value, bound, expected):
    assert kept(value, bound) == expected
