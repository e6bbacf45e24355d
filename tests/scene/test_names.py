"""Names and regular expressions of a configuration."""

import pytest

from rlcli.scene.names import NameProblem, match

NAMES = ["FL_hip", "FR_hip", "left_wheel", "h" * 60]


@pytest.mark.parametrize(
    ("pattern", "found"),
    [
        ("FL_hip", [0]),
        (".*_hip", [0, 1]),
        ("(?!.*wheel).*hip.*", [0, 1]),
        ("(?:FL|FR)?_?.*hip", [0, 1]),
        ("^(?!left_wheel$)(?!h+$).*$", [0, 1]),
        ("FL.*|FR.*|left.*|a.*|b.*|c.*|d.*|e.*|f.*", [0, 1, 2]),
        ("(?P<side>F.)_[hip*+]+", [0, 1]),
        ("h{60}", [3]),
    ],
)
def test_pattern_matches_names_in_full(pattern, found):
    assert match(pattern, NAMES, "joint") == found


@pytest.mark.parametrize(
    ("pattern", "said"),
    [
        ("(h+)+x", "repeats a group that itself contains"),
        ("(.?){300}x", "repeats a group that itself contains"),
        ("(h|h)*x", "repeats a group that itself contains"),
        ("((h?)h?)*x", "repeats a group that itself contains"),
        (".*" * 9 + "x", "has 9 of the quantifiers"),
        ("h?" * 60 + "h" * 60 + "x", "has 60 of the quantifiers"),
        ("h" * 1001, "1,001 characters"),
        ("h{99999999999999999999}", "repetition number is too large"),
        ("[[h]ip", "neither the name of a joint nor a regular expression"),
        ("(h", "neither the name of a joint nor a regular expression"),
        ("left", "no joint matches"),
    ],
)
def test_costly_or_malformed_pattern_is_refused_at_once(pattern, said, recwarn):
    with pytest.raises(NameProblem, match=said):
        match(pattern, NAMES, "joint")
    assert not recwarn
