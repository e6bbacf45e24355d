"""Settings and values of Isaac Lab's tasks that must have an effect or a message: logged extras, gravity, markers."""

import dataclasses
import json
import logging

import pytest
import torch
from test_isaaclab_user_code import rover
from test_unchanged_isaaclab_files import DIRECT

from rlcli.config.dump import to_data, to_yaml
from rlcli.config.load import resolve
from rlcli.config.model_option import read_models
from rlcli.envs.make import make_env
from rlcli.errors import TaskError
from rlcli.evaluation.evaluate import evaluate
from rlcli.registry import find_task
from rlcli.registry.task_location import task_reference
from rlcli.testing.checks import check_task
from rlcli_isaaclab.missing_names import report_once

torch.set_num_threads(1)
RESET = "        super()._reset_idx(env_ids)\n"


@pytest.fixture
def pole(tmp_path):
    """Return a function that writes the direct task with replaced parts of its text, and resolves it."""
    report_once.cache_clear()

    def make(*changes):
        text = DIRECT
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "pole").mkdir(exist_ok=True)
        (tmp_path / "pole/pole_env.py").write_text(text)
        (tmp_path / "pole/models.yaml").write_text("pole.usd: cartpole:cartpole.xml\n")
        return resolve(find_task(f"{tmp_path / 'pole/pole_env.py'}:PoleEnvCfg"))

    return make


LOG = RESET + (
    '        self.extras["log"] = dict()\n'
    "        steps = self.episode_length_buf[env_ids].float().mean()\n"
    '        self.extras["log"].update({"Metrics/steps": steps, "ended": 1})\n'
)


def run(env, steps):
    env.reset()
    for _ in range(steps):
        env.step(torch.ones(env.num_envs, 1))


def test_values_that_a_direct_task_logs_in_a_reset_are_metrics(pole):
    env = make_env(pole((RESET, LOG)), seed=0)
    run(env, 8)
    assert env.extras()["Metrics/steps"] == 0.0  # of the first reset
    run(env, 8)
    env.extras()
    for _ in range(2):
        env.step(torch.ones(4, 1))
    found = env.extras()
    assert found["Metrics/steps"] > 0.0
    assert found["Episode/ended"] == 1.0  # the name that RSL-RL gives a value without a group


def test_evaluation_reports_the_values_that_the_reset_after_each_episode_logs(pole):
    env = make_env(pole((RESET, LOG)), seed=0)
    result = evaluate(env, lambda obs: torch.ones(len(obs), 1), 8)
    assert result.values["Metrics/steps"] == [float(length) for length in result.lengths]


def test_values_that_a_direct_task_logs_in_a_step_are_means_over_steps(pole):
    line = '        self.extras["log"] = {"Step/number": self.observed.clone()}\n        velocity ='
    env = make_env(pole(("        velocity =", line)), seed=0)
    result = evaluate(env, lambda obs: torch.ones(len(obs), 1), 4)
    assert result.values["Step/number"] == [pytest.approx(5.0)] * 4  # 1 to 9
    env.extras()
    env.step(torch.ones(4, 1))
    assert env.extras()["Step/number"] > 5.0


def test_other_extras_are_reported_once(pole, caplog):
    line = (
        '        self.extras["plain"] = torch.zeros(2)\n'
        '        self.extras["log"] = {"text": "a", "Train/mean_reward": 5.0}\n        velocity ='
    )
    env = make_env(pole(("        velocity =", line)), seed=0)
    with caplog.at_level(logging.WARNING):
        run(env, 3)
    messages = [record.getMessage() for record in caplog.records]
    assert "env.extras['plain'] is ignored: only the numbers in env.extras['log'] are logged" in messages
    assert "env.extras['log']['Episode/text'] is ignored: expected a number or a tensor, found a str" in messages
    assert "env.extras['log']['Train/mean_reward'] is ignored: rlcli computes a metric of this name" in messages
    assert len(messages) == len(set(messages)) == 3


def test_values_that_terms_of_a_manager_based_task_log_are_metrics(tmp_path):
    code = """
def logged(env):
    env.extras["log"]["Metrics/two"] = 2.0
    return torch.ones(env.num_envs)

def at_reset(env, env_ids):
    env.extras["log"].update({"Metrics/ended": float(len(env_ids))})
"""
    terms = {"rewards": {"own": "RewardTermCfg(func=logged, weight=1.0)"}}
    terms["events"] = {"note": "EventTermCfg(func=at_reset, mode='reset')"}
    env = make_env(rover(tmp_path / "rover", code, **terms), seed=0)
    env.reset()
    env.step(torch.zeros(env.num_envs, env.layout.action_size))
    found = env.extras()
    assert (found["Metrics/two"], found["Metrics/ended"]) == (2.0, 4.0)
    result = evaluate(env, lambda obs: torch.zeros(len(obs), env.layout.action_size), 4)
    assert result.values["Metrics/two"] == [2.0] * 4
    assert result.values["Metrics/ended"] == [4.0] * 4


PROPERTIES = (
    'usd_path="omniverse://somewhere/pole.usd", rigid_props=sim_utils.RigidBodyPropertiesCfg('
    "disable_gravity=True, linear_damping=0.0, angular_damping=0.5, max_linear_velocity=9.0), "
    "articulation_props=sim_utils.ArticulationRootPropertiesCfg(fix_root_link=True, enabled_self_collisions=False)"
)


def test_disable_gravity_of_a_direct_task_acts_and_other_properties_are_reported_by_key(pole):
    resolved = pole(('usd_path="omniverse://somewhere/pole.usd"', PROPERTIES), ("dt=0.01", "dt=0.01, use_fabric=True"))
    assert not resolved.task.scene.entities["robot"].gravity
    env = make_env(resolved, seed=0)
    assert env.engine.model.body_gravcomp.tolist()[1:] == [1.0] * (env.engine.model.nbody - 1)
    notes = {note.key: note.text for note in resolved.notes if note.status == "ignored"}
    start = "scene.robot.spawn"
    assert {key for key in notes if "_props" in key} == {
        f"{start}.rigid_props.angular_damping",
        f"{start}.rigid_props.max_linear_velocity",
        f"{start}.articulation_props.enabled_self_collisions",
    }
    assert all(notes.values())


def test_settings_of_a_urdf_conversion_are_reported_with_reasons(tmp_path):
    spawn = 'spawn=sim_utils.UsdFileCfg(usd_path="omniverse://somewhere/rover.usd"'
    urdf = 'spawn=sim_utils.UrdfFileCfg(asset_path="somewhere/rover.urdf", fix_base=%s, merge_fixed_joints=True'
    reasons = []
    for fixed in (True, False):
        resolved = rover(tmp_path / f"rover{fixed}", "", [(spawn, urdf % fixed)])
        notes = {note.key: note.text for note in resolved.notes if note.status == "ignored"}
        assert notes["scene.robot.spawn.merge_fixed_joints"] == "the bodies of the MJCF are simulated"
        reasons.append(notes.get("scene.robot.spawn.fix_base"))
    assert reasons == ["the MJCF decides: a root body with a free joint moves, without one it is fixed", None]


def test_disable_gravity_of_a_manager_based_task_acts(tmp_path):
    spawn = 'usd_path="omniverse://somewhere/rover.usd"'
    lifted = spawn + ", rigid_props=sim_utils.RigidBodyPropertiesCfg(disable_gravity=True)"
    env = make_env(rover(tmp_path / "rover", "", [(spawn, lifted)]), seed=0)
    model = env.engine.model
    bodies = [b for b in range(model.nbody) if model.body(b).name.startswith("robot/")]
    assert model.body_gravcomp[bodies].tolist() == [1.0] * 3


def test_settings_of_a_direct_task_without_an_effect_are_reported(pole):
    scale = 'usd_path="omniverse://somewhere/pole.usd", scale=(2.0, 2.0, 2.0)'
    seed = ("    force = 5.0\n", "    force = 5.0\n    seed = 7\n    is_finite_horizon = True\n")
    resolved = pole(('usd_path="omniverse://somewhere/pole.usd"', scale), seed)
    ignored = {note.key for note in resolved.notes if note.status == "ignored"}
    assert {"scene.robot.spawn.scale", "seed", "is_finite_horizon"} <= ignored


CURRICULUM = """
def widen(env, env_ids, name):
    ranges = env.command_manager.get_term(name).cfg.ranges
    return torch.tensor(ranges.lin_vel_x[1])
"""
COMMAND = """mdp.UniformVelocityCommandCfg(
        asset_name="robot", resampling_time_range=(4.0, 6.0), heading_command=False,
        ranges=mdp.UniformVelocityCommandCfg.Ranges(lin_vel_x=(-0.3, 0.5), lin_vel_y=(0.0, 0.0), ang_vel_z=(-1.0, 1.0)))
"""


def test_command_of_isaac_labs_class_has_the_names_and_ranges_of_the_built_in_one(tmp_path):
    terms = {"commands": {"base_velocity": COMMAND}}
    terms["curriculum"] = {"wide": "CurriculumTermCfg(func=widen, params={'name': 'base_velocity'})"}
    env = make_env(rover(tmp_path / "rover", CURRICULUM, **terms), seed=0)
    env.reset()
    knobs = env.command_manager.knobs()
    assert [(knob.name, knob.low, knob.high) for knob in knobs] == [
        ("vx", -0.3, 0.5), ("vy", -1.0, 1.0), ("wz", -1.0, 1.0),
    ]  # fmt: skip
    env.command_manager.hold("vx", 0.25)
    env.step(torch.zeros(env.num_envs, env.layout.action_size))
    assert env.command_manager.get_command("base_velocity")[:, 0].tolist() == [0.25] * env.num_envs


def test_markers_of_a_task_are_reported_once(pole, caplog):
    own = "        self.applied = 0\n"
    markers = (
        "        from isaaclab.markers import VisualizationMarkers, VisualizationMarkersCfg\n"
        "        for name in ('a', 'b'):\n"
        "            goal = VisualizationMarkers(VisualizationMarkersCfg(prim_path=name, markers={}))\n"
    )
    with caplog.at_level(logging.WARNING):
        make_env(pole((own, own + markers)), seed=0)
    assert [r.getMessage() for r in caplog.records if "VisualizationMarkers are not drawn" in r.getMessage()] != []
    assert len(caplog.records) == 1


RANDOM = RESET + "        self.observed[env_ids] = torch.rand(len(env_ids), device=self.device)\n"


LONG = (("        self.observed += 1\n", ""), ("episode_length_s = 0.2", "episode_length_s = 1.0"))


def checked(pole, tmp_path, *changes, only=("same-seed", "truncation")):
    """Write the direct task with replaced parts of its text; return check -> finding of some checks."""
    pole(*changes)
    report = check_task(f"{tmp_path}/pole/pole_env.py:PoleEnvCfg", only=list(only))
    return {finding.check: finding for finding in report}


def test_check_warns_of_draws_of_torch_and_of_episodes_that_end_a_step_early(pole, tmp_path):
    found = checked(pole, tmp_path, (RESET, RANDOM), *LONG)
    assert {check: finding.severity for check, finding in found.items()} == {
        "same-seed": "warning",
        "truncation": "warning",
    }
    assert "from torch's generator" in found["same-seed"].message
    assert "compare the step with `>= max_episode_length`" in found["truncation"].hint


def test_check_accepts_episodes_of_full_length(pole, tmp_path):
    assert checked(pole, tmp_path, ("self.max_episode_length - 1", "self.max_episode_length"), *LONG) == {}


@pytest.mark.parametrize(
    "code",
    [
        "import numpy; self.observed[env_ids] = float(numpy.random.rand())",
        "self.observed += 1 + torch.rand(1, device=self.device)",  # besides draws of torch, a state that is not reset
        "self.resets = getattr(self, 'resets', 0) + 1; self.observed[env_ids] = float(self.resets)",
    ],
    ids=["numpy", "torch and a state", "a state"],
)
def test_check_rejects_differences_that_torchs_generator_does_not_explain(pole, tmp_path, code):
    found = checked(pole, tmp_path, (RESET, f"{RESET}        {code}\n"), *LONG)
    assert found["same-seed"].severity == "error"


NOISY = (
    'return {"policy": torch.cat([velocity,',
    'return {"policy": torch.cat([torch.randn_like(velocity) + velocity,',
)


def test_check_warns_of_later_draws_that_a_reset_changes(pole, tmp_path):
    finding = checked(pole, tmp_path, (RESET, RANDOM), NOISY, *LONG, only=["partial-reset"])["partial-reset"]
    assert finding.severity == "warning"
    assert "code of the task draws from torch's generator" in finding.message


@pytest.mark.parametrize("noise", [(), (NOISY,)], ids=["no noise", "noise"])
def test_check_rejects_a_reset_that_changes_other_environments_besides_draws(pole, tmp_path, noise):
    leak = RANDOM + "        self.observed += torch.rand(1, device=self.device)\n"
    finding = checked(pole, tmp_path, (RESET, leak), *noise, *LONG, only=["partial-reset"])["partial-reset"]
    assert finding.severity == "error"


def test_noise_with_a_bias_starts_anew_at_a_reset_with_a_seed(pole, tmp_path):
    head = "from isaaclab.utils.noise import GaussianNoiseCfg, NoiseModelWithAdditiveBiasCfg\n"
    noise = "    observation_noise_model = NoiseModelWithAdditiveBiasCfg("
    noise += "noise_cfg=GaussianNoiseCfg(std=0.1), bias_noise_cfg=GaussianNoiseCfg(std=0.5))\n"
    own = ("@configclass\nclass PoleEnvCfg", f"{head}\n@configclass\nclass PoleEnvCfg")
    found = checked(pole, tmp_path, own, ("    force = 5.0\n", f"    force = 5.0\n{noise}"), *LONG)
    assert found["same-seed"].severity == "warning"


def test_recorded_task_of_a_package_is_named_with_its_id(package):
    folder = package()
    source = find_task(f"{folder}:Template-Cartpole-v0")
    assert task_reference(source.record()) == f"{folder}:Template-Cartpole-v0"
    assert task_reference(find_task("cartpole").record()) == "cartpole"


def test_package_without_an_id_lists_the_registered_ids(package, tmp_path):
    above = tmp_path / "above"
    above.mkdir()
    (above / "__init__.py").write_text("")
    package("above/tasks")
    with pytest.raises(TaskError) as raised:
        find_task(str(above))
    assert raised.value.hint == (
        f"the package registers tasks; write {above}:ID with one of these IDs: Template-Cartpole-v0"
    )


def test_recorded_configuration_of_a_direct_task_has_its_own_settings(pole, tmp_path):
    source = pole().source
    resolved = resolve(source, overrides=["params.force=0.5"])
    (tmp_path / "config.yaml").write_text(to_yaml(to_data(resolved)))
    recorded = dataclasses.replace(source, config=tmp_path / "config.yaml")  # as a run does
    assert resolve(recorded).task.params["force"] == 0.5


def test_mapping_file_may_have_names_that_the_scene_lacks(tmp_path):
    rover(tmp_path / "rover")
    (tmp_path / "rover" / "models.yaml").rename(tmp_path / "rover" / "given.yaml")
    (tmp_path / "rover" / "given.yaml").write_text("rover.usd: rover.xml\nother.usd: rover.xml\n")
    source = find_task(f"{tmp_path / 'rover' / 'rover_env.py'}:RoverEnvCfg")
    models = read_models([str(tmp_path / "rover" / "given.yaml")])
    resolved = resolve(source, overrides=[f'models."{name}"={json.dumps(value)}' for name, value in models.items()])
    assert resolved.task.scene.entities["robot"].model == f"file:{tmp_path / 'rover' / 'rover.xml'}"
    (note,) = [note for note in resolved.notes if note.key.startswith("--model")]
    assert (note.key, note.text) == ("--model other.usd", "the scene has no robot or object of this name")
