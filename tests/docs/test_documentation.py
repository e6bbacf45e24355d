"""The documentation: every page is reached, every link leads somewhere, every public name is there and described."""

import importlib
import importlib.util
import inspect
import re
from html import unescape
from urllib.parse import unquote

import pytest
import typer
from support.fenced import REPOSITORY as ROOT
from support.fenced import all_blocks

import rlcli.errors
from rlcli.cli.app import build
from rlcli.config.schema import TaskConfig
from rlcli.config.term_signatures import SECTIONS, builtin_terms

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


def sections(html, page):
    """The text below each heading of a built page, by heading."""
    text = (html / f"{page}.html").read_text(encoding="utf-8")
    parts = re.split(r"<h[2-4]>(.*?)<a class=\"headerlink\".*?</h[2-4]>", text, flags=re.DOTALL)
    plain = [unescape(re.sub(r"<[^>]+>", "", part)) for part in parts]
    return dict(zip(plain[1::2], plain[2::2], strict=True))


def lines(text):
    return {line.strip() for line in text.splitlines()}


def settings_of_trainers(reference):
    for trainer in reference.TRAINERS:
        for algorithm, place in importlib.import_module(f"rlcli.rl.{trainer}_config").SPEC.algorithms.items():
            module, _, name = place.partition(":")
            schema = getattr(importlib.import_module(module), name).model_json_schema()
            yield f"{trainer}, {algorithm}", schema


@pytest.mark.slow
def test_the_built_reference_has_every_key_with_its_description_and_range(html, reference):
    found = sections(html, "reference/configuration")
    for title, schema in [("Task", TaskConfig.model_json_schema()), *settings_of_trainers(reference)]:
        within = "" if title == "Task" else f"{title}: "
        models = {title: schema} | {f"{within}{name}": model for name, model in schema.get("$defs", {}).items()}
        for heading, model in models.items():
            for key, field in model.get("properties", {}).items():
                assert key in lines(found[heading]), f"{heading}: {key}"
                assert field.get("description") or "const" in field, f"{heading}: {key} says nothing"
                for bound in re.findall(r"'(?:exclusiveM|m)(?:inimum|aximum)': ([^,}]+)", str(field)):
                    assert re.search(rf"[<>]=? {re.escape(bound)}(?![\d.])", found[heading]), (
                        f"{heading}: {key}: {bound}"
                    )


@pytest.mark.slow
def test_the_built_reference_has_every_term_with_its_formula_and_keys(html):
    text = (html / "reference" / "terms.html").read_text(encoding="utf-8")
    parts = re.split(r"<h2>(.*?)<a", text)
    by_section = dict(zip(map(str.lower, parts[1::2]), parts[2::2], strict=True))
    for section in SECTIONS:
        for name, term in builtin_terms(section).items():
            page = by_section["randomization" if ".randomization" in term.module else section]
            heading = re.search(rf"<h3>{name}<a.*?(?=<h3>|\Z)", page, re.DOTALL)
            assert heading, f"{section}: {name}"
            said = " ".join(unescape(re.sub(r"<[^>]+>", "", heading[0])).split())
            assert len(term.summary) > 10, f"{section}: {name} does not say what it computes"
            words = re.findall(r"[a-z]{3,}", term.summary)
            assert all(word in said for word in words), f"{section}: {name}: {term.summary}"
            for parameter in term.parameters:
                assert f'<span class="pre">{parameter.name}</span>' in heading[0], (
                    f"{section}: {name}: {parameter.name}"
                )


@pytest.mark.slow
def test_the_built_reference_has_every_command_option_and_exit_code(html):
    found = sections(html, "reference/command-line")

    def walk(command, path):
        for name, inner in command.commands.items():
            assert f"{path} {name}" in found
            if hasattr(inner, "commands"):
                walk(inner, f"{path} {name}")
                continue
            for parameter in inner.params:
                if not getattr(parameter, "hidden", False) and parameter.name != "help":
                    for option in (*parameter.opts, *parameter.secondary_opts):
                        shown = option if option.startswith("-") else (parameter.metavar or option).upper()
                        assert shown in found[f"{path} {name}"], f"{path} {name}: {shown}"
                        assert (getattr(parameter, "help", None) or "").strip(), f"{path} {name}: {shown} says nothing"

    walk(typer.main.get_command(build()), "rlcli")
    codes = {error.exit_code for error in vars(rlcli.errors).values() if hasattr(error, "exit_code")}
    assert all(re.search(rf"^\s*{code}\b", found["Exit codes"], re.MULTILINE) for code in (0, *codes, 75))


@pytest.mark.slow
def test_the_built_reference_has_every_public_name(html, reference):
    text = (html / "reference" / "python.html").read_text(encoding="utf-8")
    plain = re.sub(r"<[^>]+>", "", text)
    for line in reference.PUBLIC.read_text().split():
        assert re.search(rf"\b{line.rpartition('.')[2]}\b", plain), line


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
    for page in DOCS.glob("*.md"):
        shown = built[page.relative_to(DOCS).with_suffix("").as_posix()].blocks
        written = [block for block in all_blocks(page) if not block.language.startswith("{")]
        assert [text.strip() for _, text, _ in shown] == [block.text.strip() for block in written], page.name
