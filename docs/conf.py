"""Settings of the documentation, which `make docs` builds into docs/_build/html."""

from textwrap import dedent
from typing import Any

from sphinx.application import Sphinx

import unitouch_gen

project = "unitouch_gen"
author = "the authors of unitouch_gen"
copyright = f"{author}. Apache-2.0"
release = unitouch_gen.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = f"unitouch_gen {release}"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["wide.css"]

myst_heading_anchors = 3

default_role = "literal"  # docstrings put names between single backticks, as in Markdown
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True  # as they are written, not as they are on the machine that builds this
napoleon_numpy_docstring = False
napoleon_use_rtype = False


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", straighten_examples, priority=400)  # before napoleon reads the sections


def straighten_examples(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Brings docstrings in diffusers' manner, with examples left of the other sections and between fences, in order."""
    start = next((number for number, line in enumerate(lines) if line.strip() == "Examples:"), None)
    if start is None:
        return
    end = next((i for i in range(start, len(lines)) if lines[i].strip() in ("Returns:", "Raises:")), len(lines))
    parts = (lines[:1], lines[1:start], lines[start:end], lines[end:])
    straight = [line for part in parts for line in dedent("\n".join(part)).splitlines()]
    lines[:] = [line for line in straight if not line.strip().startswith("```")]
