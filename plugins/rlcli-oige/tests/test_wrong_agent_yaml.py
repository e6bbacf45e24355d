"""Mistakes in an rl_games YAML: the error names the key, without a traceback."""

import pytest
from reacher import TRAIN, arm_folder

from rlcli.config.load import resolve
from rlcli.errors import ConfigError
from rlcli.registry import find_task


def resolved(place, train):
    return resolve(find_task(str(arm_folder(place / "arm", train=train))))


def edited(old, new):
    assert TRAIN.count(old) == 1, old
    return TRAIN.replace(old, new)


UNITS = "mlp: {units: [32, 16], activation: elu, initializer: {name: default}, regularizer: {name: None}}"
SIGMA = "sigma_init: {name: const_initializer, val: 0}"
SPACE = TRAIN[TRAIN.index("    space: {") : TRAIN.index("    mlp: {")]


@pytest.mark.parametrize(
    ("old", "new", "key", "message", "hint"),
    [
        ("params:\n", "parms:\n", "parms", "unknown key 'parms'", "keys: params"),
        ("  config:\n", "  conf:\n", "params", "a configuration of rl_games needs the mapping params:", None),
        ("name: a2c_continuous", "name: sac", "params.algo", "'sac' has no counterpart", "expected 'a2c_continuous'"),
        (
            "name: a2c_continuous",
            "nam: a2c_continuous",
            "params.algo",
            "the key has no value",
            "expected 'a2c_continuous'",
        ),
        ("{name: a2c_continuous}", "a2c_discrete", "params.algo", "'a2c_discrete' has no counterpart", None),
        ("name: continuous_a2c_logstd", "name: [x]", "params.model", "has no counterpart", "'continuous_a2c_logstd'"),
        ("  load_path:", "  load_pth:", "params.load_pth", "unknown key 'load_pth'", "did you mean 'load_path'"),
        (
            "  network:\n    name: actor_critic\n",
            "  network: 3\n  other:\n",
            "params.network",
            "expected a mapping; write mlp",
            None,
        ),
        ("    separate: False", "    cmn: {}", "params.network.cmn", "unknown key 'cmn'", "keys: name, separate"),
        (UNITS, "mlp: [32, 16]", "params.network.mlp", "expected a mapping", None),
        (
            "activation: elu",
            "activation: gelu",
            "params.network.mlp.activation",
            "unknown activation 'gelu'",
            "known: elu",
        ),
        ("activation: elu", "activation: [elu]", "params.network.mlp.activation", "unknown activation", "known: elu"),
        ("activation: elu", "activation: elu, d2rl: True", "params.network.mlp.d2rl", "d2rl networks are not", None),
        (
            "activation: elu",
            "activation: elu, normalization: x",
            "params.network.mlp.normalization",
            "unknown key",
            None,
        ),
        (SPACE, "    space: {discrete: {}}\n", "params.network.space", "only continuous action spaces", None),
        (SPACE, "    space: 3\n", "params.network.space", "only continuous action spaces", None),
        (SIGMA, "sigma_init: {val: wide}", "params.network.space.continuous.sigma_init", "expected a number", None),
        (SIGMA, "sigma_init: {val: 1e6}", "params.network.space.continuous.sigma_init", "expected a number", None),
        ("    separate: False", "    rnn: {name: gru}", "params.network.rnn", "only LSTMs are supported", None),
        ("    gamma:", "    gama:", "params.config.gama", "unknown key 'gama'", "did you mean 'gamma'"),
        (
            "{scale_value: 0.1}",
            "{scale_value: 0.1, shift_value: 1, min_val: 0}",
            "params.config.reward_shaper",
            "only scale_value is supported; remove min_val, shift_value",
            None,
        ),
        (
            "lr_schedule: adaptive",
            "lr_schedule: cosine",
            "params.config.lr_schedule",
            "unknown schedule 'cosine'",
            "known: ",
        ),
        (
            "lr_schedule: adaptive",
            "lr_schedule: {a: 1}",
            "params.config.lr_schedule",
            "unknown schedule",
            "known: adaptive",
        ),
        (
            "schedule_type: standard",
            "schedule_type: x",
            "params.config.schedule_type",
            "unknown schedule_type",
            "legacy",
        ),
    ],
)
def test_invalid_agent_value_error_has_key(tmp_path, old, new, key, message, hint):
    with pytest.raises(ConfigError) as caught:
        resolved(tmp_path, edited(old, new))
    found = next(p for p in caught.value.problems if message in p.message)
    assert found.path == key
    assert "ArmPPO.yaml:" in found.where
    assert hint is None or hint in (found.hint or "")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("lr_schedule: adaptive", "lr_schedule: None", {"schedule": "constant", "desired_kl": None}),
        ("lr_schedule: adaptive", "lr_schedule: linear", {"schedule": "linear", "desired_kl": None}),
        ("lr_schedule: adaptive", "lr_schedule: identity", {"schedule": "constant", "desired_kl": None}),
        ("    kl_threshold: 0.01\n", "", {"schedule": "adaptive", "desired_kl": 0.008}),
        ("schedule_type: standard", "schedule_type: legacy", {"kl_grain": "minibatch"}),
        ("truncate_grads: True", "truncate_grads: False", {"max_grad_norm": None}),
        ("    grad_norm: 0.5\n", "", {"max_grad_norm": 1.0}),
        ("clip_value: False", "clip_value: True", {"clip_value": "larger"}),
        ("clip_value: False", "clip_actions: True", {"action_bound": 1.0}),
        ("clip_value: False", "clip_actions: False", {"action_bound": None}),
        ("clip_value: False", "normalize_advantage: True", {"normalize_advantage": "batch"}),
        ("clip_value: False", "normalize_advantage: False", {"normalize_advantage": None}),
        ("val: 0}", "val: -1.0}", {"init_std": pytest.approx(0.36787944)}),
        ("reward_shaper: {scale_value: 0.1}", "reward_shaper: {}", {"reward_scale": 1.0}),
    ],
)
def test_agent_settings_reach_trainer(tmp_path, old, new, expected):
    agent = resolved(tmp_path, edited(old, new)).agent
    assert {key: getattr(agent, key) for key in expected} == expected


def test_recurrent_network_has_configured_size(tmp_path):
    agent = resolved(tmp_path, edited("separate: False", "rnn: {name: lstm, units: 24, layers: 2}")).agent
    assert (agent.rnn.hidden, agent.rnn.layers) == (24, 2)


@pytest.mark.parametrize(
    ("old", "new", "key", "status"),
    [
        ("separate: False", "separate: True", "params.network.separate", "mapped"),
        ("fixed_sigma: True", "fixed_sigma: False", "params.network.space.continuous.fixed_sigma", "approximated"),
        ("clip_value: False", "value_bootstrap: True", "params.config.value_bootstrap", "mapped"),
        ("clip_value: False", "value_bootstrap: False", "params.config.value_bootstrap", "approximated"),
        ("clip_value: False", "central_value_config: {}", "params.config.central_value_config", "approximated"),
        ("lr_schedule: adaptive", "lr_schedule: linear", "params.config.kl_threshold", "ignored"),
        (
            "    separate: False\n",
            "    rnn: {name: lstm, before_mlp: True}\n",
            "params.network.rnn.before_mlp",
            "mapped",
        ),
        (
            "    separate: False\n",
            "    rnn: {name: lstm, concat_input: True}\n",
            "params.network.rnn.concat_input",
            "approximated",
        ),
    ],
)
def test_approximated_key_is_noted(tmp_path, old, new, key, status):
    notes = {note.key: note.status for note in resolved(tmp_path, edited(old, new)).notes}
    assert notes[key] == status
