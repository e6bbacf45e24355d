"""Reader of rl_games' `params`, which front ends of other frameworks share."""

import copy
import math

import pytest

from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.ppo.rl_games_file import RlGamesReader

PARAMS = {
    "seed": 42,
    "algo": {"name": "a2c_continuous"},
    "model": {"name": "continuous_a2c_logstd"},
    "network": {
        "name": "actor_critic",
        "separate": False,
        "space": {"continuous": {"sigma_init": {"name": "const_initializer", "val": -1.0}, "fixed_sigma": True}},
        "mlp": {"units": [32, 16], "activation": "elu", "d2rl": False},
    },
    "config": {
        "name": "cart",
        "gamma": 0.98,
        "tau": 0.9,
        "learning_rate": 1e-3,
        "horizon_length": 8,
        "minibatch_size": 64,
        "mini_epochs": 4,
        "e_clip": 0.1,
        "max_epochs": 20,
        "critic_coef": 4,
        "lr_schedule": "adaptive",
        "kl_threshold": 0.02,
        "schedule_type": "standard",
        "truncate_grads": True,
        "grad_norm": 0.7,
        "reward_shaper": {"scale_value": 0.1},
    },
}


class Sink:
    def __init__(self):
        self.data, self.notes, self.problems = {}, {}, {}

    def put(self, target, value, source):
        self.data[target[0]] = value

    def note(self, path, status, text=""):
        self.notes[".".join(map(str, path))] = status

    def problem(self, path, message, hint=None):
        self.problems[".".join(map(str, path))] = message


def read(is_strict=True, **changes):
    """Read the parameters, with values at `section__key`; None removes a key."""
    params = copy.deepcopy(PARAMS)
    for key, value in changes.items():
        *path, last = key.split("__")
        node = params
        for step in path:
            node = node.setdefault(step, {})
        node[last] = value
        if value is None:
            del node[last]
    sink = Sink()
    RlGamesReader(sink, is_strict=is_strict).read(params)
    return sink


def test_settings():
    sink = read()
    assert not sink.problems
    config = PpoConfig(**sink.data)
    assert (config.dialect, config.num_steps, config.max_iterations, config.lam) == ("rl_games", 8, 20, 0.9)
    assert (config.value_coef, config.kl_grain, config.desired_kl, config.max_grad_norm) == (2.0, "epoch", 0.02, 0.7)
    assert config.init_std == pytest.approx(math.exp(-1.0))
    assert config.reward_scale == 0.1
    assert config.actor.hidden == config.critic.hidden == (32, 16)
    assert sink.notes["params.network.separate"] == "approximated"


@pytest.mark.parametrize("key", ["gamma", "tau", "learning_rate", "horizon_length", "minibatch_size", "max_epochs"])
def test_missing_setting(key):
    assert read(**{f"config__{key}": None}).problems == {"params.config": f"missing '{key}'; add the key with a value"}


def test_unknown_keys_are_mistakes_or_noted():
    changes = {"config__gama": 0.5, "network__extra": 1, "network__mlp__bias": 2, "more": 3}
    keys = {"params.config.gama", "params.network.extra", "params.network.mlp.bias", "params.more"}
    assert set(read(**changes).problems) == keys
    lenient = read(is_strict=False, **changes)
    assert not lenient.problems
    assert {key for key, status in lenient.notes.items() if status == "ignored"} >= keys


@pytest.mark.parametrize(("bound", "expected"), [(5.0, 5.0), (math.inf, None), (None, None)])
def test_bound_of_the_wrapper_of_isaac_lab(bound, expected):
    sink = read(config__clip_actions=False, env={"clip_actions": bound})
    assert sink.data["action_bound"] == expected


def test_activation_of_convolutions_is_that_of_the_mlp():
    layer = {"filters": 8, "kernel_size": 4, "strides": 2, "padding": 0}
    cnn = {"type": "conv2d", "activation": "relu", "convs": [layer]}
    sink = read(network__cnn=cnn)
    assert sink.data["cnn"] == {"channels": [8], "kernels": [4], "strides": [2]}
    assert sink.notes["params.network.cnn.activation"] == "approximated"
