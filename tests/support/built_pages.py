"""Pages built by Sphinx without network, and read back from the HTML."""

import re
import subprocess
import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

from support.fenced import REPOSITORY

_NO_NETWORK = """
import socket, sys
def no(*a, **k): raise OSError("no network")
socket.socket.connect = no
from sphinx.cmd.build import main
sys.exit(main(sys.argv[1:]))
"""


def build(folder):
    """Build all pages into `folder`; every warning is an error."""
    command = [sys.executable, "-c", _NO_NETWORK, "-q", "-W", "--keep-going", "-b", "html"]
    where = [REPOSITORY / "docs", folder / "html"]
    done = subprocess.run([*command, *where], capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    return folder / "html"


@dataclass
class Page(HTMLParser):
    """Content of a page: ids, targets of links and pictures, text, and code blocks with the comment before each."""

    file: Path
    ids: set = field(default_factory=set)
    targets: list = field(default_factory=list)
    loaded: set = field(default_factory=set)
    blocks: list = field(default_factory=list)
    """(language, text, comment before it or None)"""

    def __post_init__(self):
        super().__init__(convert_charrefs=True)
        self._comment, self._language, self._code, self._text = None, None, None, []
        self.feed(self.file.read_text(encoding="utf-8"))
        self.text = "".join(self._text)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        if "id" in found:
            self.ids.add(found["id"])
        self.targets += [found[name] for name in ("href", "src") if found.get(name)]
        if tag in ("script", "img", "link", "iframe", "video"):  # the browser loads these without a click
            self.loaded |= {found[name] for name in ("href", "src") if found.get(name)}
        language = re.match(r"highlight-(\S+) notranslate", found.get("class") or "")
        if language:
            self._language = language[1]
        elif tag == "pre" and self._language:
            self._code = []

    def handle_comment(self, text):
        self._comment = text.strip()

    def handle_data(self, text):
        if self._code is not None:
            self._code.append(text)
        elif text.strip() and self._language is None:
            self._comment = None
        self._text.append(text)

    def handle_endtag(self, tag):
        if tag == "pre" and self._code is not None:
            self.blocks.append((self._language, "".join(self._code), self._comment))
            self._language = self._code = self._comment = None
