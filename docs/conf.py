"""Sphinx settings of the documentation: `make docs` builds it into build/docs, warnings as errors."""

import os
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS / "_extensions"))

import forcegp  # noqa: E402  # the path comes first

project = "forcegp"
author = "The forcegp developers"
project_copyright = "The forcegp developers, Apache-2.0"
release = version = forcegp.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "commands",
    "docstrings",
    "mathml",
    "public_names",
    "repository_links",
]
html_theme = "furo"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_favicon = "_static/favicon.svg"
html_title = f"forcegp {release}"
exclude_patterns = ["_extensions", "_static"]

# Links to headings, `$formulas$`, and definition lists.
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4

# Notebooks run once, in a folder of their own; unchanged ones come from the cache. They import from examples/.
os.environ["PYTHONPATH"] = os.pathsep.join([str(DOCS.parent / "examples"), *filter(None, [os.getenv("PYTHONPATH")])])
nb_execution_in_temp = True
nb_execution_mode = "cache"
nb_execution_cache_path = str(DOCS.parent / "build" / "notebooks")
nb_execution_timeout = 120
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 100
default_role = "py:obj"  # a class named in a docstring is a link
