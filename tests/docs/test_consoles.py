"""The comparison of transcripts notices what it should, and nothing else."""

import pytest
from support.consoles import commands, difference

TABLE = "         MEAN    95 % INTERVAL\nsuccess  0.9950  0.9900 .. 0.9980\nlength   300\n"


@pytest.mark.parametrize(
    ("shown", "printed", "within"),
    [
        (TABLE, TABLE, 0.0),
        ("a   b\n", "a b\n", 0.0),
        ("run runs/...-calm\n", "run runs/2026-01-31_12-00-00-calm\n", 0.0),
        ("TASK ... STATUS\n", "TASK STATUS\n", 0.0),
        ("TASK ... STATUS\n", "TASK PLUGIN STATUS\n", 0.0),
        ("one\n...\nfour\n", "one\ntwo\nthree\nfour\n", 0.0),
        ("one\n...\ntwo\n", "one\ntwo\n", 0.0),
        ("...\n", "", 0.0),
        ("...\nlast\n", "last\nmore\nlast\n", 0.0),
        (TABLE, TABLE.replace("0.9950", "0.9860").replace("300", "297"), 0.02),
        ("1,966,080 steps\n", "1,966,081 steps\n", 1e-3),
        ("term -0.0449\n", "term -0.0352\n", 0.01),
        ("a\nb\n", "rlcli play: 0:10 so far\na\nrlcli play: episodes 0/16, 30%, 0:29 left\nb\n", 0.0),
    ],
)
def test_what_is_the_same_passes(shown, printed, within):
    assert difference(shown, printed, within) is None


@pytest.mark.parametrize(
    ("shown", "printed", "within"),
    [
        ("a\nb\n", "a\n", 0.0),
        ("a\n", "a\nb\n", 0.0),
        ("a\n", "", 0.0),
        ("", "a\n", 0.0),
        ("success 0.99\n", "success 0.98\n", 0.0),
        ("success 0.99\n", "success 0.95\n", 0.02),
        ("length 300\n", "length 290\n", 0.02),
        ("success 0.99\n", "success nan\n", 0.02),
        ("success 0.99\n", "failure 0.99\n", 0.02),
        ("one\n...\nfour\n", "one\ntwo\nthree\n", 0.0),
        ("a.b\n", "axb\n", 0.0),
        ("seed ... 42\n", "seed 1, agent 421\n", 0.0),
        ("a\n", "rlcli play: no run\na\n", 0.0),
    ],
)
def test_what_differs_is_told(shown, printed, within):
    assert difference(shown, printed, within)


def test_commands_are_what_stands_after_the_dollar_with_what_stands_below():
    text = "$ one --with \\\n    more\nprinted\nas well\n$ two\n$ three\n...\n"
    assert [(c.text, c.printed) for c in commands(text)] == [
        ("one --with \\\n    more", "printed\nas well\n"),
        ("two", ""),
        ("three", "...\n"),
    ]
