"""Translation of OmniIsaacGymEnvs' YAML."""

import pytest
import yaml
from reacher import TRAIN, YAML, arm_folder

from rlcli.config.load import resolve
from rlcli.errors import ConfigError, TaskError
from rlcli.registry import find_task


def resolved(folder, *overrides):
    return resolve(find_task(str(folder)), overrides=overrides)


def test_framework_settings_become_task_config_keys(tmp_path):
    task = resolved(arm_folder(tmp_path / "arm")).task
    assert (task.sim.dt, task.decimation, task.scene.num_envs, task.scene.env_spacing) == (0.01, 2, 4, 3.0)
    assert (task.max_episode_length, task.clip_actions, task.clip_observations) == (12, 1.0, 5.0)
    assert task.scene.ground is None
    assert task.foreign["oige"]["env"] == {"maxEffort": 2.0}
    assert task.foreign["oige"]["mjcf"] == {"Arm": {"model": "arm.xml"}}


def test_settings_of_the_environment_class_change_where_the_task_has_them(tmp_path):
    assert (
        resolved(arm_folder(tmp_path / "arm"), "oige.env.maxEffort=3.0").task.foreign["oige"]["env"]["maxEffort"] == 3.0
    )
    with pytest.raises(ConfigError, match=r"oige.nosuch: the task has no settings 'oige' of another framework"):
        resolve(find_task("cartpole"), overrides=["oige.nosuch=1"])


def test_agent_yaml_beside_task_becomes_ppo_agent(tmp_path):
    agent = resolved(arm_folder(tmp_path / "arm")).agent
    assert (agent.trainer, agent.dialect, agent.max_iterations) == ("ppo", "rl_games", 7)
    assert (agent.gamma, agent.lam, agent.num_steps, agent.minibatch_size, agent.num_epochs) == (0.98, 0.9, 8, 16, 3)
    assert (agent.value_coef, agent.reward_scale, agent.clip_range, agent.max_grad_norm) == (2.0, 0.1, 0.15, 0.5)
    assert (agent.desired_kl, agent.kl_grain, agent.clip_value, agent.bounds_coef) == (0.01, "epoch", None, 0.001)
    assert (agent.actor.hidden, agent.critic.hidden, agent.init_std) == ((32, 16), (32, 16), 1.0)
    assert agent.normalize_observations
    assert not agent.normalize_value


def leaves(data, at=()):
    for key, value in data.items():
        if isinstance(value, dict):
            yield from leaves(value, (*at, key))
        else:
            yield ".".join((*at, key))


def test_every_key_has_one_note_with_line(tmp_path):
    notes = resolved(arm_folder(tmp_path / "arm")).notes
    keys = [note.key for note in notes]
    assert len(keys) == len(set(keys))
    for leaf in (*leaves(yaml.safe_load(YAML)), *leaves(yaml.safe_load(TRAIN))):
        assert any(leaf == key or leaf.startswith(f"{key}.") for key in keys), leaf
    by_key = {note.key: note for note in notes}
    assert by_key["sim.physx.solver_type"].status == "ignored"
    assert by_key["sim.arm.enable_self_collisions"].status == "approximated"
    assert by_key["sim.ball.make_kinematic"].status == "mapped"
    assert by_key["env.maxEffort"].status == "task"
    line = YAML.splitlines().index("    solver_type: ${....solver_type}") + 1
    assert by_key["sim.physx.solver_type"].where.endswith(f"Arm.yaml:{line}:5")


@pytest.mark.parametrize(
    ("old", "new", "message", "hint"),
    [
        ("    solver_type:", "    solver_typo:", "unknown key 'solver_typo'", "did you mean 'solver_type'"),
        (
            "  add_ground_plane:",
            "  ad_ground_plane:",
            "unknown key 'ad_ground_plane'",
            "did you mean 'add_ground_plane'",
        ),
        ("    make_kinematic:", "    make_kinetic:", "unknown key 'make_kinetic'", "did you mean 'make_kinematic'"),
        ("physics_engine:", "physic_engine:", "unknown key 'physic_engine'", "did you mean 'physics_engine'"),
        ("${...num_envs}", "${...numenvs}", "has no 'numenvs'", "did you mean 'num_envs'"),
        ("  /World/envs/.*/Arm: arm.xml", "  Arm: {file: arm.xml}", "expected an MJCF file", None),
        ("controlFrequencyInv: 2", "controlFrequencyInv: 0.5", "expected a whole number >= 1, found 0.5", None),
    ],
)
def test_wrong_task_key_error_has_line(tmp_path, old, new, message, hint):
    folder = arm_folder(tmp_path / "arm", yaml=YAML.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        resolved(folder)
    problem = next(p for p in caught.value.problems if message in p.message)
    assert f"Arm.yaml:{1 + next(n for n, line in enumerate(YAML.splitlines()) if old in line)}:" in problem.where
    assert hint is None or hint in (problem.hint or "")


def test_wrong_agent_key_error_has_line(tmp_path):
    folder = arm_folder(tmp_path / "arm", train=TRAIN.replace("e_clip", "eclip"))
    with pytest.raises(ConfigError, match=r"ArmPPO\.yaml:\d+:5: params\.config\.eclip: unknown key 'eclip'"):
        resolved(folder)


def test_moved_key_is_refused_in_oige_block(tmp_path):
    with pytest.raises(ConfigError, match=r"oige\.env\.numEnvs.*write scene\.num_envs"):
        resolved(arm_folder(tmp_path / "arm"), "oige.env.numEnvs=3")


def test_class_is_found_by_task_name(tmp_path):
    folder = arm_folder(tmp_path / "arm")
    assert find_task(str(folder)).task.endswith("arm.py:ArmTask")
    assert find_task(str(folder / "Arm.yaml")).task.endswith("arm.py:ArmTask")
    (folder / "arm.py").write_text("class Other:\n    pass\n")
    with pytest.raises(TaskError, match="no task class in any Python file of the folder; name the class 'ArmTask'"):
        find_task(str(folder))


def test_episode_length_is_read_from_class_source(tmp_path):
    folder = arm_folder(tmp_path / "arm", yaml=YAML.replace("  maxEpisodeLength: 12\n", ""))
    source = (folder / "arm.py").read_text()
    (folder / "arm.py").write_text(source.replace('self._task_cfg["env"]["maxEpisodeLength"]', "30"))
    assert resolved(folder).task.max_episode_length == 30
