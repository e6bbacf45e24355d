"""A run's page as HTML: one file, nothing loaded from elsewhere, nothing that runs, all text escaped."""

from __future__ import annotations

import base64
import functools
import re
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from rlcli import __version__
from rlcli.reporting.run_page import Page
from rlcli.reporting.task_card import Card
from rlcli.safe_text import UNSAFE, shorten

POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; form-action 'none'"
)
"""The page's content security policy: no script, no frame, no font, nothing from any host."""

_TEMPLATES = Path(__file__).resolve().parent.parent / "templates" / "report"
_MOST = 2000
_NOT_SHOWN = re.compile(f"{UNSAFE.pattern}|[\ufffe\uffff]")
"""Characters that no page may hold, and those that turn the direction of text."""


def render(page: Page) -> str:
    """The whole page."""
    video = None if page.video is None else f"data:video/mp4;base64,{base64.b64encode(page.video).decode()}"
    return (
        _templates()
        .get_template("page.html.jinja")
        .render(
            page=page,
            policy=POLICY,
            video=video,
            version=__version__,
        )
    )


def card_html(card: Card, level: int = 2) -> str:
    """A task's card alone, whose headings begin at a level."""
    module: Any = _templates().get_template("card.html.jinja").module
    return str(module.card(card, level))


@functools.cache
def _templates() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_clean,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["coded"] = _coded
    return environment


def _clean(value: object) -> Any:
    """Text of a run as a page can show it; not too much of it."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    if value.startswith("data:video/mp4;base64,"):
        return value
    return shorten(_NOT_SHOWN.sub("\ufffd", value), _MOST, "…")


def _coded(text: str) -> Markup:
    """Escaped text in which `names` between backticks are code."""
    parts = _clean(text).split("`")
    if len(parts) % 2 == 0:
        return escape(_clean(text))
    return Markup().join(
        Markup("<code>{}</code>").format(part) if position % 2 else escape(part) for position, part in enumerate(parts)
    )
