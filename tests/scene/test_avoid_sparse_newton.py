"""MuJoCo 4.0.0's sparse Newton solver: models that it solves wrongly get the dense solver, or a warning."""

import random

import mujoco
import numpy as np
import pytest
from support.fault_sizes import amount

from rlcli.cli.app import main
from rlcli.scene.avoid_sparse_newton import avoid_sparse_newton, couples_branches
from rlcli.sim.quiet_mujoco import quiet_mujoco

pytestmark = pytest.mark.skipif(mujoco.__version__ != "4.0.0", reason="the bug is one of MuJoCo 4.0.0")
AGREES = 1e-5
"""Largest relative difference between the accelerations of the dense and the sparse solver."""


def drawn(seed, kind):
    """Random trees with constraints of one kind."""
    draw, count = random.Random(seed), 0

    def branch(level):
        nonlocal count
        joints = ""
        for _ in range(draw.randint(1, 3)):
            axis = " ".join(f"{draw.uniform(-1, 1):.2f}" for _ in range(2))
            joints += f'<joint name="j{count}" axis="{axis} 0.5" limited="true" range="-40 40"/>'
            count += 1
        inner = "".join(branch(level + 1) for _ in range(draw.randint(1, 3))) if level < 2 else ""
        place = f"{draw.uniform(-0.3, 0.3):.2f} {draw.uniform(-0.3, 0.3):.2f} {draw.uniform(0.05, 0.25):.2f}"
        return f'<body pos="{place}">{joints}<geom type="capsule" size="0.03" fromto="0 0 0 {place}"/>{inner}</body>'

    trees = ""
    for number in range(draw.randint(1, 4)):
        free = "<freejoint/>" if draw.random() < 0.5 else ""
        inner = "".join(branch(draw.randint(0, 2)) for _ in range(draw.randint(1, 2)))
        trees += f'<body name="b{number}" pos="{number} 0 0.2">{free}<geom size="0.1"/>{inner}</body>'
    pairs = [draw.sample(range(count), 2) for _ in range(4 if count > 1 else 0)]
    joined = "".join(f'<joint joint1="j{a}" joint2="j{b}"/>' for a, b in pairs) if kind == "equality" else ""
    chains = [f'<joint joint="j{a}" coef="1"/><joint joint="j{b}" coef="-0.7"/>' for a, b in pairs]
    fixed = "".join(f'<fixed frictionloss="0.1">{chain}</fixed>' for chain in chains) if kind == "tendon" else ""
    affinity = int(kind == "contact")
    return (
        f'<mujoco><option jacobian="sparse"/><default><geom conaffinity="{affinity}"/></default>'
        f'<worldbody><geom type="plane" size="5 5 1" conaffinity="1"/>{trees}</worldbody>'
        f"<equality>{joined}</equality><tendon>{fixed}</tendon></mujoco>"
    )


def accelerations(model, seed=0):
    data = mujoco.MjData(model)
    data.qvel[:] = np.random.default_rng(seed).normal(size=model.nv)
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


def difference(model, jacobian):
    """Largest difference between the accelerations with the model's Jacobian and with another one."""
    own = accelerations(model)
    model.opt.jacobian = jacobian
    other = accelerations(model)
    return np.abs(own - other).max() / (1 + np.abs(other).max())


def compiled(text):
    quiet_mujoco()
    spec = mujoco.MjSpec.from_string(text)
    model = spec.compile()
    avoid_sparse_newton(spec, model)
    assert spec.option.jacobian == model.opt.jacobian
    return model


def large(kind="equality", option='jacobian="auto"'):
    """A model of 99 degrees of freedom for which the sparse solver is wrong, if its branches are coupled."""
    return drawn(1086, kind).replace('jacobian="sparse"', option)


@pytest.mark.parametrize("kind", ["equality", "tendon"])
def test_large_model_with_coupled_branches_agrees_with_the_dense_solver(kind, caplog):
    assert difference(compiled(large(kind, 'jacobian="dense"')), mujoco.mjtJacobian.mjJAC_AUTO) > 0.5  # the bug
    assert difference(compiled(large(kind)), mujoco.mjtJacobian.mjJAC_DENSE) == 0
    assert not caplog.records


@pytest.mark.parametrize("text", [large("ground"), large(option='jacobian="auto" solver="CG"'), drawn(1, "equality")])
def test_model_that_the_bug_spares_keeps_its_jacobian(text, caplog):
    assert compiled(text.replace('jacobian="sparse"', "")).opt.jacobian == mujoco.mjtJacobian.mjJAC_AUTO
    assert not caplog.records


def test_sparse_of_the_mjcf_is_kept_with_a_warning(tmp_path, monkeypatch, capsys):
    (tmp_path / "model.xml").write_text(drawn(1, "equality"))
    (tmp_path / "task.yaml").write_text(
        "summary: Arms.\ndecimation: 1\nepisode_length_s: 1\nsim: {dt: 0.01}\n"
        "scene: {num_envs: 1, entities: {robot: {model: model.xml}}}\n"
        "actions: {effort: {func: joint_effort, joints: [j1]}}\nobservations: {policy: {pos: {func: joint_pos}}}\n"
        "rewards: {alive: {func: is_alive, weight: 1.0}}\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["validate", "--deep", "."]) == 0
    printed = capsys.readouterr().err
    assert printed.count('warning: scene: the MJCF sets jacobian="sparse"') == 1
    assert 'set jacobian="dense" or solver="CG" until MuJoCo 4.0.1' in printed


def test_weld_to_a_mocap_body_couples_nothing():
    for second, coupled in (("mocap", False), ("b1", True)):
        text = drawn(1086, "ground").replace(
            "</worldbody>",
            f'<body name="mocap" mocap="true"/></worldbody><equality><weld body1="b0" body2="{second}"/></equality>',
        )
        model = mujoco.MjModel.from_xml_string(text)
        assert couples_branches(model) == coupled
        assert coupled or difference(model, mujoco.mjtJacobian.mjJAC_DENSE) < AGREES


@pytest.mark.parametrize("kind", ["ground", "equality", "tendon", "contact"])
def test_models_without_a_coupling_agree(kind):
    quiet_mujoco()
    coupled = wrong = 0
    for seed in range(amount(60, 1000, 20_000)):
        model = mujoco.MjModel.from_xml_string(drawn(seed, kind))
        differs = not difference(model, mujoco.mjtJacobian.mjJAC_DENSE) < AGREES
        assert couples_branches(model) or not differs, (kind, seed)
        coupled += couples_branches(model)
        wrong += differs
    assert (coupled == 0) == (kind == "ground")
    assert wrong > 0 or kind in ("ground", "contact")
