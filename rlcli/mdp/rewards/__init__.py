"""Reward terms, without sign and weight: `weight` in the YAML gives both. (num_envs,) each."""

from rlcli.mdp.rewards.base_motion import *
from rlcli.mdp.rewards.feet import *
from rlcli.mdp.rewards.joints import *
from rlcli.mdp.rewards.manipulation import *
