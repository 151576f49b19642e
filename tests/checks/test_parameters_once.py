"""What explains the torques is named once."""

import re

from tests.checks.corruptions import clean, scaled, two_links

from forcegp.checks import check


def test_one_explanation_is_named_once():
    """A mass with its inertia and one without read the same: a payload is both."""
    data = clean(two_links(), 0)
    heavier = scaled(data, masses=(1.0, 0.7))
    said = [each.seen for each in check(heavier).findings if each.subject == "masses"]
    assert said
    for text in said:
        stated = re.findall(r"a mass of \S+ of [\d.]+ times", text)
        assert len(stated) == len(set(stated)), text
