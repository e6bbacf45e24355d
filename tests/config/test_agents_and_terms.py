"""Choice of the agent, changes of the agent, and sections that a task must have."""

import pytest
from support.small_task import TASK

from rlcli.config.load import agent_names, check_all, extensions, resolve, term_entries
from rlcli.errors import ConfigError, TaskError

AGENT = "{trainer: sb3, algorithm: ppo, max_iterations: 3}"
HEAD = TASK.partition("agents:")[0]


def with_agents(text):
    return f"{HEAD}agents: {text}\n"


SEVERAL = with_agents(f"{{a: {AGENT}, b: {AGENT}}}")
BY_DEVICE = with_agents(f"{{default: {{cpu: a, cuda: b}}, a: {AGENT}, b: {AGENT}}}")


@pytest.mark.parametrize(
    ("text", "options", "name"),
    [
        (TASK, {}, "one"),
        (TASK, {"agent": "two"}, "two"),
        (TASK, {"overrides": ["agents.default=two"]}, "two"),
        (TASK, {"agent": "one", "overrides": ["agents.default=two"]}, "one"),
        (with_agents(f"{{only: {AGENT}}}"), {}, "only"),
        (SEVERAL, {}, None),
        (HEAD, {}, None),
        (BY_DEVICE, {}, "a"),
        (BY_DEVICE, {"device": "cuda"}, "b"),
        (BY_DEVICE, {"device": "cuda:1"}, "b"),
        (with_agents(f"{{default: {{cpu: a}}, a: {AGENT}, b: {AGENT}}}"), {"device": "cuda"}, "a"),
        (with_agents(f"{{default: {{cuda: b}}, a: {AGENT}, b: {AGENT}}}"), {"device": "cpu"}, None),
    ],
)
def test_agent_choice_by_name_default_or_device(task, text, options, name):
    resolved = resolve(task(text), **options)
    assert resolved.agent_name == name
    assert (resolved.agent is None) == (name is None)
    assert (resolved.trainer is None) == (name is None)
    if name is not None:
        resolved.require_agent()


def test_agent_names_exclude_default(task):
    assert agent_names(resolve(task()).layers) == ["one", "two"]
    assert agent_names(resolve(task(HEAD)).layers) == []


@pytest.mark.parametrize(
    ("text", "overrides", "said"),
    [
        (HEAD, ["agent.gamma=1"], ["override 'agent.gamma=1': agent: this task has no agents"]),
        (
            HEAD,
            ["agent.gamma=1", "agent.lam=1", "decimation=0"],
            [
                "override 'agent.gamma=1': agent: this task has no agents",
                "override 'agent.lam=1': agent: this task has no agents",
                "override 'decimation=0': decimation: expected a whole number >= 1, found 0",
            ],
        ),
        (
            SEVERAL,
            ["agent.gamma=1"],
            ["override 'agent.gamma=1': agent: the task has several agents and no default; name one: --agent a or b"],
        ),
        (
            TASK,
            ["rewards.aliv=null", "rewards.nea=null", "decimation=0"],
            [
                "override 'decimation=0': decimation: expected a whole number >= 1, found 0",
                "override 'rewards.aliv=null': rewards.aliv: there is no such term to remove; did you mean 'alive'?",
                "override 'rewards.nea=null': rewards.nea: there is no such term to remove; did you mean 'near'?",
            ],
        ),
        (
            TASK,
            ["decimation.x=1", "summary.x=1"],
            [
                "override 'decimation.x=1': decimation.x: 'decimation' is a single value; leave out the keys after it",
                "override 'summary.x=1': summary.x: 'summary' is a single value; leave out the keys after it",
            ],
        ),
        (
            with_agents(f"{{default: {{gpu: a, tpu: a}}, a: {AGENT}}}"),
            [],
            [
                "agents.default.gpu: there is no device 'gpu'; write one of cpu, cuda",
                "agents.default.tpu: there is no device 'tpu'; write one of cpu, cuda",
            ],
        ),
        (
            with_agents(f"{{default: {{cpu: c}}, a: {AGENT}}}"),
            [],
            ["agents.default.cpu: the task has no agent 'c'; agents of this task: a"],
        ),
    ],
)
def test_agent_mistakes_are_reported_once_with_all_others(problems_of, text, overrides, said):
    found = problems_of(text, *overrides)
    assert len(found) == len(said)
    for line, expected in zip(sorted(found), sorted(said), strict=True):
        assert line.endswith(expected) or expected in line


def test_null_override_of_missing_term_is_ignored(task):
    resolved = resolve(task(), overrides=["rewards.near=null", "rewards.zzzzzz=null"])
    assert set(resolved.task.rewards) == {"alive"}


def test_config_file_changes_chosen_agent_and_patches(task, tmp_path, problems_of):
    config = tmp_path / "mine.yaml"
    config.write_text("agent: {gamma: 0.5}\nagents: {two: {gae_lambda: 0.25}}\nplay: {decimation: 7}\n")
    resolved = resolve(task(), agent="two", config_file=config, play=True)
    assert (resolved.agent.gamma, resolved.agent.gae_lambda, resolved.task.decimation) == (0.5, 0.25, 7)
    assert resolve(task(), config_file=config).task.decimation == 3
    for content, text, said in (
        ("agent: 3\n", TASK, "mine.yaml:1:1: agent: expected a mapping, found 3"),
        ("agent: {gamma: 1}\n", HEAD, "mine.yaml:1:1: agent: this task has no agents"),
        ("agent: {gamma: 1}\n", SEVERAL, "mine.yaml:1:1: agent: the task has several agents and no default"),
    ):
        config.write_text(content)
        (message,) = problems_of(text, config_file=config)
        assert said in message


def test_problem_of_flag_shows_flag_name(problems_of):
    (message,) = problems_of(TASK, flags={"scene.num_envs": 0})
    assert message.startswith("--num-envs: scene.num_envs: expected a whole number >= 1")


def test_malformed_overrides_are_all_reported(problems_of):
    found = problems_of(TASK, "decimation", "sim.dt=[", "scene.num_envs=0")
    assert len(found) == 3
    assert "an override has the form KEY.PATH=VALUE" in found[0]


# --- what a task must have ---


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("  push: {func: joint_effort, joints: [slider], scale: 2.0}\n", "  push: null\n", "actions: a manager-based"),
        (
            "  policy:\n    pos: {func: joint_pos_rel}\n",
            "  critic:\n    pos: {func: joint_pos_rel}\n",
            "observations: the observations need a group",
        ),
        (
            "    pos: {func: joint_pos_rel}\n",
            "    pos: null\n",
            "observations: the observations need a group 'policy' with at least one",
        ),
        ("observations:\n  policy:\n    pos: {func: joint_pos_rel}\n", "", "the observations need a group 'policy'"),
    ],
)
def test_manager_based_task_requires_sections(problems_of, old, new, said):
    assert old in TASK
    found = problems_of(TASK.replace(old, new))
    assert any(said in line for line in found), found


@pytest.mark.parametrize(
    ("override", "said", "hint"),
    [
        ("success={near: {func: is_alive}}", "no success term 'is_alive'", "'is_alive' is a term of rewards"),
        ("success={func: joint_error}", "success: a term needs a name", "success: {NAME: {func: joint_error, ...}}"),
        ("rewards.alive.func=time_oot", "no reward term 'time_oot'", "terms: "),
        ("rewards.alive.func=is_aliv", "no reward term 'is_aliv'", "did you mean 'is_alive'?"),
        (
            "rewards.alive.func=joint_pos_limit",
            "no reward term 'joint_pos_limit'",
            "did you mean 'joint_pos_limits' or",
        ),
        ("rewards.alive.func=bad_orientation", "no reward term", "'bad_orientation' is a term of terminations"),
        ("terminations.time_out.func=is_terminated", "no termination term 'is_terminated'", "is a term of rewards"),
    ],
)
def test_unknown_term_suggests_name_or_section(problems_of, override, said, hint):
    (message,) = problems_of(TASK, override)
    assert said in message
    assert hint in message


def test_term_entries_returns_section_and_path():
    data = {
        "success": {"near": {"func": "s"}},
        "rewards": {"a": {"func": "r"}, "b": 3, "c": None},
        "observations": {"policy": {"p": {"func": "o"}, "q": 1}, "critic": 5},
        "actions": 7,
    }
    found = {(section, path) for section, path, _ in term_entries(data)}
    assert found == {
        ("success", ("success", "near")),
        ("rewards", ("rewards", "a")),
        ("observations", ("observations", "policy", "p")),
    }


def test_removed_term_keeps_order_of_others(task):
    text = TASK.replace("rewards:\n", "rewards:\n  gone: null\n")
    resolved = resolve(task(text), overrides=["observations.policy.vel={func: joint_vel_rel}", "rewards.alive=null"])
    assert list(resolved.task.rewards) == ["near"]
    assert list(resolved.task.observations["policy"].terms) == ["pos", "vel"]
    assert resolved.task.rewards["near"].params == {"entity": "robot", "joints": ["slider"], "target": 0.0}
    assert resolved.task.success == {}


OWN = """
    def mine(env, *, gain: float = 1.0):
        return env.ones * gain
"""


def test_own_terms_are_checked_by_signature(task, problems_of):
    text = TASK.replace("{func: is_alive, weight: 1.0}", "{func: mine, weight: 1.0, gain: 3}")
    assert resolve(task(text, terms=OWN)).task.rewards["alive"].params == {"gain": 3.0}
    (message,) = problems_of(text.replace("gain: 3", "gian: 3"), files={"terms": OWN})
    assert "rewards.alive.gian: unknown key 'gian'" in message
    vocabulary, params = extensions(task(text, terms=OWN))
    assert vocabulary.find("rewards", "mine") is not None
    assert params is None
    with pytest.raises(ConfigError, match=r"terms\.py:1:\d+: not valid Python"):
        extensions(task(text, terms="def broken(:\n"))
    (message,) = problems_of(text, files={"terms": "def broken(:\n"})[-1:]
    assert "terms.py" in message


PLAIN = """
    from pydantic import BaseModel

    from rlcli.envs.direct import DirectTask


    class Task(DirectTask):
        num_observations = 1
        num_actions = 1
"""
PARAMS = (
    PLAIN
    + """
        class Params(BaseModel):
            gain: float = 2.0
            steps: int
"""
)
DIRECT = HEAD.partition("actions:")[0]


def test_direct_params_are_checked_against_class(task, problems_of):
    given = f"{DIRECT}params: {{steps: 3}}\n"
    assert resolve(task(given, task=PARAMS)).task.params == {"gain": 2.0, "steps": 3}
    assert extensions(task(given, task=PARAMS))[1] is not None
    (message,) = problems_of(f"{DIRECT}params: {{steps: x}}\n", files={"task": PARAMS})
    assert "params.steps: expected a whole number, found 'x'" in message
    (message,) = problems_of(DIRECT, files={"task": PARAMS})
    assert "missing key 'steps'" in message


def test_direct_task_refuses_terms_and_undeclared_params(task, problems_of):
    assert resolve(task(DIRECT, task=PLAIN)).task.params == {}
    (message,) = problems_of(f"{DIRECT}params: {{x: 1}}\n", files={"task": PLAIN})
    assert "params: the task's class has no Params; remove this block" in message
    (message,) = problems_of(f"{DIRECT}rewards: {{a: {{func: is_alive, weight: 1}}}}\n", files={"task": PLAIN})
    assert "rewards: a direct task has no rewards terms; its class implements them" in message


def test_check_all_covers_every_agent_and_play(task):
    text = SEVERAL.replace("play: {scene: {num_envs: 2}}", "play: {decimation: -1}")
    with pytest.raises(ConfigError) as caught:
        check_all(task(text))
    assert {problem.path for problem in caught.value.problems} == {"decimation"}
    assert check_all(task(HEAD)) == []
    with pytest.raises(ConfigError, match="scene"):
        check_all(task(), overrides=["scene.num_envs=0"])


def test_agent_patch_is_applied_before_play_patch(task):
    text = TASK.replace("play: {scene: {num_envs: 2}}", "play: {decimation: 9}")
    assert resolve(task(text)).task.decimation == 3
    assert resolve(task(text), play=True).task.decimation == 9
    assert resolve(task(text), agent="two").task.decimation == 2
    place = resolve(task(text), play=True).layers.origin(("decimation",))
    assert place.layer == "play"
    assert resolve(task(text), overrides=["agent.task.decimation=5"]).task.decimation == 5
    assert resolve(task(text), play=True, overrides=["play.decimation=6"]).task.decimation == 6


def test_ambiguous_trainer_is_not_reported_as_missing(task, monkeypatch):
    from rlcli.config import validation

    def two(*_, **__):
        raise TaskError("two plugins have a trainer 'ppo'", hint="name one")

    monkeypatch.setattr(validation, "find_entry", two)
    with pytest.raises(ConfigError, match=r"agents\.one\.trainer: two plugins have a trainer 'ppo'; name one"):
        resolve(task(TASK.replace("one: {trainer: sb3", "one: {trainer: ppo")))


def test_trainer_with_newer_api_is_refused(task, monkeypatch):
    from dataclasses import replace

    from rlcli.registry import plugin_imports

    real, newer = plugin_imports.load_entry, plugin_imports.API_VERSION + 1
    monkeypatch.setattr(plugin_imports, "load_entry", lambda entry, kind: replace(real(entry, kind), api=newer))
    with pytest.raises(TaskError, match=rf"needs plugin API {newer}; this rlcli has {plugin_imports.API_VERSION}"):
        resolve(task())
