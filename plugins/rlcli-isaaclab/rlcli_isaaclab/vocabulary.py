# ruff: noqa: F401
"""All names that task files can import from Isaac Lab's modules, collected from the modules of this package.

`rlcli_isaaclab` exports the names of this module.
"""

from rlcli_isaaclab import actuators, assets, envs, managers, mdp, rsl_rl, scene, sensors, sim, terrains, utils
from rlcli_isaaclab import sim as sim_utils
from rlcli_isaaclab.actuators import (
    ActuatorBaseCfg,
    DCMotorCfg,
    DelayedPDActuatorCfg,
    IdealPDActuatorCfg,
    ImplicitActuatorCfg,
)
from rlcli_isaaclab.assets import ANT_CFG, CARTPOLE_CFG, ArticulationCfg, AssetBaseCfg, RigidObjectCfg, map_usd
from rlcli_isaaclab.config_class import MISSING, configclass
from rlcli_isaaclab.direct_env import DirectMARLEnv, DirectMARLEnvCfg, DirectRLEnv, DirectRLEnvCfg
from rlcli_isaaclab.envs import ManagerBasedEnv, ManagerBasedEnvCfg, ManagerBasedRLEnvCfg, ViewerCfg
from rlcli_isaaclab.managers import (
    ActionTerm,
    ActionTermCfg,
    CommandTerm,
    CommandTermCfg,
    CurriculumTermCfg,
    CurrTerm,
    DoneTerm,
    EventTerm,
    EventTermCfg,
    ManagerTermBase,
    ManagerTermBaseCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    ObsGroup,
    ObsTerm,
    RecorderTermCfg,
    RewardTermCfg,
    RewTerm,
    SceneEntityCfg,
    TerminationTermCfg,
)
from rlcli_isaaclab.markers import VisualizationMarkers
from rlcli_isaaclab.rsl_rl import (
    RslRlOnPolicyRunnerCfg,
    RslRlPpoActorCriticCfg,
    RslRlPpoActorCriticRecurrentCfg,
    RslRlPpoAlgorithmCfg,
    RslRlSymmetryCfg,
)
from rlcli_isaaclab.runtime import ManagerBasedRLEnv
from rlcli_isaaclab.scene import InteractiveSceneCfg
from rlcli_isaaclab.scene_facade import Asset as Articulation
from rlcli_isaaclab.scene_facade import Asset as RigidObject
from rlcli_isaaclab.sensor_facade import CameraView as Camera
from rlcli_isaaclab.sensor_facade import CameraView as TiledCamera
from rlcli_isaaclab.sensor_facade import FrameTransformer, TerrainImporter
from rlcli_isaaclab.sensor_facade import Sensor as ContactSensor
from rlcli_isaaclab.sensor_facade import Sensor as RayCaster
from rlcli_isaaclab.sensors import ContactSensorCfg, RayCasterCfg, patterns
from rlcli_isaaclab.sensors.patterns import GridPatternCfg
from rlcli_isaaclab.setup_scene import spawn_from_usd, spawn_ground_plane, spawn_light
from rlcli_isaaclab.sim import *  # noqa: F403
from rlcli_isaaclab.sim import __all__ as _sim
from rlcli_isaaclab.terrains import ROUGH_TERRAINS_CFG, TerrainGeneratorCfg, TerrainImporterCfg
from rlcli_isaaclab.utils.assets import ISAAC_NUCLEUS_DIR, ISAACLAB_NUCLEUS_DIR
from rlcli_isaaclab.utils.math import *  # noqa: F403
from rlcli_isaaclab.utils.math import __all__ as _math
from rlcli_isaaclab.utils.noise import (
    AdditiveGaussianNoiseCfg,
    AdditiveUniformNoiseCfg,
    ConstantNoiseCfg,
    GaussianNoiseCfg,
    NoiseModelCfg,
    NoiseModelWithAdditiveBiasCfg,
    UniformNoiseCfg,
)

Unoise, Gnoise = AdditiveUniformNoiseCfg, AdditiveGaussianNoiseCfg

__all__ = [
    *(name for name in dict(globals()) if not name.startswith("_")),
]
