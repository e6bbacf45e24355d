"""Texts of errors."""

import pytest

from rlcli.errors import error_text, one_line


@pytest.mark.parametrize("failure", [RuntimeError("in str"), SystemExit(0), None], ids=["raises", "exits", "no text"])
def test_text_of_an_error_without_text(failure):
    class Textless(Exception):
        def __str__(self):
            if failure is not None:
                raise failure
            return 5

    assert "its message cannot be read" in error_text(Textless())
    assert "its message cannot be read" in one_line(Textless())
