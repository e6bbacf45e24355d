"""Messages for mistakes in a configuration: all at once, each with location, allowed values and a suggestion."""

import pytest
from support.small_task import TASK

from rlcli.config.load import check_all, resolve
from rlcli.errors import ConfigError, DependencyError, pip_install

TYPOS = [
    ("decimatoin=2", "decimatoin: unknown key 'decimatoin'", "did you mean 'decimation'?"),
    ("decimation=-2", "decimation: expected a whole number >= 1, found -2", None),
    ("decimation=2.5", "decimation: expected a whole number, found 2.5", None),
    ("decimation=two", "decimation: expected a whole number, found 'two'", None),
    ("decimation=4/2", "decimation: expected a whole number, found '4/2'", None),
    ("sim=null", "sim: expected a mapping, found null", None),
    ("sim.dt=-0.01", "sim.dt: expected a number > 0, found -0.01", None),
    ("sim.dt=1", "sim.dt: expected a number <= 0.1, found 1", None),
    ("sim.dt=nan", "sim.dt: expected a number, found 'nan'", None),
    ("sim.dt=.nan", "sim.dt: .nan is not allowed", None),
    ("sim.dt=1/0", "sim.dt: expected a number, found '1/0'", None),
    ('sim.dt="0.01"', "sim.dt: expected a number, found '0.01'", "remove the quotes"),
    ("sim.dt=true", "sim.dt: expected a number, found true", None),
    (
        "sim.integrator=rk5",
        "sim.integrator: expected 'euler', 'rk4', 'implicit' or 'implicitfast'",
        "did you mean 'rk4'?",
    ),
    ("sim.gravity=[0, 0]", "sim.gravity: expected a list of 3 values, found [0, 0]", None),
    ("sim.gravity=[0, 0, 0, 0]", "sim.gravity: expected a list of 3 values, found [0, 0, 0, 0]", None),
    ("sim.gravity=down", "sim.gravity: expected a list, found 'down'", None),
    ("sim.gravity=[0, 0, down]", "sim.gravity.2: expected a number, found 'down'", None),
    ("sim.gravity=[0, 0, -1e20]", "sim.gravity.2: -1e+20 is out of range; allowed: -10000 to 10000", None),
    ("sim.iterations=2000000000", "sim.iterations: expected a whole number <= 100000, found 2000000000", None),
    ("decimation=100000000", "decimation: expected a whole number <= 10000, found 100000000", None),
    ("episode_length_s=0.001", "episode_length_s: 0.001 s is shorter than one step", None),
    ("scene.num_envs=0", "scene.num_envs: expected a whole number >= 1, found 0", None),
    ("scene.num_envs=99999999", "scene.num_envs: expected a whole number <= 16777216, found 99999999", None),
    ("scene.entities={}", "scene.entities: expected at least 1 item", None),
    ("scene.entities.robot.modle=x.xml", "unknown key 'modle'", "did you mean 'model'?"),
    ("scene.entities.robot.quat=[0, 0, 0, 0]", "scene.entities.robot.quat: a quaternion must not be zero", None),
    ("scene.entities.robot.joints.slider.dampning=1", "unknown key 'dampning'", "did you mean 'damping'?"),
    ("scene.entities.robot.joints.slider.damping=-1", "damping: expected a number >= 0, found -1", None),
    ("scene.entities.robot.joints.slider.range=[1, -1]", "range: the lower end 1 is above the upper end -1", None),
    ("scene.lights.dome.color=[0, 0, 2]", "scene.lights.dome.color.2: expected a number <= 1, found 2", None),
    ("viewer.width=1e3", "viewer.width: expected a whole number, found 1000.0", None),
    ("reward_dt_scaling=1", "reward_dt_scaling: expected true or false, found 1", None),
    ("summary=3", "summary: expected text, found 3", None),
    ("rewards=3", "rewards: expected a mapping, found 3", None),
    ("rewards.alive=3", "rewards.alive: expected a mapping, found 3", None),
    ("rewards.alive.wieght=2", "rewards.alive.wieght: unknown key 'wieght'", "did you mean 'weight'?"),
    ("rewards.alive.weight=heavy", "rewards.alive.weight: expected a number, found 'heavy'", None),
    (
        "rewards.aliv.weight=2",
        "rewards.aliv: there is no term 'aliv' to change",
        "did you mean 'alive'?; a new term needs",
    ),
    ("rewards.aliv=null", "rewards.aliv: there is no such term to remove", "did you mean 'alive'?"),
    (
        "rewards.alive.func=is_alife",
        "rewards.alive.func: there is no reward term 'is_alife'",
        "did you mean 'is_alive'?",
    ),
    ("rewards.alive.func=3", "rewards.alive.func: expected text, found 3", None),
    ("rewards.alive.func=reset_scene_to_default", "no reward term", "is a term of events"),
    ("rewards.new={func: is_alive}", "rewards.new: missing key 'weight'", None),
    ("rewards.new={weight: 1}", "rewards.new: missing key 'func'", "a new term needs 'func'"),
    ("rewards.near.tagret=1", "rewards.near.tagret: unknown key 'tagret'", "did you mean 'target'?"),
    ("rewards.near.target=far", "rewards.near.target: expected a number, found 'far'", None),
    ("rewards.near.joints=[1]", "rewards.near.joints.0: expected text, found 1", None),
    ("rewards.near.joints=[]", "rewards.near.joints: expected text or at least 1 item, found []", None),
    ("rewards.far={func: joint_pos_target_l2, weight: 1}", "rewards.far: missing key 'target'", None),
    ("terminations.far={func: joint_pos_out_of_manual_limit}", "terminations.far: missing key 'bounds'", None),
    ("observations.policy=null", "observations.policy: expected a mapping, found null", None),
    ("observations.policy.pos.clip=[1, 0]", "observations.policy.pos.clip: the lower end 1 is above", None),
    ("observations.policy.pos.scale=big", "expected a number or a list", None),
    ("terminations.time_out.time_out=1", "terminations.time_out.time_out: expected true or false, found 1", None),
    ("events.e={func: reset_scene_to_default, mode: rest}", "events.e.mode: expected", "did you mean 'reset'?"),
    (
        "events.e={func: reset_scene_to_default, mode: interval}",
        "events.e: interval_range_s and mode: interval need",
        None,
    ),
    ("params.x=1", "params: only direct tasks have params; remove this block", None),
    ("foreign.x.y=1", "foreign: a task file has no key 'foreign'", "write the framework's own key"),
    ("success={near: {func: joint_error, joints: [a], at_most: 1, hold_s: -1}}", "success.near.hold_s: expected", None),
    (
        "success={near: {func: joint_error, joints: [a], at_least: 2, at_most: 1}}",
        "success.near.at_least: at_least is 2 and above at_most, which is 1: no value meets both bounds",
        None,
    ),
    ("agent.gamma=2", "agents.one.gamma: expected a number <= 1, found 2", None),
    ("agent.gama=0.9", "agents.one.gama: unknown key 'gama'", "did you mean 'gamma'?"),
    ("agent.policy.hiden=[1]", "agents.one.policy.hiden: unknown key 'hiden'", "did you mean 'hidden'?"),
    ("agent.policy.activation=elo", "agents.one.policy.activation: expected", "did you mean 'elu'"),
    ("agent.trainer=sb4", "agents.one.trainer: no trainer 'sb4'", "did you mean 'sb3'?"),
    ("agent.trainer=3", "agents.one.trainer: expected text, found 3", None),
    ("agent.algorithm=pop", "agents.one.algorithm: trainer 'sb3' has no algorithm 'pop'", "did you mean 'ppo'?"),
    ("viewer.eye.0=1", "viewer.eye: expected a list, found a mapping", "give the whole list"),
    ("agents.default=tow", "agents.default: the task has no agent 'tow'", "did you mean 'two'?"),
    ("agents.default={gpu: one}", "agents.default.gpu: there is no device 'gpu'", "cpu, cuda"),
    ("agents=3", "agents: expected a mapping, found 3", None),
    ("agents.one=3", "agents.one: expected a mapping, found 3", None),
    ("agent.task=3", "agents.one.task: expected a mapping, found 3", None),
    ("agent.task.agents={}", "agents.one.task.agents: 'agents' belongs at the top level; remove it here", None),
    ("play=3", "play: expected a mapping, found 3", None),
    ("play.play={}", "play.play: 'play' belongs at the top level; remove it here", None),
    ("decimation.x=1", "'decimation' is a single value; leave out the keys after it", None),
    ("dt=1", "dt: unknown key 'dt'", "the key belongs in sim (sim.dt)"),
    ("num_envs=1", "num_envs: unknown key", "the key belongs in scene (scene.num_envs)"),
    ("gamma=1", "gamma: unknown key", "the key belongs in agent (agent.gamma)"),
    ("sim.decimation=1", "sim.decimation: unknown key", "the key belongs at the top level"),
    (
        "agent.eval_episodes=1000000000",
        "agents.one.eval_episodes: expected a whole number <= 1000000, found 1000000000",
        None,
    ),
    ("agent.num_envs=1", "agents.one.num_envs: unknown key", "the key belongs in scene (scene.num_envs)"),
    ("scene.entities.robot.kp=1", "unknown key 'kp'", "scene.entities.NAME.joints.NAME"),
]


@pytest.mark.parametrize(("override", "said", "hint"), TYPOS, ids=[t[0] for t in TYPOS])
def test_one_mistake_gives_one_message(problems_of, override, said, hint):
    (message,) = problems_of(TASK, override, play=True)
    assert message.startswith(f"override '{override}': ")
    assert said in message
    assert hint is None or hint in message


def test_all_problems_are_reported_with_location(problems_of, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text("viewer:\n  width: wide\nagent:\n  gamma: 2\n")
    text = TASK.replace("decimation: 2", "decimation: -2").replace(
        "alive: {func: is_alive, weight:", "alive: {func: is_alive, wieght:"
    )
    found = problems_of(
        text.replace(", decimation: 3", ""), "sim.dt=x", files={"terms": "def broken(:\n"}, config_file=config
    )
    places = [line.split(": ")[0].rsplit("/", 1)[-1] for line in found]
    assert sorted(places) == sorted(
        [
            "mine.yaml:2:3",
            "mine.yaml:4:3",
            "override 'sim.dt=x'",
            "task.yaml:15:3",
            "task.yaml:15:27",
            "task.yaml:2:1",
            "terms.py:1:12",
        ]
    )


def test_relation_of_keys_is_reported_at_their_mapping(problems_of):
    (message,) = problems_of(TASK, "agent.max_iterations=null")
    assert "task.yaml:22:3: agents.one: the training has no length: set max_iterations or max_steps" in message


def test_unknown_agent_does_not_hide_other_mistakes(problems_of):
    found = problems_of(TASK, "decimation=0", agent="on")
    assert any("no agent 'on'; did you mean 'one'" in line for line in found)
    assert any("decimation" in line for line in found)


def test_missing_trainer_plugin_gives_pip_command(task, monkeypatch):
    monkeypatch.setenv("RLCLI_PLUGINS", "rlcli")
    source = task(TASK.replace("two: {trainer: sb3", "two: {trainer: rsl-rl"))
    with pytest.raises(DependencyError) as caught:
        resolve(source, agent="two")
    assert "23:9" in caught.value.message
    assert caught.value.hint == pip_install("rlcli-rsl-rl")
    with pytest.raises(ConfigError, match="decimation"):
        resolve(source, agent="two", overrides=["decimation=0"])


def test_check_all_reports_all_agents_and_play_patch(task):
    text = TASK.replace("gamma: 0.9", "gamma: 9").replace(
        "play: {scene: {num_envs: 2}}", "play: {scene: {num_envs: -2}}"
    )
    with pytest.raises(ConfigError) as caught:
        check_all(task(text))
    assert [problem.path for problem in caught.value.problems] == ["scene.num_envs", "agents.two.gamma"]


def test_check_all_returns_unchecked_agents(task, monkeypatch):
    monkeypatch.setenv("RLCLI_PLUGINS", "rlcli")
    assert check_all(task(TASK.replace("two: {trainer: sb3", "two: {trainer: rsl-rl"))) == ["two"]
    assert check_all(task()) == []


@pytest.mark.parametrize(
    ("agents", "message", "hint"),
    [
        ("", "no agent to train", "agents:"),
        (
            "agents: {a: &, b: &}".replace("&", "{trainer: sb3, algorithm: ppo, max_steps: 1}"),
            "no default",
            "--agent a or b",
        ),
    ],
)
def test_require_agent_gives_hint(task, agents, message, hint):
    resolved = resolve(task(TASK.partition("agents:")[0] + agents + "\n"))
    with pytest.raises(ConfigError) as caught:
        resolved.require_agent()
    (problem,) = caught.value.problems
    assert message in problem.message
    assert hint in problem.hint


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        ("sim: {dt: 1/120}\n", "missing key 'sim' at the top level"),
        ("decimation: 2\n", "missing key 'decimation'"),
        ("rewards:\n", None),
    ],
)
def test_missing_section_is_reported(problems_of, missing, said):
    text = TASK.replace(", decimation: 3", "")
    if missing == "rewards:\n":
        text = text.replace(text[text.index("rewards:") : text.index("terminations:")], "")
        said = "rewards: a manager-based task needs at least one term"
    found = problems_of(text.replace(missing, ""))
    assert len(found) == 1
    assert said in found[0]


def test_fraction_is_number_only_for_number_keys(task):
    resolved = resolve(
        task(), overrides=["sim.dt=1/240", "summary=1/2", "rewards.near.target=-1/4", "viewer.eye=[1/8, 0, 0]"]
    )
    assert resolved.task.sim.dt == 1 / 240
    assert resolved.task.summary == "1/2"
    assert resolved.task.rewards["near"].params["target"] == -0.25
    assert resolved.task.viewer.eye[0] == 0.125


def test_unparsable_file_is_reported_with_position(problems_of):
    assert "task.yaml:2:1: duplicate key 'a'" in problems_of("a: 1\na: 2\n")[0]
