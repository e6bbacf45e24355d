"""The documentation: every page is reached, every link leads somewhere, every public name is there and described."""

import importlib
import importlib.util
import inspect
import re
from urllib.parse import unquote

import pytest
from support.fenced import REPOSITORY as ROOT
from support.fenced import all_blocks

DOCS = ROOT / "docs"
PAGES = sorted(page for page in DOCS.rglob("*.md") if "_build" not in page.parts)
_LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)|!\[[^\]]*\]\(([^)\s]+)\)")


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
        assert place.exists(), f"{target} of {page.name}"
        if anchor and place.suffix == ".md":
            assert anchor in anchors(place), f"#{anchor} of {target or page.name}, from {page.name}"


def test_every_page_is_linked_from_an_index_page():
    linked = set()
    for index in [page for page in PAGES if page.name == "index.md"]:
        linked |= {
            (index.parent / target.partition("#")[0]).resolve() for target, _ in _LINK.findall(index.read_text())
        }
    assert [page for page in PAGES if page != DOCS / "index.md" and page.resolve() not in linked] == []


def test_page_opens_with_title_and_what_the_reader_can_do_after_it():
    shelves = ("tutorials", "guides")
    for page in [page for page in PAGES if page.relative_to(DOCS).parts[0] in shelves]:
        title, opening = page.read_text().split("\n\n")[:2]
        assert title.startswith("# "), page
        assert opening.startswith("After reading this page you"), page


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


@pytest.mark.slow
def test_every_link_and_picture_of_the_built_pages_leads_somewhere(html, built):
    """Building itself is without a warning and without a network (`built_pages.build`)."""
    assert len(built) > 40
    for name, page in built.items():
        for target in page.targets:
            if re.match(r"[a-z]+:", target):
                assert not re.match(r"https?:", target) or target not in page.loaded, f"{name} loads {target}"
                continue
            path, _, anchor = unquote(target).partition("#")
            file = (page.file.parent / path.partition("?")[0]).resolve() if path else page.file
            file = file / "index.html" if file.is_dir() else file
            assert file.is_file(), f"{name}: {target}"
            other = built.get(file.relative_to(html.resolve()).with_suffix("").as_posix()) if anchor else None
            assert other is None or anchor in other.ids, f"{name}: {target}"


@pytest.mark.slow
def test_the_built_pages_show_every_block_of_the_sources(built):
    for page in PAGES:
        shown = built[page.relative_to(DOCS).with_suffix("").as_posix()].blocks
        written = [block for block in all_blocks(page) if not block.language.startswith("{")]
        assert [text.strip() for _, text, _ in shown] == [block.text.strip() for block in written], page.name
