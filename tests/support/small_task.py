"""The smallest task with all parts that the tests change."""

TASK = """\
summary: a small task
decimation: 2
episode_length_s: 5.0
sim: {dt: 1/120}
scene:
  num_envs: 8
  entities:
    robot: {model: model.xml, joints: {slider: {damping: 1.0}}}
actions:
  push: {func: joint_effort, joints: [slider], scale: 2.0}
observations:
  policy:
    pos: {func: joint_pos_rel}
rewards:
  alive: {func: is_alive, weight: 1.0}
  near: {func: joint_pos_target_l2, weight: -1.0, joints: [slider], target: 0.0}
terminations:
  time_out: {func: time_out, time_out: true}
play: {scene: {num_envs: 2}}
agents:
  default: one
  one: {trainer: sb3, algorithm: ppo, max_iterations: 3, task: {scene: {num_envs: 4}, decimation: 3}}
  two: {trainer: sb3, algorithm: ppo, max_iterations: 5, gamma: 0.9}
"""

MODEL = """\
<mujoco>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" range="-2 2" limited="true"/>
      <geom name="box" type="box" size=".1 .1 .1" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom type="capsule" size=".02 .3" mass=".1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
