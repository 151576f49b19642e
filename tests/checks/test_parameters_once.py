"""What explains the torques is named once."""

import re

from tests.checks.corruptions import clean, scaled, two_links

from forcegp.checks import check


def test_one_explanation_is_named_once():
    """A mass with its inertia and one without read the same: a payload is both."""
    data = scaled(clean(two_links(), 0, noise="qvu"), masses=(0.6, 1.0))
    (said,) = [each.seen for each in check(data).findings if each.subject == "masses"]
    stated = re.findall(r"a mass of (\S+) of [\d.]+ times", said)
    assert len(stated) == len(set(stated)) >= 1, said
