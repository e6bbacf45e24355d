"""Render the HTML page of `rlcli report`: one file without scripts or external resources.

The content comes from `rlcli.reporting.run_page_content`; all of its text is escaped.
"""

import base64
import functools
import re
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from rlcli import __version__
from rlcli.config.schema import bound_text
from rlcli.reporting.run_page_content import Page
from rlcli.safe_text import UNSAFE, shorten

CONTENT_SECURITY_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; form-action 'none'"
)
"""Content security policy of the page: no scripts, frames or fonts, and nothing from any host."""

_TEMPLATES = Path(__file__).resolve().parent.parent / "templates" / "report"
_MAX_CHARACTERS = 2000
_NOT_SHOWN = re.compile(f"{UNSAFE.pattern}|[\ufffe\uffff]")
"""Characters that HTML forbids, and characters that change the direction of text."""


def render(page: Page) -> str:
    """Return the report of a run as HTML, with the video embedded."""
    video = None if page.video is None else f"data:video/mp4;base64,{base64.b64encode(page.video).decode()}"
    template = templates().get_template("page.html.jinja")
    return template.render(page=page, policy=CONTENT_SECURITY_POLICY, video=video, version=__version__)


@functools.cache
def templates() -> jinja2.Environment:
    """Return the Jinja environment that renders the HTML templates of rlcli."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_clean,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["coded"] = _coded
    environment.globals["bound_text"] = bound_text
    return environment


def _clean(value: object) -> Any:
    """Replace characters that HTML forbids in a template's value, and shorten it to 2000 characters.

    Values that are not text, and embedded videos, are returned unchanged.
    """
    if not isinstance(value, str) or isinstance(value, Markup) or value.startswith("data:video/mp4;base64,"):
        return value
    return shorten(_NOT_SHOWN.sub("\ufffd", value), _MAX_CHARACTERS, "…")


def _coded(text: str) -> Markup:
    """Return escaped text in which names between backticks are `<code>` elements."""
    parts = _clean(text).split("`")
    if len(parts) % 2 == 0:
        return escape(_clean(text))
    return Markup().join(
        Markup("<code>{}</code>").format(part) if position % 2 else escape(part) for position, part in enumerate(parts)
    )
