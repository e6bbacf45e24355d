"""How `make docs` builds these pages: Sphinx, MyST for Markdown, furo. Nothing is fetched."""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import reference

import rlcli

project = "rlcli"
author = "the rlcli contributors"
release = version = rlcli.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"rlcli {release}"
html_static_path: list[str] = []
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
napoleon_google_docstring = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
add_module_names = False
suppress_warnings = [
    "ref.python",  # one name in two modules, such as `data`
    "myst.header",  # the cards of tasks begin at their own level
    "myst.xref_missing",  # links to source files of the repository; tests/docs follows them all
]


_FILE = re.compile(r"^( *)```([a-z]+) file=(\S+)$", re.MULTILINE)


def with_file_names(app, docname, source):
    """Of a block that is to be written to a file, the page shows the file's name."""
    source[0] = _FILE.sub(r"\1```{code-block} \2\n\1:caption: \3\n", source[0])


_CODE = re.compile(r"(`+)(.+?)\1", re.DOTALL)


def in_rst(app, what, name, obj, options, lines):
    """Docstrings are written like these pages: code in backticks, programs between fences, a star is a star."""
    text = []
    for place, part in enumerate(re.split(r"^\s*```.*$", "\n".join(lines), flags=re.MULTILINE)):
        if place % 2:  # between fences
            text += ["", "::", "", *(f"    {line}" for line in part.strip("\n").split("\n")), ""]
            continue
        words = _CODE.split(part)
        for at in range(0, len(words), 3):
            words[at] = words[at].replace("*", "\\*").replace("|", "\\|")
        for at in range(2, len(words), 3):
            words[at] = f"``{' '.join(words[at].split())}``"
        del words[1::3]
        text += "".join(words).split("\n")
    lines[:] = text


def setup(app):
    """The reference is written from the code before it is read."""
    app.connect("builder-inited", lambda app: reference.write(Path(app.srcdir) / "reference"))
    app.connect("source-read", with_file_names)
    app.connect("autodoc-process-docstring", in_rst, priority=400)  # before napoleon reads it
