"""Transcripts of a shell in a page: commands after `$`, and below them the expected output.

`...` alone on a line stands for any lines, within a line for any text. Runs of spaces count as one. Numbers are equal,
or as near as the page allows: `within` is relative to the larger of 1 and the number that is shown. Lines of progress,
which a command prints every ten seconds on a slow machine, are ignored.
"""

import re
from dataclasses import dataclass

_NUMBER = re.compile(r"(?<![\w.])-?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")
_PROGRESS = re.compile(r"rlcli [a-z-]+: .*(so far|left)")


@dataclass(frozen=True)
class Command:
    text: str
    printed: str


def commands(transcript):
    """Return the commands of a transcript with their output; a line that ends in a backslash continues."""
    found = []
    for part in re.split(r"^\$ ", transcript, flags=re.MULTILINE)[1:]:
        typed, _, printed = re.match(r"((?:[^\n]*\\\n)*[^\n]*)(\n?)(.*)", part, re.DOTALL).groups()
        found.append(Command(typed, printed))
    return found


def difference(shown, printed, within=0.0):
    """Return None if `printed` equals the output in the page, otherwise the difference."""
    wanted = [_plain(line) for line in shown.splitlines() if line.strip()]
    given = [_plain(line) for line in printed.splitlines() if line.strip() and not _PROGRESS.fullmatch(line)]
    reached = {0}  # possible numbers of printed lines that match the page's lines so far
    for line in wanted:
        if line == "...":
            reached = set(range(min(reached), len(given) + 1))
            continue
        following = {at + 1 for at in reached if at < len(given) and _alike(line, given[at], within)}
        if not following:
            return f"the page shows\n  {line}\nwhere this is printed:\n  " + "\n  ".join(given[min(reached) :][:12])
        reached = following
    return None if len(given) in reached else "printed and not shown:\n  " + "\n  ".join(given[max(reached) :][:12])


def _plain(line):
    return re.sub(r"\s+", " ", line).strip()


def _alike(shown, given, within):
    pattern, numbers, end = "", [], 0
    for match in re.finditer(rf" ?\.\.\. ?|{_NUMBER.pattern}", shown):
        pattern += re.escape(shown[end : match.start()])
        end = match.end()
        if "..." in match[0]:
            pattern += ".*"
        elif within:
            numbers.append(match[0])
            pattern += f"({_NUMBER.pattern})"
        else:
            pattern += re.escape(match[0])
    found = re.fullmatch(pattern + re.escape(shown[end:]), given)
    return found is not None and all(map(_near, numbers, found.groups(), [within] * len(numbers)))


def _near(shown, given, within):
    a, b = (float(number.replace(",", "")) for number in (shown, given))
    return abs(a - b) <= within * max(1.0, abs(a))
