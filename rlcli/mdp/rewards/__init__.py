"""Reward terms, unsigned and unweighted: the YAML's `weight` gives sign and size. (num_envs,) each."""

from rlcli.mdp.rewards.base import *
from rlcli.mdp.rewards.feet import *
from rlcli.mdp.rewards.joints import *
from rlcli.mdp.rewards.manipulation import *
