"""Checks of the results of the whole task lists: the messages, and the summary on the page and in the README."""

import re

from corpus import summary
from support.fenced import REPOSITORY
from support.task_lists import faulty_messages

PAGE = REPOSITORY / "docs" / "reference" / "isaac-lab-tasks.md"


def test_summary_of_the_page_and_figures_of_the_readme_equal_the_table_of_tasks():
    text = PAGE.read_text(encoding="utf-8")
    table = summary(re.findall(r"^\| `Isaac-.*", text, re.MULTILINE))
    assert "\n".join(["<!-- summary -->", *table, "<!-- end of summary -->"]) in text
    (tasks, agents, _, _, steps, trains), (direct, _, _, _, _, direct_trains) = (
        re.findall(r"\d+", row) for row in table[2:]
    )
    readme = " ".join((REPOSITORY / "README.md").read_text(encoding="utf-8").split())
    assert f"{steps} of Isaac Lab's {tasks} manager-based tasks step" in readme
    assert f"{trains} of the {agents} with an agent train" in readme
    assert f"so do {direct_trains} of its [{direct} direct tasks]" in readme


def test_messages_without_a_place_in_the_task_are_faulty():
    good = {
        "own": "ConfigError: a/env_cfg.py:3: rewards.x: unknown || b/agent.yaml:9: agent: missing",
        "log": "RuntimeError: rlcli train ended with 2: epochs error: a/env.py:3: cannot be used",
        "missing": "ModuleNotFoundError: No module named 'robots' [env_cfg.py:3]",
        "plain": "a/env.py:3: no counterpart",
        "none": "",
    }
    bad = {
        "python": "AttributeError: 'NoneType' object has no attribute 'x' [env.py:3]",
        "no place": "TaskError: a camera has no normals",
        "library": "TaskError: /venv/site-packages/warp/__init__.py:37: no counterpart",
        "second": "ConfigError: a/env_cfg.py:3: rewards.x: unknown || agent: missing",
    }
    assert faulty_messages(good) == []
    assert [message.partition(":")[0] for message in faulty_messages(bad)] == sorted(bad)
