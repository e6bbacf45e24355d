"""Check of the messages in the results of the whole task lists, which `corpus.py` and `all_tasks.py` print."""

from support.task_lists import faulty_messages


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
