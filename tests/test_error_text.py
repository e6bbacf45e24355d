"""Texts of errors."""

import pytest

from rlcli.errors import error_text, one_line, short_error


@pytest.mark.parametrize("failure", [RuntimeError("in str"), SystemExit(0), None], ids=["raises", "exits", "no text"])
def test_text_of_an_error_without_text(failure):
    class Textless(Exception):
        def __str__(self):
            if failure is not None:
                raise failure
            return 5

    assert "the error's message cannot be read" in error_text(Textless())
    assert "the error's message cannot be read" in one_line(Textless())


def test_long_text_of_an_error_is_cut_before_it_is_split():
    error = RuntimeError("x y " * 1_000_000)
    assert error_text(error) == "x y " * 5_000
    assert len(one_line(error)) < 20_000
    assert short_error(error) == ("RuntimeError: " + "x y " * 50)[:197] + "..."
