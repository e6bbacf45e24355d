"""British spelling in pages, docstrings and comments. Names of public keys and of libraries keep their spelling."""

import io
import re
import tokenize

import pytest
from support.fenced import REPOSITORY as ROOT

_STEMS = (
    *("behavior", "color", "center", "neighbor", "favor", "analyz", "modeled", "labeled", "traveled"),
    *("normaliz", "randomiz", "optimiz", "initializ", "synchroniz", "recogniz", "vectoriz", "generaliz", "visualiz"),
    *("stabiliz", "regulariz", "standardiz", "summariz", "penaliz", "lineariz", "minimiz", "maximiz", "finaliz"),
)
AMERICAN = re.compile(rf"(?<![\w.@/[-])(?:[a-z]*(?:{'|'.join(_STEMS)})[a-z]*|meters?)(?![\w:=(/-]|\.\w)", re.IGNORECASE)
_CODE = re.compile(r"```.*?```|~~~.*?~~~|<!--.*?-->|`[^`]*`|\]\([^)]*\)", re.DOTALL)


def prose_of(file):
    """The text of a page without its code and headings, or the comments and docstrings of a module."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".md":
        return re.sub("^#.*", "", _CODE.sub("", text), flags=re.MULTILINE)
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    parts = [t.string for t in tokens if t.type == tokenize.COMMENT or t.string.startswith('"""')]
    return _CODE.sub("", "\n".join(parts))


@pytest.mark.parametrize("word", ["normalized", "Color", "meters", "randomization", "unnormalized"])
def test_american_words_are_found_in_prose_and_not_in_names(word):
    assert AMERICAN.findall(f"the {word} value") == [word]
    assert not AMERICAN.findall(f"actor_{word}, {word}: 1, rlcli.{word}, {word}(x), parameters")


def test_prose_has_one_spelling():
    folders = ("rlcli", "plugins", "docs", "tasks", "benchmarks")
    files = [file for folder in folders for kind in ("*.py", "*.md") for file in (ROOT / folder).rglob(kind)]
    files = [file for file in (*files, *ROOT.glob("*.md")) if not {"_build", "tests"} & set(file.parts)]
    found = {str(file.relative_to(ROOT)): words for file in files if (words := AMERICAN.findall(prose_of(file)))}
    assert not found
