"""The page docs/reference/isaac-lab-terms.md: every term that it lists exists."""

import re
from pathlib import Path

import pytest

import rlcli
from rlcli.config.term_signatures import SECTIONS, builtin_terms

PAGE = Path(rlcli.__path__[0]).parent / "docs" / "reference" / "isaac-lab-terms.md"
ROW = re.compile(r"^\| `([^`]+)` \| (same|similar|not possible|not offered|`[a-z0-9_]+`) \| (.*) \|$")


def tables():
    """Return section -> [(Isaac Lab's name, counterpart, remark)]."""
    found, section = {}, None
    for line in PAGE.read_text().splitlines():
        if line.startswith("## "):
            section = None
        elif re.fullmatch(r"`[a-z]+:`", line):
            section = line.strip("`:")
            found[section] = []
        elif section and line.startswith("| `"):
            match = ROW.match(line)
            assert match, line
            found[section].append(match.groups())
    return found


def test_page_has_every_section():
    assert set(tables()) == set(SECTIONS) - {"success"}
    assert sum(map(len, tables().values())) > 180


RANDOMIZATION = Path(rlcli.__path__[0]) / "mdp" / "randomization"
"""Package of about half of the events."""
HERE = sorted(set(SECTIONS) - {"success"} - (set() if RANDOMIZATION.exists() else {"events"}))


@pytest.mark.parametrize("section", HERE)
def test_listed_counterparts_exist(section):
    terms, rows = builtin_terms(section), tables()[section]
    names = [name for name, _, _ in rows]
    assert len(set(names)) == len(names)
    for name, here, remark in rows:
        if here in ("not possible", "not offered"):
            assert remark, f"{name}: why?"
            assert name not in terms
        else:
            assert (name if here in ("same", "similar") else here.strip("`")) in terms, name
            assert here != "similar" or remark, f"{name}: how does it differ?"
