"""Hydra's interpolations as in OmniIsaacGymEnvs' files."""

import pytest

from rlcli_oige.hydra_interpolation import evaluate

TREE = {
    "num_envs": "",
    "seed": 42,
    "pipeline": "GPU",
    "task": {
        "name": "Arm",
        "env": {"a": "${resolve_default:512,${...num_envs}}", "b": "${.a}", "list": ["${..b}", 2]},
        "sim": {
            "gpu": '${eq:${...pipeline},"gpu"}',
            "has": "${contains:arm,${..name}}",
            "pick": "${if:${.gpu},yes_it_is,${.missing}}",
            "text": "seed ${seed} of ${task.name}",
        },
    },
}


def task(**sim):
    return evaluate({**TREE, "task": {"name": "Arm", "sim": sim}}, ("task", "sim"))


def test_references_and_resolvers_are_evaluated():
    tree = {**TREE, "task": {**TREE["task"], "sim": {**TREE["task"]["sim"], "missing": "no"}}}
    value, errors = evaluate(tree, ("task",))
    assert errors == []
    assert value["env"] == {"a": 512, "b": 512, "list": [512, 2]}
    assert value["sim"] == {
        "gpu": True, "has": True, "pick": "yes_it_is", "text": "seed 42 of Arm", "missing": "no",
    }  # fmt: skip


def test_value_keeps_type_and_overrides_default():
    value, errors = evaluate(
        {"num_envs": 7, "task": {"env": {"n": "${resolve_default:512,${...num_envs}}"}}}, ("task",)
    )
    assert (value["env"]["n"], errors) == (7, [])


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ("${....sed}", "above the top level of the configuration: remove leading dots", None),
        ("${...sed}", "has no 'sed'", "did you mean 'seed'?"),
        ("${oc.env:HOME}", "unknown resolver 'oc.env'", "resolvers: eq, contains, if, resolve_default"),
        ("${eq:1}", "expects 2 arguments, found 1", None),
        ("${.a}", "refers to itself", None),
        ("${...seed", "is not closed", "add the closing }"),
    ],
)
def test_invalid_interpolation_error_has_key(text, message, hint):
    _, errors = task(a=text)
    assert len(errors) == 1
    assert errors[0].path == ("task", "sim", "a")
    assert message in str(errors[0])
    assert errors[0].hint == hint
