"""Start poses: every entity starts where its `init_state` says, whatever pose its root has in the MJCF."""

import math

import mujoco
import pytest
import torch

from rlcli.config.load import resolve
from rlcli.config.python_task import source_of
from rlcli.envs.make import make_env
from rlcli_isaaclab import (
    ArticulationCfg,
    AssetBaseCfg,
    DoneTerm,
    ImplicitActuatorCfg,
    InteractiveSceneCfg,
    ManagerBasedRLEnvCfg,
    ObsGroup,
    ObsTerm,
    RewTerm,
    RigidObjectCfg,
    configclass,
    mdp,
    sim_utils,
)

torch.set_num_threads(1)

ROBOT = """<mujoco><worldbody><body name="base" pos="0.2 0 {height}" {turn}>{joint}<geom size="0.1" mass="1"/>
  <body name="tip" pos="0.3 0 0"><joint name="hinge" axis="0 1 0"/><geom size="0.05" mass="0.2"/></body></body>
</worldbody></mujoco>"""
HALF = math.sqrt(0.5)
STARTS = {
    "pos": {"pos": (0.5, -1.0, 0.4)},
    "pos and rot": {"pos": (0.5, -1.0, 0.4), "rot": (HALF, 0.0, 0.0, HALF)},
    "default": {},
}


@configclass
class Policy(ObsGroup):
    hinge = ObsTerm(func=mdp.joint_pos)


def task(folder, start, joint, height, turn):
    xml = ROBOT.format(height=height, joint="<freejoint/>" if joint == "floating" else "", turn=turn)
    (folder / "robot.xml").write_text(xml)
    model = sim_utils.UsdFileCfg(usd_path="robot.xml")
    state = ArticulationCfg.InitialStateCfg(**start)
    actuator = ImplicitActuatorCfg(joint_names_expr=[".*"], stiffness=20.0, damping=1.0)

    @configclass
    class SceneCfg(InteractiveSceneCfg):
        robot = ArticulationCfg(prim_path="R/Robot", spawn=model, init_state=state, actuators={"hinge": actuator})
        ball = RigidObjectCfg(
            prim_path="R/Ball",
            spawn=sim_utils.SphereCfg(radius=0.1, rigid_props=sim_utils.RigidBodyPropertiesCfg()),
            init_state=RigidObjectCfg.InitialStateCfg(pos=(3.0, 0.0, 0.7)),
        )
        table = AssetBaseCfg(prim_path="R/Table", spawn=sim_utils.CuboidCfg(size=(1.0, 1.0, 0.2)),
                             init_state=AssetBaseCfg.InitialStateCfg(pos=(-3.0, 0.0, 0.3)))  # fmt: skip
        prop = AssetBaseCfg(prim_path="R/Prop", spawn=model, init_state=AssetBaseCfg.InitialStateCfg(pos=(0, 5, 0.4)))

    @configclass
    class Cfg(ManagerBasedRLEnvCfg):
        scene: SceneCfg = SceneCfg(num_envs=2, env_spacing=4.0)

        def __post_init__(self):
            self.decimation, self.episode_length_s = 2, 1.0
            self.actions = {"hinge": mdp.JointPositionActionCfg(asset_name="robot", joint_names=["hinge"])}
            self.observations = {"policy": Policy()}
            self.rewards = {"alive": RewTerm(func=mdp.is_alive, weight=1.0)}
            self.terminations = {"time_out": DoneTerm(func=mdp.time_out, time_out=True)}

    return make_env(resolve(source_of(Cfg(), folder)))


@pytest.mark.parametrize("turn", ["", 'euler="0 0 90"'], ids=["upright", "turned"])
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("joint", ["floating", "fixed"])
@pytest.mark.parametrize("height", [0.0, 0.4, 0.62])
def test_every_entity_starts_where_its_init_state_says(tmp_path, height, joint, start, turn):
    env = task(tmp_path, STARTS[start], joint, height, turn)
    env.reset()
    model = env.engine.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    wanted = {"pos": (0.0, 0.0, 0.0), "rot": (1.0, 0.0, 0.0, 0.0), **STARTS[start]}
    places = {
        "robot": ("base", wanted["pos"], wanted["rot"]),
        "ball": ("body", (3.0, 0.0, 0.7), (1.0, 0.0, 0.0, 0.0)),
        "table": ("body", (-3.0, 0.0, 0.3), (1.0, 0.0, 0.0, 0.0)),
        "prop": ("base", (0.0, 5.0, 0.4), (1.0, 0.0, 0.0, 0.0)),
    }
    assert set(places) == set(env.entities)
    for name, (body, pos, rot) in places.items():
        compiled = model.body(f"{name}/{body}").id
        root = env.entities[name].data
        assert data.xpos[compiled].tolist() == pytest.approx(pos, abs=1e-12), name
        assert data.xquat[compiled].tolist() == pytest.approx(rot, abs=1e-12), name
        assert root.root_pos_w[0].tolist() == pytest.approx(pos, abs=1e-6), name
        assert root.root_quat_w[0].tolist() == pytest.approx(rot, abs=1e-6), name
