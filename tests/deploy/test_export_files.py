"""Outputs and metadata of exported files."""

import copy
import hashlib
import json
import os
import runpy
import shutil
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import safetensors.torch
import torch

from rlcli.config.load import resolve
from rlcli.deploy import export as module
from rlcli.deploy.export import export
from rlcli.envs.make import make_env
from rlcli.errors import VerdictError
from rlcli.registry import find_task
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.runs.recorded_task import resolve_run
from rlcli.runs.run import open_run
from rlcli.runs.run_ref import find_run

TASKS = ["cartpole", "cartpole-direct"]
POLICIES = [*TASKS, "cartpole sac", "cartpole-direct sac"]


@pytest.fixture
def exported(newest, tmp_path):
    """Task, format -> (policy, function from observations to outputs, metadata, file)."""

    def make(task, format_="onnx"):
        checkpoint = open_checkpoint(newest(task))
        file = tmp_path / f"policy{module.FORMATS[format_]}"
        done = export(checkpoint, file, format_)
        policy = checkpoint.policy()
        if format_ == "numpy":
            space = runpy.run_path(str(file))
            numpy_run = lambda obs: {k: torch.from_numpy(v) for k, v in space["run"]({"obs": obs.numpy()}).items()}  # noqa: E731
            return policy, numpy_run, space["METADATA"], done
        if format_ == "torch":
            extra = {"rlcli": ""}
            program = torch.export.load(file, extra_files=extra).module()
            return policy, program, json.loads(extra["rlcli"]), done
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])

        def run(obs):
            action, command = session.run(["action", "command"], {"obs": obs.numpy()})
            return {"action": torch.from_numpy(action), "command": torch.from_numpy(command)}

        return policy, run, json.loads(session.get_modelmeta().custom_metadata_map["rlcli"]), done

    return make


def thousand(newest, task):
    """1,000 observations: recorded in training, random, and both x 1,000."""
    recorded = open_checkpoint(newest(task)).tensors("trainer")["observations"]
    random = torch.randn(500, recorded.shape[1], generator=torch.Generator().manual_seed(7))
    assert len(recorded) >= 100
    near = torch.cat([recorded, random])[:500]
    return torch.cat([near, 1000.0 * near])


@pytest.mark.parametrize("batch", [1, 7])
@pytest.mark.parametrize("format_", ["onnx", "torch", "numpy"])
@pytest.mark.parametrize("task", POLICIES)
def test_export_equals_policy_on_1000_observations(exported, newest, task, format_, batch):
    policy, run, metadata, _ = exported(task, format_)
    observations = thousand(newest, task)
    assert len(observations) == 1000
    actions = []
    with torch.no_grad():
        for rows in observations.split(batch):
            out = run(rows)
            torch.testing.assert_close(out["action"], policy(rows), atol=1e-5, rtol=1e-5)
            actions.append(out["action"])
    actions = torch.cat(actions)
    assert metadata["action_bound"] == 1.0
    assert float(actions.abs().max()) <= 1.0
    assert len(actions.unique()) > 100  # a constant would also be bounded and equal


def test_outputs_stay_in_bound_despite_runtime_tanh(newest, tmp_path):
    """For some inputs from 8.3 to 9, onnxruntime's float32 tanh is 1.0000001."""
    folder = Path(shutil.copytree(newest("cartpole-direct sac"), tmp_path / "checkpoint"))
    weights = {name: torch.zeros_like(t) for name, t in open_checkpoint(folder).tensors("policy").items()}
    for layer in (0, 2, 4):
        weights[f"actor.{layer}.weight"][0, 0] = 1.0  # tanh of the first observation
    data = safetensors.torch.save(weights)
    (folder / "policy.safetensors").write_bytes(data)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"]["policy.safetensors"] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    export(open_checkpoint(folder), tmp_path / "policy.onnx", "onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    obs = torch.zeros(40_000, 4)
    obs[:, 0] = torch.linspace(1.0, 10.0, len(obs))
    (action,) = session.run(["action"], {"obs": obs.numpy()})
    assert action.max() == 1.0
    np.testing.assert_allclose(action[:, 0], np.tanh(obs[:, 0].numpy()), atol=1e-6)


def test_deployed_policy_is_independent_of_batch_size(newest):
    policy = open_checkpoint(newest("cartpole")).policy()
    observations = thousand(newest, "cartpole")
    whole = policy(observations)
    single = torch.cat([policy(row) for row in observations.split(1)])
    torch.testing.assert_close(whole, single, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("format_", ["onnx", "torch", "numpy"])
def test_export_writes_one_file(exported, tmp_path, format_):
    _, _, _, done = exported("cartpole", format_)
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [done.file]


def test_onnx_graph_has_names_dynamic_batch_no_external_data(exported):
    _, _, _, done = exported("cartpole")
    model = onnx.load(done.file, load_external_data=False)
    onnx.checker.check_model(model, full_check=True)
    ends = {
        value.name: [d.dim_param or d.dim_value for d in value.type.tensor_type.shape.dim]
        for value in (*model.graph.input, *model.graph.output)
    }
    assert ends == {"obs": ["batch", 4], "action": ["batch", 1], "command": ["batch", 1]}
    assert not any(t.data_location == onnx.TensorProto.EXTERNAL for t in model.graph.initializer)


def test_onnx_file_has_no_local_paths(exported):
    _, _, _, done = exported("cartpole")
    data = done.file.read_bytes()
    assert os.getcwd().encode() not in data
    assert b"site-packages" not in data


def test_repeated_export_gives_equal_bytes(exported):
    first = exported("cartpole")[3].file.read_bytes()
    assert exported("cartpole")[3].file.read_bytes() == first


SCHEMA = {
    "schema": int,
    "input": {"name": str, "shape": list, "dtype": str, "meaning": str},
    "outputs": {
        "action": {"shape": list, "dtype": str, "meaning": str},
        "command": {"shape": list, "dtype": str, "meaning": str},
    },
    "observations": [
        {"name": str, "size": int, "elements": list, "unit": str, "scale": (list, type(None)),
         "clip": (list, type(None)), "columns": list, "history": int, "modifiers": list, "shape": (list, type(None))}
    ],
    "memory": list,
    "actions": [
        {"name": str, "size": int, "elements": list, "unit": str, "scale": (list, type(None)),
         "offset": (list, type(None)), "clip": (list, type(None)), "limits": (list, type(None)), "columns": list,
         "command": str}
    ],
    "applied": {"before_obs": list, "inside": list, "between_action_and_command": list},
    "deployment": {
        "joints": [
            {"name": str, "entity": str, "qpos": int, "dof": int, "default": float,
             "stiffness": (float, type(None)), "damping": (float, type(None))}
        ],
        "actuators": [{"name": str, "range": (list, type(None))}],
        "observations": [
            {"name": str, "func": str, "params": dict, "columns": list, "history": int, "closed": bool, "value": dict}
        ],
        "controls": [
            {"name": str, "func": str, "ctrl": list, "actuators": list, "closed": bool, "value": dict}
        ],
        "actuator_models": list,
        "commands": list, "start": {"qpos": list, "qvel": list}, "forces_after_reset": bool, "derived": str,
    },
    "normalizer": bool, "action_bound": float, "step_dt": float, "dt": float, "decimation": int, "quaternions": str,
    "policy": str, "task": {"name": str, "distribution": (str, type(None)), "version": (str, type(None))},
    "agent": str, "run": str, "step": int, "seed": int, "versions": {"rlcli": str, "torch": str, "mujoco": str},
}  # fmt: skip


def require_shape(value, schema, path="metadata"):
    if isinstance(schema, dict):
        assert set(value) == set(schema), path
        for key, part in schema.items():
            require_shape(value[key], part, f"{path}.{key}")
    elif isinstance(schema, list):
        assert value, path
        for i, item in enumerate(value):
            require_shape(item, schema[0], f"{path}[{i}]")
    else:
        assert isinstance(value, schema), path


@pytest.mark.parametrize("format_", ["onnx", "torch", "numpy"])
@pytest.mark.parametrize("task", [*POLICIES, "arm"])
def test_metadata_is_complete_and_fits_run(exported, runs, task, format_):
    _, _, metadata, _ = exported(task, format_)
    require_shape(metadata, SCHEMA)
    run = open_run(runs / task.split()[0] / metadata["run"])
    assert metadata["task"]["name"] == task.split()[0]
    assert metadata["agent"] == run.record["agent"]
    assert metadata["seed"] == run.record["seed"]
    assert metadata["step"] == run.record["step"]
    assert metadata["quaternions"] == "wxyz"
    assert metadata["normalizer"] is (task == "cartpole sac")
    assert metadata["versions"]["mujoco"] == run.record["versions"]["mujoco"]
    for terms, width in (
        (metadata["observations"], metadata["input"]["shape"][1]),
        (metadata["actions"], metadata["outputs"]["action"]["shape"][1]),
    ):
        edges = [edge for term in terms for edge in term["columns"]]
        assert edges[0] == 0
        assert edges[-1] == width
        assert edges[1:-1:2] == edges[2::2]


def test_managed_metadata_has_joints_units_scales_limits(exported):
    _, _, metadata, _ = exported("arm")
    rates, angle = metadata["observations"]
    assert rates["elements"] == ["shoulder", "elbow", "wrist"]
    assert rates["unit"] == "m/s or rad/s"
    assert rates["scale"] == [0.1, 0.2, 0.3]
    assert rates["clip"] == [-5.0, 5.0]
    assert angle["elements"] == ["elbow"]
    assert angle["scale"] == [2.0]
    wrist, elbow, shoulder = metadata["actions"]
    assert [term["elements"] for term in (wrist, elbow, shoulder)] == [["wrist"], ["elbow"], ["shoulder"]]
    assert wrist["limits"] == [[-2.0, 2.0]]  # the joint's actuatorfrcrange
    assert wrist["clip"] == [[-3.0, 3.0]] * wrist["size"]
    assert elbow["unit"] == "m or rad"
    assert elbow["offset"] == pytest.approx([0.35])  # the default pose and what the YAML adds
    assert elbow["limits"] == [[-0.5, 0.75]]
    assert shoulder["limits"] == [[-4.5, 3.0]]  # control -1..1.5 under the force range, through a gear of -3
    assert all(term["command"] == "actuator" for term in metadata["actions"])


def test_direct_metadata_marks_command_as_task(exported):
    _, run, metadata, _ = exported("cartpole-direct")
    (actions,) = metadata["actions"]
    assert actions["command"] == "task"
    assert actions["scale"] is None
    assert actions["clip"] == [[-1.0, 1.0]]
    assert actions["elements"] == ["slider_to_cart"]
    assert [(term["name"], term["unit"]) for term in metadata["observations"]] == [
        ("cart_pos", "m"), ("cart_vel", "m/s"), ("pole_pos", "rad"), ("pole_vel", "rad/s"),
    ]  # fmt: skip
    assert {tuple(term["clip"]) for term in metadata["observations"]} == {(-5.0, 5.0)}
    out = run(torch.randn(20, 4))
    assert torch.equal(out["action"], out["command"])


def test_command_equals_cartpole_actuator_input(exported):
    _, run, _, _ = exported("cartpole")
    env = make_env(resolve(find_task("cartpole"), overrides=["scene.num_envs=32"]), seed=3)
    obs = env.reset(seed=3)["policy"]
    seen = []
    for _ in range(20):
        out = run(obs.clone())
        obs = env.step(out["action"]).obs["policy"]
        np.testing.assert_allclose(env.engine.field("ctrl").numpy(), out["command"].numpy(), atol=1e-4, rtol=1e-6)
        seen.append(out["command"])
    env.close()
    assert len(torch.cat(seen).unique()) > 100


def test_command_applies_all_limits_of_arm(exported, runs):
    _, run, _, _ = exported("arm")
    env = make_env(resolve_run(find_run("latest", runs, "arm")[0], play=True), seed=3)
    model = env.engine.model
    names = [model.actuator(i).name.removeprefix("robot/") for i in range(model.nu)]
    for step in range(30):
        # observations far outside training drive every command into its limits
        observation = 40.0 * torch.randn(env.num_envs, 4, generator=torch.Generator().manual_seed(step))
        out = run(observation)
        env.reset()
        env.step(out["action"])
        command = dict(zip(("wrist", "elbow", "shoulder"), out["command"].T, strict=True))
        for world in range(env.num_envs):
            _, data = env.world(world)
            force = dict(zip(names, data.actuator_force, strict=True))
            assert force["m"] * -3.0 == pytest.approx(float(command["shoulder"][world]), abs=1e-4)
            wrist = data.qfrc_actuator[model.joint("robot/wrist").dofadr[0]]
            assert wrist == pytest.approx(float(command["wrist"][world]), abs=1e-4)
            target = np.clip(data.ctrl[names.index("p")], -0.5, 0.75)
            assert target == pytest.approx(float(command["elbow"][world]), abs=1e-5)
    env.close()


def test_action_respects_bound_other_than_one(exported):
    _, run, metadata, _ = exported("arm")
    action = run(1000.0 * torch.randn(1000, 4))["action"]
    assert metadata["action_bound"] == 0.8
    assert float(action.abs().max()) == pytest.approx(0.8)


@pytest.mark.parametrize("format_", ["onnx", "torch", "numpy"])
def test_file_that_differs_from_policy_is_deleted(newest, tmp_path, monkeypatch, format_):
    # the graph is given other weights behind the checker's back
    write = module.formats.write

    def wrong(format_, graph, *rest):
        other = copy.deepcopy(graph)
        other.policy.actor[-1].bias += 1e-3
        return write(format_, other, *rest)

    monkeypatch.setattr(module.formats, "write", wrong)
    file = tmp_path / "deep" / f"policy{module.FORMATS[format_]}"
    with pytest.raises(VerdictError, match=r"output 'action' differs from that of the policy by 0\.001 \(relative\)"):
        export(open_checkpoint(newest("cartpole")), file, format_)
    assert list(tmp_path.iterdir()) == []


def test_failed_export_keeps_previous_file(newest, tmp_path, monkeypatch):
    checkpoint, file = open_checkpoint(newest("cartpole")), tmp_path / "policy.onnx"
    export(checkpoint, file)
    before = file.read_bytes()
    monkeypatch.setattr(module, "TOLERANCE", -1.0)
    with pytest.raises(VerdictError):
        export(checkpoint, file)
    assert file.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["policy.onnx"]


@pytest.mark.parametrize("task", POLICIES)
def test_checkpoint_stores_recent_raw_observations(newest, task):
    checkpoint = open_checkpoint(newest(task))
    observations = checkpoint.tensors("trainer")["observations"]
    assert observations.shape == (160, 4)  # of the reset and of 4 iterations, 32 environments each
    assert observations.dtype == torch.float32
    assert len(observations.unique(dim=0)) > 150
    assert float(observations[-32:, 0].abs().max()) > 0.5  # start positions in metres, not normalised


def test_export_without_recorded_observations_uses_random_ones(newest, tmp_path, monkeypatch):
    checkpoint = open_checkpoint(newest("cartpole"))
    tensors = type(checkpoint).tensors
    older = lambda self, *args: {k: v for k, v in tensors(self, *args).items() if k != "observations"}  # noqa: E731
    monkeypatch.setattr(type(checkpoint), "tensors", older)
    assert export(checkpoint, tmp_path / "policy.onnx").observations == 512
