# ruff: noqa: F401
"""Isaac Lab's vocabulary: its configuration classes and the environment its terms see, as a front end to rlcli's tasks.

Every name is here, and in the submodule that has its name in Isaac Lab: `from rlcli.isaaclab import configclass` or
`from rlcli.isaaclab.utils import configclass`.
"""

from rlcli.isaaclab import mdp, sim, terrains
from rlcli.isaaclab import sim as sim_utils
from rlcli.isaaclab.actuators import (
    ActuatorBaseCfg,
    DCMotorCfg,
    DelayedPDActuatorCfg,
    IdealPDActuatorCfg,
    ImplicitActuatorCfg,
)
from rlcli.isaaclab.assets import ANT_CFG, CARTPOLE_CFG, ArticulationCfg, AssetBaseCfg, RigidObjectCfg, map_usd
from rlcli.isaaclab.configclass import MISSING, configclass
from rlcli.isaaclab.envs import ManagerBasedEnv, ManagerBasedEnvCfg, ManagerBasedRLEnvCfg, ViewerCfg
from rlcli.isaaclab.managers import (
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
from rlcli.isaaclab.rsl_rl import (
    RslRlOnPolicyRunnerCfg,
    RslRlPpoActorCriticCfg,
    RslRlPpoActorCriticRecurrentCfg,
    RslRlPpoAlgorithmCfg,
)
from rlcli.isaaclab.runtime import Asset as Articulation
from rlcli.isaaclab.runtime import Asset as RigidObject
from rlcli.isaaclab.runtime import ManagerBasedRLEnv
from rlcli.isaaclab.runtime import Sensor as ContactSensor
from rlcli.isaaclab.runtime import Sensor as RayCaster
from rlcli.isaaclab.scene import InteractiveSceneCfg
from rlcli.isaaclab.sensors import ContactSensorCfg, RayCasterCfg, patterns
from rlcli.isaaclab.sim import *  # noqa: F403
from rlcli.isaaclab.sim import __all__ as _sim
from rlcli.isaaclab.terrains import TerrainGeneratorCfg, TerrainImporterCfg
from rlcli.isaaclab.utils.assets import ISAAC_NUCLEUS_DIR, ISAACLAB_NUCLEUS_DIR
from rlcli.isaaclab.utils.math import *  # noqa: F403
from rlcli.isaaclab.utils.math import __all__ as _math
from rlcli.isaaclab.utils.noise import (
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
