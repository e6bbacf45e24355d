"""A robot with a left and a right leg, which is its own mirror image, and a task that is symmetric."""

MODEL = """\
<mujoco>
  <default><position kp="20" kv="0.5"/></default>
  <worldbody>
    <body name="trunk">
      <freejoint name="root"/>
      <geom type="box" size=".2 .1 .05" mass="2"/>
      <body name="left_thigh" pos="0 .15 0">
        <joint name="left_hip" axis="1 0 0" range="-60 60"/>
        <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.2" mass=".5"/>
        <body name="left_shin" pos="0 0 -.2">
          <joint name="left_knee" axis="0 1 0" range="-90 60"/>
          <geom type="sphere" size=".04" pos="0 0 -.2" mass=".3"/>
        </body>
      </body>
      <body name="right_thigh" pos="0 -.15 0">
        <joint name="right_hip" axis="1 0 0" range="-60 60"/>
        <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.2" mass=".5"/>
        <body name="right_shin" pos="0 0 -.2">
          <joint name="right_knee" axis="0 1 0" range="-90 60"/>
          <geom type="sphere" size=".04" pos="0 0 -.2" mass=".3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="left_hip"/><position joint="left_knee"/><position joint="right_hip"/><position joint="right_knee"/>
  </actuator>
</mujoco>
"""

TASK = """\
decimation: 2
episode_length_s: 1.0
sim: {dt: 0.005}
scene:
  num_envs: 6
  sensors:
    feet: {kind: contact, bodies: [left_shin, right_shin], against: ground}
    scan: {kind: rays, body: trunk, pattern: {size: [0.2, 0.2], resolution: 0.1}, max_distance: 3.0}
  entities: {robot: {model: robot.xml, pos: [0, 0, 0.45]}}
commands: {walk: {func: uniform_velocity, resampling_time_s: [1, 2], lin_vel_x: [-1, 1], lin_vel_y: [-1, 1]}}
actions: {legs: {func: joint_position, scale: 0.5}}
observations:
  policy:
    joints: {func: joint_pos_rel, noise: {kind: uniform, low: -0.1, high: 0.1}}
    turn: {func: base_ang_vel}
    goal: {func: generated_commands, command: walk}
    scan: {func: height_scan, sensor: scan}
    action: {func: last_action}
  critic:
    speed: {func: base_lin_vel, history: 2}
    feet: {func: foot_contact, sensor: feet}
events: {payload: {func: randomize_body_mass, mode: startup, bodies: [left_shin], range: [0.1, 0.2], operation: add}}
rewards:
  track: {func: track_lin_vel_xy_exp, weight: 1.0, command: walk, std: 0.5}
  calm: {func: action_rate_l2, weight: -0.01}
terminations: {time_out: {func: time_out, time_out: true}}
agents:
  ppo: {trainer: ppo, algorithm: ppo, max_iterations: 9, num_steps: 8, num_minibatches: 3, num_epochs: 2,
        normalize_observations: true, symmetry: {}, actor: {hidden: [8]}, critic: {hidden: [8]}}
"""


def write(folder, model=MODEL, task=TASK):
    """Write the task into a folder, and return the folder."""
    (folder / "robot.xml").write_text(model)
    (folder / "task.yaml").write_text(task)
    return str(folder)
