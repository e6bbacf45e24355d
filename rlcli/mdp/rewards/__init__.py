"""Reward terms, (num_envs,) each. The sign and size of a reward come from the term's `weight` in the YAML."""

from rlcli.mdp.rewards.base_motion import *
from rlcli.mdp.rewards.feet import *
from rlcli.mdp.rewards.joints import *
from rlcli.mdp.rewards.manipulation import *
