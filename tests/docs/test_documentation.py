"""The documentation: every page is reached, every link leads somewhere, every public name is there and described."""

import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(page for page in DOCS.rglob("*.md") if not {"_build", "reference"} & set(page.relative_to(DOCS).parts))
_LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)|!\[[^\]]*\]\(([^)\s]+)\)")
_WRITTEN = {"index", "configuration", "terms", "command-line", "python"}
"""Pages of the reference, which are written from the code."""


@pytest.fixture(scope="module")
def reference():
    spec = importlib.util.spec_from_file_location("reference", DOCS / "reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def anchors(page):
    """The names of a page's headings, as GitHub and MyST make them."""
    names = re.findall(r"^#{1,6} (.+?)\s*$", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", re.sub(r"`", "", name)).lower().replace(" ", "-") for name in names}


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=lambda page: str(page.relative_to(ROOT))
)
def test_every_link_of_a_page_leads_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for found in _LINK.findall(text):
        target, _, anchor = (found[0] or found[1]).partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        place = (page.parent / target).resolve() if target else page
        if place.parent == DOCS / "reference" and place.stem in _WRITTEN:
            continue
        assert place.exists(), f"{target} of {page.name}"
        if anchor and place.suffix == ".md":
            assert anchor in anchors(place), f"#{anchor} of {target or page.name}, from {page.name}"


def test_every_page_is_in_the_index():
    text = (DOCS / "index.md").read_text() + (DOCS / "zoo" / "index.md").read_text()
    for page in PAGES:
        if page.name != "index.md":
            assert f"({page.name}" in text or f"/{page.name}" in text, page.name


def test_no_public_name_has_gone_or_come_unnoticed(reference):
    known = reference.PUBLIC.read_text().split()
    now = [f"{module}.{name}" for module in reference.MODULES for name in reference.public_names(module)]
    gone = sorted(set(known) - set(now))
    assert not gone, "a name that others may use is gone: say so in the changelog, then `python docs/reference.py`"
    assert sorted(set(now) - set(known)) == [], "a new public name: `python docs/reference.py` notes it"


def test_every_public_name_says_what_it_is(reference):
    for line in reference.PUBLIC.read_text().split():
        module, _, name = line.rpartition(".")
        value = getattr(importlib.import_module(module), name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert (value.__doc__ or "").strip(), line


def test_the_reference_has_every_key_term_and_command(reference, tmp_path):
    from rlcli.cli.app import COMMANDS
    from rlcli.config.schema import TaskConfig

    reference.write(tmp_path)
    configuration = (tmp_path / "configuration.md").read_text()
    for key in TaskConfig.model_fields:
        assert f"| `{key}` |" in configuration
    commands = (tmp_path / "command-line.md").read_text()
    for command in COMMANDS:
        assert f"## rlcli {command}\n" in commands
    assert "`--checkpoint`" in commands
    terms = (tmp_path / "terms.md").read_text()
    for term in ("joint_pos_rel", "joint_position", "track_lin_vel_xy_exp", "time_out", "uniform_velocity"):
        assert f"### {term}\n" in terms
    python = (tmp_path / "python.md").read_text()
    for line in reference.PUBLIC.read_text().split():
        assert f":: {line}\n" in python


@pytest.mark.slow
def test_the_pages_build_without_a_warning_and_without_a_network(tmp_path):
    blocked = "import socket\ndef no(*a, **k): raise OSError('no network')\nsocket.socket.connect = no\n"
    code = f"{blocked}import sys\nfrom sphinx.cmd.build import main\nsys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", code, "-q", "-W", "--keep-going", "-b", "html", DOCS, tmp_path / "html"],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "html" / "index.html").is_file()
