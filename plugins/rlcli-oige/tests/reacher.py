"""A small task in OmniIsaacGymEnvs' form: a two-joint arm, a sphere that marks a target, and a thruster."""

ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <option integrator="implicitfast"/>
  <worldbody>
    <body name="base" pos="0 0 1">
      <geom type="sphere" size="0.05" mass="1" contype="0" conaffinity="0"/>
      <body name="left" pos="0 0.1 0"><joint name="left_a" axis="0 1 0" range="-1 1" limited="true" damping="0.1"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="0.5" contype="0" conaffinity="0"/>
        <body name="left_tip" pos="0 0 0.3"><joint name="left_b" axis="0 1 0" damping="0.1"/>
          <geom type="sphere" size="0.03" mass="0.2" contype="0" conaffinity="0"/></body></body>
      <body name="right" pos="0 -0.1 0"><joint name="right_a" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="0.5" contype="0" conaffinity="0"/></body>
    </body>
  </worldbody>
  <actuator><position name="right_a" joint="right_a" kp="5" kv="0.5"/></actuator>
</mujoco>
"""

YAML = """
name: Arm
physics_engine: ${..physics_engine}
env:
  numEnvs: ${resolve_default:4,${...num_envs}}
  envSpacing: 3.0
  maxEpisodeLength: 12
  maxEffort: 2.0
  clipObservations: 5.0
  clipActions: 1.0
  controlFrequencyInv: 2
sim:
  dt: 0.01
  use_gpu_pipeline: ${eq:${...pipeline},"gpu"}
  gravity: [0.0, 0.0, -9.81]
  add_ground_plane: False
  physx:
    worker_thread_count: ${....num_threads}
    solver_type: ${....solver_type}
  arm:
    enable_self_collisions: False
    density: -1
  ball:
    make_kinematic: True
mjcf:
  /World/envs/.*/Arm: arm.xml
"""

TASK = """
import torch
from rlcli_oige import *
from rlcli_oige import ArticulationView, DynamicSphere, RigidPrimView, RLTask, Robot, get_prim_at_path
from rlcli_oige import limit_of_the_angle


class ArmTask(RLTask):
    def __init__(self, name, sim_config, env, offset=None):
        self.update_config(sim_config)
        self._num_observations = 4
        self._num_actions = 1
        RLTask.__init__(self, name, env)

    def update_config(self, sim_config):
        self._sim_config = sim_config
        self._cfg = sim_config.config
        self._task_cfg = sim_config.task_config
        self._num_envs = self._task_cfg["env"]["numEnvs"]
        self._env_spacing = self._task_cfg["env"]["envSpacing"]
        self._max_episode_length = self._task_cfg["env"]["maxEpisodeLength"]
        self._effort = self._task_cfg["env"]["maxEffort"]

    def set_up_scene(self, scene):
        place = torch.tensor([0.0, 0.0, 0.5])
        arm = Robot(prim_path=self.default_zero_env_path + "/Arm", name="arm", translation=place)
        self._sim_config.apply_articulation_settings(
            "arm", get_prim_at_path(arm.prim_path), self._sim_config.parse_actor_config("arm")
        )
        ball = DynamicSphere(prim_path=self.default_zero_env_path + "/ball", name="ball_0", radius=0.1,
                             color=torch.tensor([1, 0, 0]))
        self._sim_config.apply_articulation_settings(
            "ball", get_prim_at_path(ball.prim_path), self._sim_config.parse_actor_config("ball")
        )
        ball.set_collision_enabled(False)
        path = self.default_zero_env_path + "/box"
        box = DynamicCuboid(prim_path=path, translation=(0.0, 1.0, 2.0), size=0.2, mass=3.0)
        super().set_up_scene(scene)
        self._arms = ArticulationView(
            prim_paths_expr="/World/envs/.*/Arm", name="arm_view", reset_xform_properties=False
        )
        self._balls = RigidPrimView(prim_paths_expr="/World/envs/.*/ball", name="ball_view")
        self._boxes = RigidPrimView(prim_paths_expr="/World/envs/.*/box", name="box_view")
        self._links = RigidPrimView(prim_paths_expr="/World/envs/.*/Arm/(left|right)", name="link_view")
        for view in (self._arms, self._balls, self._boxes, self._links):
            scene.add(view)

    def post_reset(self):
        self._left = self._arms.get_dof_index("left_a")
        self.sums = {"angle": torch.zeros(self.num_envs, device=self.device)}
        self.reset_idx(torch.arange(self._arms.count, dtype=torch.int64, device=self._device))

    def reset_idx(self, env_ids):
        pos = torch_rand_float(-0.1, 0.1, (len(env_ids), self._arms.num_dof), device=self._device)
        self._arms.set_joint_positions(pos, indices=env_ids.to(torch.int32))
        self._arms.set_joint_velocities(torch.zeros_like(pos), indices=env_ids.to(torch.int32))
        self._balls.set_world_poses(self._env_pos[env_ids] + torch.tensor([0.0, 0.0, 2.0]), indices=env_ids)
        self.reset_buf[env_ids] = 0
        self.progress_buf[env_ids] = 0
        self.extras["episode"] = {"angle": torch.mean(self.sums["angle"][env_ids])}
        self.sums["angle"][env_ids] = 0.0

    def pre_physics_step(self, actions):
        if not self._env._world.is_playing():
            return
        reset_env_ids = self.reset_buf.nonzero(as_tuple=False).squeeze(-1)
        if len(reset_env_ids) > 0:
            self.reset_idx(reset_env_ids)
        forces = torch.zeros((self._arms.count, self._arms.num_dof), dtype=torch.float32, device=self._device)
        forces[:, self._left] = self._effort * actions[:, 0]
        self._arms.set_joint_efforts(forces, indices=torch.arange(self._arms.count, dtype=torch.int32))

    def get_observations(self):
        self.dof_pos = self._arms.get_joint_positions(clone=False)
        self.obs_buf[:, 0:3] = self.dof_pos
        self.obs_buf[:, 3] = 100.0
        return {self._arms.name: {"obs_buf": self.obs_buf}}

    def calculate_metrics(self):
        self.rew_buf[:] = self.obs_buf[:, 3] - self.obs_buf[:, self._left] ** 2
        self.sums["angle"] += self.obs_buf[:, self._left]

    def is_done(self):
        resets = torch.where(self.obs_buf[:, self._left].abs() > limit_of_the_angle(), 1, 0)
        resets = torch.where(self.progress_buf >= self._max_episode_length - 1, 1, resets)
        self.reset_buf[:] = resets
"""

SHARED = """
def limit_of_the_angle():
    return 0.5
"""

TRAIN = """
params:
  seed: ${...seed}
  algo: {name: a2c_continuous}
  model: {name: continuous_a2c_logstd}
  network:
    name: actor_critic
    separate: False
    space: {continuous: {mu_activation: None, sigma_activation: None, mu_init: {name: default},
      sigma_init: {name: const_initializer, val: 0}, fixed_sigma: True}}
    mlp: {units: [32, 16], activation: elu, initializer: {name: default}, regularizer: {name: None}}
  load_checkpoint: ${if:${...checkpoint},True,False}
  load_path: ${...checkpoint}
  config:
    name: ${resolve_default:Arm,${....experiment}}
    full_experiment_name: ${.name}
    env_name: rlgpu
    num_actors: ${....task.env.numEnvs}
    reward_shaper: {scale_value: 0.1}
    normalize_input: True
    gamma: 0.98
    tau: 0.9
    learning_rate: 3e-4
    lr_schedule: adaptive
    kl_threshold: 0.01
    schedule_type: standard
    max_epochs: ${resolve_default:7,${....max_iterations}}
    grad_norm: 0.5
    truncate_grads: True
    e_clip: 0.15
    horizon_length: 8
    minibatch_size: 16
    mini_epochs: 3
    critic_coef: 4
    clip_value: False
    bounds_loss_coef: 0.001
"""


def arm_folder(folder, yaml=YAML, task=TASK, train=TRAIN):
    """Write a task's folder: the YAML, the class, a module that it shares, the agent and the model."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.xml").write_text(ARM)
    (folder / "Arm.yaml").write_text(yaml)
    (folder / "ArmPPO.yaml").write_text(train)
    (folder / "arm.py").write_text(task)
    (folder / "shared.py").write_text(SHARED)
    return folder
