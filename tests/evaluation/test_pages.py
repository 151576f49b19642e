"""Pages from templates: nothing that a template asks for may be missing."""

import pytest
from jinja2 import UndefinedError

from forcegp.evaluation.pages import rendered


def test_a_template_that_is_not_given_its_values_is_refused(repository):
    with pytest.raises(UndefinedError):
        rendered(repository / "src/forcegp/validation/report.md.jinja", source={})
