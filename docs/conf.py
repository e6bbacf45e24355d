"""Sphinx configuration of the pages: MyST for Markdown, furo as the theme.

The build reads Markdown only: `docs/reference.py` generates the reference pages, which are committed. So it needs the
extra `docs` and nothing of rlcli's own dependencies, and it loads nothing from the network.
"""

import re
from pathlib import Path

project = "rlcli"
author = "the rlcli contributors"
_INIT = (Path(__file__).parents[1] / "rlcli" / "__init__.py").read_text(encoding="utf-8")
release = version = re.search(r'__version__ = "(.+?)"', _INIT)[1]
extensions = ["myst_parser"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"rlcli {release}"
html_static_path = ["static"]
html_css_files = ["pages.css"]
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence", "deflist"]
suppress_warnings = [
    "myst.header",  # pages with generated parts start some sections one level lower
    "myst.xref_missing",  # links to source files of the repository; tests/docs checks all links
]

_FILE = re.compile(r"^( *)```([a-z]+) file=(\S+)$", re.MULTILINE)


def show_file_names(app, docname, source):
    """Show the file name above a code block that the reader writes to a file."""
    source[0] = _FILE.sub(r"\1```{code-block} \2\n\1:caption: \3\n", source[0])


def setup(app):
    """Register the hook that reads the sources."""
    app.connect("source-read", show_file_names)
