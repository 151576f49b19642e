"""What `make mutants` leaves out, and which tests it runs for a mutant."""

from tests.mutant_sample import Mutant, read
from tests.mutants import selected

SOURCE = '''\
"""Module."""
from __future__ import annotations
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    from numbers import Real
LIMIT = 1
KEPT_BYTES = 2
Number = int | float
class Value:
    size: int | None = 3
    def __repr__(self):
        return "4" + "5"
    def grown(self, by: int | None = 6) -> int | None:
        if by > 7:
            raise ValueError("μμμ", 8 + 9)
        for k in range(10):
            report(k + 11)
            by += (
                12
            )
        return by
'''


def numbers_outside(spans):
    """Numbers of the source that no span covers."""
    found = []
    for line, text in enumerate(SOURCE.splitlines(), 1):
        for word in text.replace("(", " ").replace(")", " ").replace(":", " ").split():
            start = (line, text.index(word))
            if word.isdigit() and not any(first <= start < last for first, last in spans):
                found.append(int(word))
    return found


def test_what_no_test_should_notice_is_left_out():
    spans, _ = read(SOURCE)
    assert numbers_outside(spans) == [1, 3, 6, 7, 10, 12]
    lines = SOURCE.splitlines()
    outside = [
        (line, column)
        for line, text in enumerate(lines, 1)
        for column, character in enumerate(text)
        if character == "|" and not any(first <= (line, column) < last for first, last in spans)
    ]
    assert outside == []  # annotations and aliases of types


def test_lines_that_show_whether_a_fault_is_executed():
    _, executed = read(SOURCE)
    body_of_repr, body_of_grown = {12}, set(range(14, 22))
    assert executed[6] == executed[10] == body_of_repr | body_of_grown  # at import: all that uses the module
    assert executed[13] == body_of_grown  # a default
    assert executed[14] == {14}
    assert executed[16] == {16}
    assert executed[19] == {18, 19, 20}  # one statement


def test_tests_of_the_line_run_quick_ones_first_one_of_each_function_up_to_the_budget():
    names = ["t.py::slow", "t.py::many[a]", "t.py::many[b]", "t.py::failed", "t.py::else", "t.py::long"]
    seconds = dict(zip(names, [3.0, 0.2, 0.1, 0.1, 0.1, 50.0], strict=True))
    executed = {"seconds": seconds, "failed": ["t.py::failed"], "lines": {"m.py": {"7": [*names[:4], names[5], ""]}}}
    fault = Mutant("m.py", "AddNot", frozenset({7}), "", "")
    assert selected(fault, executed, 10.0) == ["t.py::many[b]", "t.py::slow", "t.py::many[a]"]
    assert selected(fault, executed, 0.05) == ["t.py::many[b]"]
    assert selected(Mutant("m.py", "AddNot", frozenset({8}), "", ""), executed, 10.0) == []
    at_import = Mutant("m.py", "AddNot", frozenset(), "", "")  # of a module without functions
    assert selected(at_import, executed, 0.3) == ["t.py::else", "t.py::many[b]"]
