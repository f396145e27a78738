"""Settings of the documentation's site, which `make docs` builds with Sphinx.

Pages are Markdown (MyST). Two references are made from the code when the site is built: `docs/reference/api/` from the
docstrings, and `docs/reference/configuration.md` from the configuration tree.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import configuration_reference  # noqa: E402

project = "epo_lightning"
author = copyright = "the epo_lightning contributors"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.apidoc", "sphinx.ext.napoleon"]
exclude_patterns = ["conf.py", "configuration_reference.py", "reference/api/modules.rst"]
html_theme = "furo"
html_title = project
html_copy_source = False
toc_object_entries = False
nitpicky = True
suppress_warnings = ["ref.python"]  # a name that two modules offer
# References to this package's objects are checked. Types of other packages in signatures have no page here.
nitpick_ignore_regex = [
    ("py:.*", r"(?!epo_lightning\b).*"),
    # Private bases and type variables.
    ("py:(class|obj)", r"epo_lightning\..*\.(_\w+|Function|Part|Section|Some|Value)"),
]

myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_url_schemes = ["http", "https", "mailto"]

apidoc_modules = [
    {
        "path": str(HERE.parent / "epo_lightning"),
        "destination": "reference/api",
        "module_first": True,
        "automodule_options": {"members", "show-inheritance", "ignore-module-all"},
    }
]
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False  # those of Lightning and PyTorch refer to pages of theirs
napoleon_use_ivar = True
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_use_type_comments = False  # there are none, and the search for them takes a tenth of the time


def plain(app: Sphinx, kind: str, name: str, item: object, options: object, lines: list[str]) -> None:
    """Escape what mathematics in docstrings shares with reStructuredText: |x| and names that end in an underscore."""
    marks = re.compile(r"(``[^`]*``|`[^`]*`_?)|(\|)|(?<=\w)(_)(?!\w)")
    lines[:] = [marks.sub(lambda found: found[1] or "\\" + (found[2] or found[3]), line) for line in lines]


def setup(app: Sphinx) -> None:
    configuration_reference.write(HERE / "reference" / "configuration.md")
    app.connect("autodoc-process-docstring", plain)
