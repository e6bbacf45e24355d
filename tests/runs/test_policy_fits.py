"""Check that a policy fits an environment: the same columns, computed and used in the same way."""

import copy
from dataclasses import replace

import pytest

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import CheckpointError
from rlcli.registry import find_task
from rlcli.runs.checkpoint_fit import require_fit
from rlcli.runs.checkpoint_reader import open_checkpoint


def layout_of(task, *overrides):
    env = make_env(resolve(find_task(task), overrides=["scene.num_envs=2", *overrides]))
    env.close()
    return env.layout


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("actions.joint_effort.scale=50", "scale [50]"),
        ("actions.joint_effort.offset=1", "offset [1]"),
        ("actions.joint_effort.clip=[-90,90]", "clip [[-90, 90]]"),
        ("observations.policy.joint_pos_rel.scale=2", "scale [2, 2]"),
        ("observations.policy.joint_vel_rel.clip=[-5,5]", "clip [-5, 5]"),
        ("decimation=4", "0.0333"),
    ],
)
def test_require_fit_refuses_columns_with_another_meaning(newest, override, says):
    checkpoint = open_checkpoint(newest("cartpole"))
    require_fit(checkpoint, layout_of("cartpole"))
    with pytest.raises(CheckpointError) as refusal:
        require_fit(checkpoint, layout_of("cartpole", override))
    assert says in refusal.value.message
    assert len(refusal.value.message.splitlines()) == 3  # what, the head of the table, and the one field


def test_require_fit_ignores_joint_limits(newest):
    weaker = "scene.entities.robot.joints.slider_to_cart.effort_limit=50"
    require_fit(open_checkpoint(newest("cartpole")), layout_of("cartpole", weaker))


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_require_fit_accepts_a_layout_with_missing_keys(newest, task):
    checkpoint = open_checkpoint(newest(task))
    manifest = copy.deepcopy(checkpoint.manifest)
    for terms in (manifest["layout"]["actions"], *manifest["layout"]["observations"].values()):
        for term in terms:
            for key in ("scale", "offset", "clip", "limits"):
                term.pop(key, None)
    manifest["layout"]["actions"][0]["elements"] = []
    require_fit(replace(checkpoint, manifest=manifest), layout_of(task))
