# ruff: noqa: E501
"""Task files of Isaac Lab run without a changed line: imports, models beside the files, agents, and direct tasks."""

import json
import os
import subprocess
import sys
import textwrap
import uuid
from pathlib import Path

import pytest
import torch
from cartpole_files import write

from rlcli.config.load import resolve
from rlcli.config.model_option import MODELS, read_models
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError, TaskError
from rlcli.registry import find_task
from rlcli_isaaclab.sensor_reader import choose_image
from rlcli_isaaclab.settings import Node, Report


def original(text):
    """Return a file as it is in Isaac Lab."""
    text = text.replace("rlcli_isaaclab.rsl_rl", "isaaclab_rl.rsl_rl").replace(
        "from rlcli_isaaclab import mdp", "import isaaclab.envs.mdp as mdp"
    )
    return text.replace("rlcli_isaaclab", "isaaclab")


@pytest.fixture
def unchanged(tmp_path):
    folder = tmp_path / "balance_unchanged"
    folder.mkdir()
    write(folder)
    for file in folder.rglob("*.py"):
        file.write_text(original(file.read_text()))
    return folder


def test_package_with_isaac_lab_imports_steps_and_leaves_no_module(unchanged):
    program = f"""
        import sys, torch
        from rlcli.registry import find_task
        from rlcli.config.load import resolve
        from rlcli.envs.make import make_env
        resolved = resolve(find_task({str(unchanged)!r}))
        env = make_env(resolved.with_num_envs(4), seed=0)
        env.reset()
        env.step(torch.zeros(4, 1))
        print([name for name in sys.modules if name.partition(".")[0] in ("isaaclab", "isaaclab_rl", "omni")])
        try:
            import isaaclab
        except ModuleNotFoundError:
            print("not found")
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True)
    assert done.stdout.splitlines() == ["[]", "not found"], done.stderr


def test_import_inside_a_function_that_runs_later(unchanged):
    file = next(file for file in unchanged.glob("*env_cfg.py"))
    text = file.read_text()
    marker = "@configclass"
    late = "def upright_late(env):\n    from isaaclab.utils.math import wrap_to_pi\n    import isaaclab.utils.math as m\n    assert m.wrap_to_pi is wrap_to_pi\n    return wrap_to_pi(env.scene['robot'].data.joint_pos[:, 1])\n\n\n"
    text = text.replace(marker, late + marker, 1)
    text = text.replace("RewTerm(func=mdp.is_alive", "RewTerm(func=upright_late", 1)
    assert "func=upright_late" in text
    file.write_text(text)
    env = make_env(resolve(find_task(str(unchanged))).with_num_envs(2), seed=0)
    env.reset()
    env.step(torch.zeros(2, 1))


DIRECT = """
import torch
import isaaclab.sim as sim_utils
from isaaclab.actuators import ImplicitActuatorCfg
from isaaclab.assets import Articulation, ArticulationCfg
from isaaclab.envs import DirectRLEnv, DirectRLEnvCfg
from isaaclab.scene import InteractiveSceneCfg
from isaaclab.sim import SimulationCfg
from isaaclab.sim.spawners.from_files import GroundPlaneCfg, spawn_ground_plane
from isaaclab.utils import configclass


@configclass
class PoleEnvCfg(DirectRLEnvCfg):
    decimation = 2
    episode_length_s = 0.2
    action_space = 1
    observation_space = 3
    sim: SimulationCfg = SimulationCfg(dt=0.01)
    robot_cfg: ArticulationCfg = ArticulationCfg(
        prim_path="/World/envs/env_.*/Robot",
        spawn=sim_utils.UsdFileCfg(usd_path="omniverse://somewhere/pole.usd"),
        actuators={"cart": ImplicitActuatorCfg(joint_names_expr=["slider_to_cart"], stiffness=0.0, damping=0.0)},
    )
    scene: InteractiveSceneCfg = InteractiveSceneCfg(num_envs=4, env_spacing=4.0)
    force = 5.0


class PoleEnv(DirectRLEnv):
    cfg: PoleEnvCfg

    def __init__(self, cfg, render_mode=None, **kwargs):
        super().__init__(cfg, render_mode, **kwargs)
        self.cart, _ = self.robot.find_joints("slider_to_cart")
        self.observed = torch.zeros(self.num_envs, device=self.device)
        self.applied = 0

    def _setup_scene(self):
        self.robot = Articulation(self.cfg.robot_cfg)
        spawn_ground_plane(prim_path="/World/ground", cfg=GroundPlaneCfg())
        self.scene.clone_environments(copy_from_source=False)
        self.scene.articulations["robot"] = self.robot
        light = sim_utils.DomeLightCfg(intensity=2000.0)
        light.func("/World/Light", light)

    def _pre_physics_step(self, actions):
        self.actions = actions.clone()

    def _apply_action(self):
        self.applied += 1
        self.scene.write_data_to_sim()
        self.robot.set_joint_effort_target(self.cfg.force * self.actions, joint_ids=self.cart)

    def _get_observations(self):
        self.observed += 1
        self.scene.update(self.step_dt)
        velocity = self.robot.data.joint_vel
        return {"policy": torch.cat([velocity, self.observed[:, None]], dim=1)}

    def _get_rewards(self):
        return torch.ones(self.num_envs, device=self.device)

    def _get_dones(self):
        return self.robot.data.joint_pos[:, 0].abs() > 3.0, self.episode_length_buf >= self.max_episode_length - 1

    def _reset_idx(self, env_ids):
        super()._reset_idx(env_ids)
        position = self.robot.data.default_joint_pos[env_ids]
        self.robot.write_joint_state_to_sim(position, torch.zeros_like(position), None, env_ids)
"""


@pytest.fixture
def direct(tmp_path):
    folder = tmp_path / "pole"
    folder.mkdir()
    (folder / "pole_env.py").write_text(DIRECT)
    (folder / "models.yaml").write_text("pole.usd: cartpole:cartpole.xml\n")
    return folder / "pole_env.py"


def test_direct_task_groups_prims_and_observes_arrays_of_two_dimensions(direct):
    text = DIRECT.replace("observation_space = 3", "observation_space = [2, 3]")
    text = text.replace('{"policy": torch', '{"policy": self.twice(torch').replace("dim=1)}", "dim=1))}")
    text = text.replace("return torch.ones(self.num_envs,", "return torch.ones(self.num_envs, 1,")
    group = 'import isaacsim.core.utils.prims as prim_utils\n        prim_utils.create_prim("/World/envs/env_0/Plants")'
    text = text.replace("    def _setup_scene(self):\n", f"    def _setup_scene(self):\n        {group}\n")
    twice = "    def twice(self, value):\n        return torch.stack([value, 2.0 * value], dim=1)\n"
    direct.write_text(text.replace("    def _pre_physics_step", f"{twice}\n    def _pre_physics_step"))
    env = make_env(resolve(find_task(f"{direct}:PoleEnvCfg")), seed=0)
    env.reset()
    obs = env.step(torch.ones(4, 1)).obs["policy"]
    assert obs.shape == (4, 6)
    assert torch.equal(obs[:, 3:], 2.0 * obs[:, :3])


def test_field_of_a_direct_task_that_is_a_configuration_class(direct):
    spare = "@configclass\nclass SpareCfg:\n    size = 1.0\n\n\n"
    text = DIRECT.replace("    force = 5.0\n", "    force = 5.0\n    kind: type = SpareCfg\n")
    direct.write_text(text.replace("@configclass\nclass PoleEnvCfg", f"{spare}@configclass\nclass PoleEnvCfg"))
    params = resolve(find_task(f"{direct}:PoleEnvCfg")).task.params
    assert "force" in params
    assert "kind" not in params


def test_direct_task_cannot_read_meshes_of_the_stage_while_its_scene_is_set_up(direct):
    stage = "from isaacsim.core.utils.stage import get_current_stage\n"
    read = '        get_current_stage().GetPrimAtPath("/World/terrain").IsValid()\n'
    text = DIRECT.replace("    def _setup_scene(self):\n", f"    def _setup_scene(self):\n{read}")
    direct.write_text(stage + text)
    with pytest.raises(TaskError, match=r"pole_env\.py:\d+: pxr\.Usd\.Prim\.IsValid cannot be used"):
        resolve(find_task(f"{direct}:PoleEnvCfg"))


def set_up_with(file, line):
    """Return the configuration of the direct task whose `_setup_scene` starts with a line of code."""
    file.write_text(DIRECT.replace("    def _setup_scene(self):\n", f"    def _setup_scene(self):\n        {line}\n"))
    return resolve(find_task(f"{file}:PoleEnvCfg"))


@pytest.mark.parametrize(
    "line",
    [
        "assert self.sim.is_playing() and self.sim.get_physics_dt() == 0.01 and not self.sim.has_gui()",
        "assert not hasattr(self.sim, 'carb_settings')",
    ],
)
def test_simulation_of_a_direct_task(direct, line):
    set_up_with(direct, line)


def test_stage_of_the_simulation_cannot_be_read_while_the_scene_is_set_up(direct):
    with pytest.raises(TaskError, match=r"pole_env\.py:\d+: pxr\.Usd\.Prim\.IsValid cannot be used"):
        set_up_with(direct, 'self.sim.stage.GetPrimAtPath("/World").IsValid()')


def test_missing_method_of_the_simulation_is_named_with_its_line(direct):
    with pytest.raises(TaskError, match=r"env\.sim\.pause cannot be used: .* \(.*pole_env\.py:\d+\)"):
        set_up_with(direct, "self.sim.pause()")


def test_stage_cannot_be_read_after_the_start(direct):
    read = '        self.sim.stage.GetPrimAtPath("/World/robot")\n'
    direct.write_text(
        DIRECT.replace(
            "    def _pre_physics_step(self, actions):\n", f"    def _pre_physics_step(self, actions):\n{read}"
        )
    )
    env = make_env(resolve(find_task(f"{direct}:PoleEnvCfg")), seed=0)
    env.reset()
    with pytest.raises(TaskError, match=r"pole_env\.py:\d+: the USD stage after the start cannot be used"):
        env.step(torch.zeros(4, 1))


def test_direct_task_steps_and_observes_once_per_step(direct):
    env = make_env(resolve(find_task(f"{direct}:PoleEnvCfg")), seed=0)
    obs = env.reset()["policy"]
    assert obs[:, 2].tolist() == [1.0] * 4
    result = None
    for step in range(8):
        result = env.step(torch.ones(4, 1))
        assert result.obs["policy"][:, 2].tolist() == [step + 2.0] * 4
        assert result.reward.tolist() == [1.0] * 4
    assert not result.truncated.any()
    result = env.step(torch.ones(4, 1))
    assert result.truncated.all()
    assert not result.terminated.any()
    assert (result.final_obs["policy"][:, 0] > 0.1).all()
    assert (result.obs["policy"][:, 0] == 0.0).all()
    assert result.obs["policy"][:, 2].tolist() == [10.0] * 4  # the last observation of the episode left no trace
    lab = vars(env)["_isaaclab_direct"].lab
    assert lab.applied == 18  # before every physics step


def test_direct_task_that_prepares_values_before_the_simulation(direct):
    text = DIRECT.replace("    observation_space = 3", "    observation_space = 0\n    drop = (0.0, 0.0, -2.0)")
    start = "        super().__init__(cfg, render_mode, **kwargs)\n"
    own = "        cfg.observation_space += 3\n        self.task = cfg\n"
    text = text.replace(start, own + start).replace("Articulation(self.cfg.", "Articulation(self.task.")
    text = text.replace("cfg=GroundPlaneCfg())", "cfg=GroundPlaneCfg(), translation=self.task.drop)")
    direct.write_text(text)
    env = make_env(resolve(find_task(f"{direct}:PoleEnvCfg")), seed=0)
    assert env.reset()["policy"].shape == (4, 3)
    model = env.engine.model
    assert model.geom_pos[model.geom_type == 0].tolist() == [[0.0, 0.0, -2.0]]  # the ground plane


def test_direct_task_saves_and_restores_its_tensors(direct):
    resolved = resolve(find_task(f"{direct}:PoleEnvCfg"))
    env, other = make_env(resolved, seed=0), make_env(resolved, seed=0)
    env.reset()
    other.reset()
    for _ in range(3):
        env.step(torch.ones(4, 1))
    other.load_state_dict(env.state_dict())
    action = torch.full((4, 1), 0.5)
    assert torch.equal(env.step(action).obs["policy"], other.step(action).obs["policy"])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("        self.cart = self.robot.body_names.index('finger')", "ValueError: 'finger' is not in list"),
        ("        self.robot.find_joints('finger')", "finger"),
        ("        self.sim.step(render=False)", "a task cannot step the simulation itself"),
        (
            "        sim_utils.retrieve_file_path('omniverse://a/grasps.json', download_dir='.')",
            "'omniverse://a/grasps.json' is a file of NVIDIA's server, and rlcli downloads nothing",
        ),
    ],
)
def test_error_of_a_direct_task_has_the_line_of_its_code(direct, line, message):
    start = "        self.applied = 0\n"
    text = DIRECT.replace("sim_utils\n", "sim_utils\nimport isaaclab.utils.assets\n", 1).replace(
        start, f"{start}{line}\n"
    )
    direct.write_text(text.replace("sim_utils.retrieve", "isaaclab.utils.assets.retrieve"))
    number = 1 + direct.read_text().split(start)[0].count("\n") + 1
    with pytest.raises(TaskError) as caught:
        make_env(resolve(find_task(f"{direct}:PoleEnvCfg")), seed=0).reset()
    assert str(caught.value).startswith(f"{direct}:{number}: ")
    assert message in str(caught.value)


def test_file_that_was_downloaded_by_hand_is_found(tmp_path):
    from rlcli_isaaclab.utils.assets import retrieve_file_path

    (tmp_path / "grasps.json").write_text("{}")
    assert retrieve_file_path("omniverse://a/grasps.json", str(tmp_path)) == str(tmp_path / "grasps.json")
    assert retrieve_file_path("omniverse://a/robot.usd") == "omniverse://a/robot.usd"


CAMERA = """
    camera_cfg: TiledCameraCfg = TiledCameraCfg(
        prim_path="/World/envs/env_.*/Camera", data_types=["rgb", "depth", "semantic_segmentation"],
        offset=TiledCameraCfg.OffsetCfg(pos=(-5.0, 0.0, 2.0), convention="world"),
        spawn=sim_utils.PinholeCameraCfg(clipping_range=(0.1, 20.0)), width=16, height=12,
    )
"""


def test_camera_with_several_types_of_images(direct):
    text = DIRECT.replace("sim_utils\n", "sim_utils\nfrom isaaclab.sensors import TiledCamera, TiledCameraCfg\n", 1)
    text = text.replace("    force = 5.0\n", f"    force = 5.0\n{CAMERA}")
    text = text.replace(
        "        spawn_ground", "        self.camera = TiledCamera(self.cfg.camera_cfg)\n        spawn_ground", 1
    )
    direct.write_text(text)
    resolved = resolve(find_task(f"{direct}:PoleEnvCfg"))
    note = next(note for note in resolved.notes if "data_types" in str(note))
    assert "without semantic_segmentation, which have no counterpart" in str(note)
    env = make_env(resolved, seed=0)
    env.reset()
    output = vars(env)["_isaaclab_direct"].lab.camera.data.output
    assert set(output) == {"rgb", "depth", "distance_to_image_plane"}
    assert (output["rgb"].shape, output["rgb"].dtype) == ((4, 12, 16, 3), torch.uint8)
    assert output["depth"].shape == (4, 12, 16, 1)
    assert 2.0 < output["depth"].max() < 20.0
    assert "semantic_segmentation" not in output
    with pytest.raises(TaskError, match="output\\['semantic_segmentation'\\] cannot be used"):
        output["semantic_segmentation"]


@pytest.mark.parametrize(
    ("params", "sensor"),
    [
        ({}, "cam"),
        ({"data_type": "distance_to_image_plane"}, "cam__depth"),
        ({"data_type": "distance_to_camera"}, None),
        ({"data_type": "normals"}, None),
    ],
)
def test_image_term_reads_the_type_that_it_names(params, sensor):
    sensors = {"cam": {"kind": "camera", "data": "rgb"}, "cam__depth": {"kind": "camera", "data": "depth"}}
    report, config = Report(), {"sensor": "cam"}
    choose_image(Node(params, ("observations", "policy", "picture", "params"), report), config, sensors)
    assert [problem.path for problem in report.problems] == (
        [] if sensor else ["observations.policy.picture.params.data_type"]
    )
    assert config["sensor"] == (sensor or "cam")


def test_distance_to_camera_along_the_optical_axis_is_a_depth():
    sensors = {"cam": {"kind": "camera", "data": "distance"}}
    config = {"sensor": "cam"}
    params = {"data_type": "distance_to_camera", "convert_perspective_to_orthogonal": True}
    choose_image(Node(params, (), Report()), config, sensors)
    assert config["sensor"] == "cam__depth"
    assert sensors["cam__depth"]["data"] == "depth"


def test_space_that_is_not_continuous_is_refused_with_place(direct):
    direct.write_text(DIRECT.replace("action_space = 1", "action_space = {2}"))
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(f"{direct}:PoleEnvCfg"))
    (problem,) = caught.value.problems
    assert problem.where.endswith("pole_env.py:13")
    assert "set" in problem.message


def test_missing_model_names_the_mapping_file(direct):
    (direct.parent / "models.yaml").unlink()
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(f"{direct}:PoleEnvCfg"))
    assert "no MJCF model is known for 'pole.usd'" in caught.value.problems[0].message
    hint = "give a model: --model robot=FILE.xml, or --model models.yaml with lines robot: FILE.xml"
    assert caught.value.problems[0].hint == hint


def test_model_on_the_command_line(direct, tmp_path):
    (direct.parent / "models.yaml").unlink()
    given = tmp_path / "given.yaml"
    given.write_text("robot: {model: 'cartpole:cartpole.xml', gains: {}}\n")
    for word in ("robot=cartpole:cartpole.xml", str(given)):
        words = [f'{MODELS}."{name}"={json.dumps(value)}' for name, value in read_models([word]).items()]
        found = resolve(find_task(f"{direct}:PoleEnvCfg"), overrides=words)
        assert found.task.scene.entities["robot"].model.endswith("cartpole.xml")


def test_model_for_a_name_that_the_scene_lacks(direct):
    words = [f'{MODELS}."robt"="{direct.parent / "pole.xml"}"']
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(f"{direct}:PoleEnvCfg"), overrides=words)
    (problem,) = caught.value.problems
    assert problem.message == "--model robt: the scene has no 'robt'"
    assert "robot" in problem.hint


@pytest.mark.slow
def test_run_remembers_its_model(unchanged, monkeypatch):
    file = next(file for file in unchanged.glob("*env_cfg.py"))
    text = file.read_text().replace(
        "@configclass", 'CARTPOLE_CFG.spawn.usd_path = "nowhere/other.usd"\n\n\n@configclass', 1
    )
    file.write_text(text)
    monkeypatch.chdir(unchanged.parent)
    model = ["--model", "robot=cartpole:cartpole.xml"]
    for words in (
        ["train", str(unchanged), *model, "--max-iterations", "1", "--num-envs", "4"],
        ["eval", "--checkpoint", "latest", "--episodes", "1"],
    ):
        done = subprocess.run([sys.executable, "-m", "rlcli", *words], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_mapping_file_with_a_file_that_does_not_exist(direct):
    (direct.parent / "models.yaml").write_text("robot: gone.xml\n")
    with pytest.raises(TaskError, match=r"models\.yaml: robot: there is no file 'gone\.xml'"):
        resolve(find_task(f"{direct}:PoleEnvCfg"))


def test_actuator_network_needs_gains_of_the_mapping_file(direct):
    network = 'ActuatorNetLSTMCfg(joint_names_expr=["slider_to_cart"], network_file="net.jit", saturation_effort=9.0, velocity_limit=3.0, effort_limit=8.0)'
    text = DIRECT.replace(
        'ImplicitActuatorCfg(joint_names_expr=["slider_to_cart"], stiffness=0.0, damping=0.0)', network
    )
    direct.write_text(
        text.replace("import ImplicitActuatorCfg", "import ActuatorNetLSTMCfg").replace(
            "effort_target", "position_target"
        )
    )
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(f"{direct}:PoleEnvCfg"))
    assert "gains: {cart: {stiffness: S, damping: D}}" in caught.value.problems[0].hint
    gains = "robot: {model: 'cartpole:cartpole.xml', gains: {cart: {stiffness: 40.0, damping: 2.0}}}\n"
    (direct.parent / "models.yaml").write_text(gains)
    actuator = resolve(find_task(f"{direct}:PoleEnvCfg")).task.scene.entities["robot"].actuators["cart"]
    assert (actuator.kind, actuator.stiffness, actuator.saturation_effort) == ("dc_motor", 40.0, 9.0)


AGENTS = {
    "rl_games.yaml": """
params:
  algo: {name: a2c_continuous}
  model: {name: continuous_a2c_logstd}
  network: {name: actor_critic, separate: False, mlp: {units: [16, 8], activation: relu},
            space: {continuous: {fixed_sigma: True, sigma_init: {name: const_initializer, val: 0}}}}
  config: {horizon_length: 24, max_epochs: 7, minibatch_size: 48, mini_epochs: 3, gamma: 0.98, tau: 0.9,
           learning_rate: 1e-4, lr_schedule: adaptive, kl_threshold: 0.01, e_clip: 0.1, critic_coef: 4,
           truncate_grads: True, grad_norm: 0.7, reward_shaper: {scale_value: 0.5}, surprise: 1}
""",
    "skrl.yaml": """
models:
  policy: {class: GaussianMixin, initial_log_std: 0.0, network: [{name: net, layers: [16, 8], activations: elu}]}
  value: {class: DeterministicMixin, network: [{name: net, layers: [32], activations: elu}]}
agent: {class: PPO, experiment: {checkpoint_interval: 50}, rollouts: 24, learning_epochs: 3, mini_batches: 2, discount_factor: 0.98, lambda: 0.9,
        learning_rate: 1.0e-04, ratio_clip: 0.1, time_limit_bootstrap: False, rewards_shaper_scale: 0.5}
trainer: {timesteps: 168}
""",
    "sb3.yaml": """
n_timesteps: !!float 1e4
policy: MlpPolicy
n_steps: 24
batch_size: 48
n_epochs: 3
gamma: 0.98
policy_kwargs: {activation_fn: nn.ELU, net_arch: [16, 8]}
""",
}


def registered(folder, libraries):
    """Write the package of the direct task, which registers agents of some libraries."""
    entries = "".join(f'"{name}_cfg_entry_point": f"{{__name__}}:{name}.yaml",' for name in libraries)
    (folder / "__init__.py").write_text(
        "import gymnasium as gym\n"
        f'gym.register(id="Pole-{uuid.uuid4().hex}-v0", entry_point=f"{{__name__}}.pole_env:PoleEnv",\n'
        f'             kwargs={{"env_cfg_entry_point": f"{{__name__}}.pole_env:PoleEnvCfg", {entries}}})\n'
    )
    for name in libraries:
        (folder / f"{name}.yaml").write_text(AGENTS[f"{name}.yaml"])


@pytest.mark.parametrize("library", ["rl_games", "skrl", "sb3"])
def test_agent_file_of_each_library_is_read(direct, library):
    registered(direct.parent, [library])
    resolved = resolve(find_task(str(direct.parent)))
    agent = resolved.agent
    assert resolved.agent_name == library.replace("_", "-")
    assert (agent.num_steps, agent.num_epochs, agent.gamma) == (24, 3, 0.98)
    assert agent.actor.hidden == (16, 8)
    if library != "sb3":
        assert agent.max_iterations == 7
        assert agent.learning_rate == 1e-4
        assert agent.reward_scale == 0.5
    assert agent.save_interval == (3 if library == "skrl" else None)
    if library == "rl_games":
        assert any("surprise" in note.key for note in resolved.notes if note.status == "ignored")


def test_registration_that_passes_the_settings_to_the_environment_class(direct):
    (direct.parent / "__init__.py").write_text(
        "import gymnasium as gym\nfrom .pole_env import PoleEnvCfg\n"
        f'gym.register(id="Pole-{uuid.uuid4().hex}-v0", entry_point=f"{{__name__}}.pole_env:PoleEnv",\n'
        '             kwargs={"cfg": PoleEnvCfg(force=9.0)})\n'
    )
    env = make_env(resolve(find_task(str(direct.parent))), seed=0)
    env.reset()
    assert env.step(torch.ones(4, 1)).reward.tolist() == [1.0] * 4
    assert vars(env)["_isaaclab_direct"].lab.cfg.force == 9.0
    make_env(resolve(find_task(f"{direct}:PoleEnvCfg")), seed=0)


def test_rl_games_settings_without_counterpart_are_reported(direct):
    registered(direct.parent, ["rl_games"])
    file = direct.parent / "rl_games.yaml"
    file.write_text(
        AGENTS["rl_games.yaml"].replace("lr_schedule: adaptive", "lr_schedule: linear, value_bootstrap: False")
    )
    resolved = resolve(find_task(str(direct.parent)))
    assert resolved.agent.schedule == "linear"
    approximated = {note.key.rpartition(".")[2] for note in resolved.notes if note.status == "approximated"}
    assert {"separate", "value_bootstrap"} <= approximated
    layers = "cnn: {type: conv2d, convs: [{filters: 4, kernel_size: 3, strides: 1, padding: 1}]}, mlp:"
    file.write_text(AGENTS["rl_games.yaml"].replace("mlp:", layers).replace("schedule: adaptive", "schedule: cosine"))
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(str(direct.parent)))
    found = {problem.path: problem.message for problem in caught.value.problems}
    assert found == {
        "params.config.lr_schedule": "unknown schedule 'cosine'",
        "params.network.cnn.convs.0.padding": "rlcli's convolutions have no padding",
    }


@pytest.mark.parametrize(
    ("new", "message"), [("class: AMP", "'AMP' has no counterpart in rlcli"), ("class: null", "the key has no value")]
)
def test_agent_of_another_algorithm_is_refused_with_its_line(direct, new, message):
    registered(direct.parent, ["skrl"])
    file = direct.parent / "skrl.yaml"
    file.write_text(file.read_text().replace("class: PPO", new))
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(str(direct.parent)))
    (problem,) = caught.value.problems
    assert problem.where == f"{file}:5"
    assert problem.message == message


def test_registration_chooses_agent_and_file_reference_uses_the_same(direct):
    registered(direct.parent, ["sb3", "skrl", "rl_games"])
    assert resolve(find_task(str(direct.parent))).agent_name == "rl-games"
    assert resolve(find_task(f"{direct}:PoleEnvCfg")).agent_name == "rl-games"
    assert resolve(find_task(f"{direct}:PoleEnvCfg"), agent="skrl").agent.critic.hidden == (32,)


def test_several_runners_beside_a_file_need_a_choice(unchanged):
    (unchanged / "__init__.py").write_text("")
    inner = next(file for file in unchanged.rglob("*.py") if "RslRlOnPolicyRunnerCfg" in file.read_text())
    runner = unchanged / "runners.py"
    runner.write_text(inner.read_text())
    inner.unlink()
    name = next(line for line in runner.read_text().splitlines() if line.startswith("class ")).split("(")[0].split()[1]
    text = (
        runner.read_text()
        + f"\n\n@configclass\nclass Other(RslRlOnPolicyRunnerCfg):\n    policy = {name}().policy\n    algorithm = {name}().algorithm\n    num_steps_per_env = 8\n    max_iterations = 2\n    save_interval = 2\n    experiment_name = 'x'\n"
    )
    runner.write_text(text)
    file = next(unchanged.glob("*env_cfg.py"))
    resolved = resolve(find_task(f"{file}:CartpoleEnvCfg"))
    assert resolved.agent is None
    with pytest.raises(ConfigError, match="the task has several agents and no default"):
        resolved.require_agent()
    assert resolve(find_task(f"{file}:CartpoleEnvCfg"), agent="Other").agent.num_steps == 8


@pytest.mark.slow
def test_whole_task_package_of_isaac_lab():
    if "ISAACLAB_SOURCE" not in os.environ:
        pytest.skip("set ISAACLAB_SOURCE to the folder `source` of Isaac Lab 2.3.2 or of its unpacked wheel")
    command = [sys.executable, "corpus.py", "--stage", "steps", "--only", "^Isaac-(Cartpole|Velocity-Flat-G1|Ant)"]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    assert all(line[0] == "3" for line in done.stdout.splitlines() if "Velocity-Flat-G1" in line), done.stdout


OWN = """
    force = 5.0
    count: int = 2
    name = "pole"
    gains = (1.0, 2)
    is_slow: bool = False
    limits: LimitsCfg = LimitsCfg()
"""
LIMITS = """
@configclass
class LimitsCfg:
    angle = 3.0


@configclass
class PoleEnvCfg("""


@pytest.fixture
def with_fields(direct):
    text = DIRECT.replace("\n    force = 5.0\n", OWN).replace("\n@configclass\nclass PoleEnvCfg(", LIMITS)
    reward = "self.cfg.force * self.cfg.gains[1] + self.cfg.limits.angle + self.cfg.count * torch.ones("
    direct.write_text(text.replace("        return torch.ones(", f"        return {reward}"))
    return direct


def reward_of(resolved):
    env = make_env(resolved, seed=0)
    env.reset()
    return env.step(torch.zeros(4, 1)).reward.tolist()


def test_own_fields_of_a_direct_task_change_on_the_command_line(with_fields):
    task = find_task(f"{with_fields}:PoleEnvCfg")
    assert reward_of(resolve(task)) == [5.0 * 2 + 3.0 + 2] * 4
    words = ["params.force=7", "params.gains=[1, 0.5]", "params.limits.angle=1.5", "params.count=4"]
    resolved = resolve(task, overrides=words)
    assert resolved.task.params["name"] == "pole"
    assert reward_of(resolved) == [7 * 0.5 + 1.5 + 4] * 4


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("params.force=fast", "params.force: .*number"),
        ("params.count=0.5", "params.count: expected a whole number"),
        ("params.is_slow=1", "params.is_slow: .*(true|bool)"),
        ("params.limits.angel=1", "params.limits.angel: .*angle"),
        ("params.froce=1", "params.froce: .*force"),
        ("params.robot_cfg=1", "allowed: count, force, gains, is_slow, limits, name"),
    ],
)
def test_wrong_own_field_of_a_direct_task(with_fields, word, message):
    with pytest.raises(ConfigError, match=message):
        resolve(find_task(f"{with_fields}:PoleEnvCfg"), overrides=[word])


def test_own_field_decides_what_the_scene_has(direct):
    text = DIRECT.replace("    force = 5.0\n", "    force = 5.0\n    sees: bool = False\n")
    camera = "TiledCameraCfg(prim_path='/World/envs/env_.*/Camera', width=8, height=8, data_types=['rgb'])"
    made = f"        if self.cfg.sees:\n            self.scene.sensors['camera'] = TiledCamera({camera})\n"
    text = text.replace("        light =", f"{made}        light =")
    direct.write_text(f"from isaaclab.sensors import TiledCamera, TiledCameraCfg\n{text}")
    task = find_task(f"{direct}:PoleEnvCfg")
    assert list(resolve(task).task.scene.sensors) == []
    assert list(resolve(task, overrides=["params.sees=true"]).task.scene.sensors) == ["camera"]
