"""Metadata of an exported file: names, units and scales of its columns, and a description of the environment.

A program that runs the policy reads this metadata. ONNX files also have the metadata that programs for mjlab read.
"""

from collections.abc import Sequence
from typing import Any

from rlcli.deploy.exported_module import DeployedPolicy
from rlcli.errors import listing
from rlcli.runs.checkpoint_reader import Checkpoint
from rlcli.runs.layout_and_deployment import ActionColumns, DeploymentRecord, LayoutRecord, ObservationColumns
from rlcli.runs.run import RECORD

SCHEMA = 2
"""Version of the metadata."""


def metadata_of(
    checkpoint: Checkpoint, graph: DeployedPolicy, layout: LayoutRecord, deployment: DeploymentRecord | None
) -> dict[str, Any]:
    """Return the metadata of an exported policy, as data for JSON.

    Args:
        checkpoint: the checkpoint of the policy.
        graph: the exported policy.
        layout: columns of observations and actions.
        deployment: description of the environment; None: the checkpoint has none.
    """
    manifest, spec = checkpoint.manifest, graph.policy.spec
    task, run = manifest.get("task") or {}, checkpoint.folder.resolve().parent.parent
    normalized = graph.policy.normalizer is not None
    terms = layout.observations[spec.group]
    described = None if deployment is None else deployment.model_dump(mode="json")
    if described is not None:
        described["observations"] = described["observations"][spec.group]

    def output(meaning: str) -> dict[str, Any]:
        return {"shape": ["batch", spec.action_size], "dtype": "float32", "meaning": meaning}

    return {
        "schema": SCHEMA,
        "input": {
            "name": "obs",
            "shape": ["batch", spec.observation_size],
            "dtype": "float32",
            "meaning": f"the observation group '{spec.group}' of the environment: the terms of `observations`"
            " concatenated in order. The value of a term passes its `modifiers`, is clipped to `clip` and multiplied by"
            " `scale`. A term has its last `history` steps, oldest first; the first value of an episode fills all of"
            " them. Nothing else is done before the input",
        },
        "outputs": {
            "action": output("the argument of env.step: the deterministic action, within +-`action_bound`"),
            "command": output(
                "what reaches the actuators, in the `unit` of each term of `actions`: action x `scale` + `offset`,"
                " clipped to `clip`, then to `limits`. If `command` of a term is 'actuator model', this is the target"
                " of the models in `deployment.actuator_models`, which compute forces or torques from it in every"
                " physics step: it is not a control of MuJoCo. If `command` of a term is 'task', this is the action"
                " clipped to `clip`, and the task's own code computes the actuators' command from it"
            ),
        },
        "memory": [
            {
                "input": f"{part}_in",
                "output": f"{part}_out",
                "shape": [len(spec.memory), "batch", spec.memory[0]],
                "single": [len(spec.memory), 1, spec.memory[0]],
                "dtype": "float32",
                "meaning": f"{state} of the recurrent layers: zeros in the first step of an episode, then the output"
                f" {part}_out of the last step",
            }
            for part, state in (("h", "hidden states"), ("c", "cell states"))
            if spec.memory
        ],
        "observations": _with_columns(terms),
        "actions": [{**term, "command": _receiver(term, described)} for term in _with_columns(layout.actions)],
        "applied": {
            "before_obs": ["observations.modifiers", "observations.clip", "observations.scale", "observations.history"],
            "inside": [*(["normalizer"] if normalized else []), "action_bound"],
            "between_action_and_command": ["actions.scale", "actions.offset", "actions.clip", "actions.limits"],
        },
        "deployment": described,
        "normalizer": normalized,
        "action_bound": spec.action_bound,
        "step_dt": layout.step_dt,
        "dt": layout.dt,
        "decimation": layout.decimation,
        "quaternions": "wxyz",
        "policy": spec.kind,
        "task": {key: task.get(key) for key in ("name", "distribution", "version")},
        "agent": manifest.get("agent"),
        "run": run.name if (run / RECORD).is_file() else None,
        "step": checkpoint.step,
        "seed": manifest.get("seed"),
        "versions": {key: (manifest.get("versions") or {}).get(key) for key in ("rlcli", "torch", "mujoco")},
    }


def required_inputs(metadata: dict[str, Any]) -> dict[str, int]:
    """Return the number of values of each input that `Controller.act` of `run_policy.py` needs, by name.

    The inputs are the commands, and the observations without a formula, which only the task's code can compute.
    """
    deployment = metadata["deployment"] or {"commands": [], "observations": []}
    sizes = {f"command/{command['name']}": command["size"] for command in deployment["commands"]}
    for term in deployment["observations"]:
        if not term["closed"]:
            sizes[term["value"]["given"]] = (term["columns"][1] - term["columns"][0]) // term["history"]
    return sizes


def terms_of_task_code(metadata: dict[str, Any]) -> list[str]:
    """Return one sentence for each term that `run_policy.py` cannot compute, because it has no formula."""
    deployment, sizes = metadata["deployment"] or {"observations": [], "controls": []}, required_inputs(metadata)
    return (
        [
            f"run_policy.py cannot compute observation {term['name']}, which only the task's code computes: pass"
            f" inputs['{term['value']['given']}'] ({sizes[term['value']['given']]} values of one step, with modifiers,"
            " clip and scale applied)"
            for term in deployment["observations"]
            if not term["closed"]
        ]
        + [
            f"run_policy.py cannot compute the controls of action {term['name']}, which only the task's code computes:"
            " compute them from Controller.command"
            for term in deployment["controls"]
            if not term["closed"]
        ]
        + [
            f"run_policy.py cannot compute the actuator model {model['name']} ({_obstacle(model)}): compute the efforts"
            f" of {listing(model['joints'])} before every physics step"
            for model in deployment.get("actuator_models", [])
            if not model["closed"]
        ]
    )


def _obstacle(model: dict[str, Any]) -> str:
    """Return why an actuator model has no formula, as text for a message."""
    if model["kind"] == "own":
        return "a class of the task's code"
    return "its targets are delayed" if any(model["delay"]) else "the task's code sets its targets"


def _receiver(term: dict[str, Any], deployment: dict[str, Any] | None) -> str:
    """Return what receives the command of an action term: `actuator`, `actuator model`, or `task` for its own code."""
    if term["scale"] is None:
        return "task"
    deployment = deployment or {"controls": []}
    driven = {ctrl for control in deployment["controls"] if control["name"] == term["name"] for ctrl in control["ctrl"]}
    return (
        "actuator model"
        if any(driven & set(model["ctrl"]) for model in deployment.get("actuator_models", []))
        else "actuator"
    )


def mjlab_properties(metadata: dict[str, Any], entity: str = "robot") -> dict[str, str]:
    """Return the metadata properties of mjlab 1.6's ONNX files, which programs for mjlab can read.

    Items of a list are separated by commas, items of an inner list by semicolons. A property is left out if the
    metadata has no values for it, or if a name in its list contains a separator.

    Args:
        metadata: the metadata, as from `metadata_of`.
        entity: the robot whose joints are listed; if the task has no entity of this name, the first entity with joints.
    """
    terms, actions = metadata["observations"], metadata["actions"]
    widths = [term["size"] // term["history"] for term in terms]
    scales = [term["scale"][:width] if term["scale"] else [1.0] for term, width in zip(terms, widths, strict=True)]
    lists: dict[str, list[Any]] = {
        "observation_names": [term["name"] for term in terms],
        "observation_terms_scale": [scale if len(set(scale)) > 1 else scale[0] for scale in scales],
        "observation_terms_flatten_history_dim": [True for _ in terms],
        "observation_terms_history_length": [term["history"] if term["history"] > 1 else 0 for term in terms],
        "observation_terms_clip": [term["clip"] or [float("-inf"), float("inf")] for term in terms],
    }
    if all(term["scale"] for term in actions):
        lists["action_scale"] = [scale for term in actions for scale in term["scale"]]
    deployment = metadata["deployment"]
    if deployment is not None:
        entities = [joint["entity"] for joint in deployment["joints"]]
        owner = entity if entity in entities else (entities or [None])[0]
        joints = [joint for joint in deployment["joints"] if joint["entity"] == owner]
        driven = [joint for joint in joints if joint["stiffness"] is not None]
        lists |= {
            "joint_names": [joint["name"] for joint in joints],
            "joint_stiffness": [joint["stiffness"] for joint in driven],
            "joint_damping": [joint["damping"] for joint in driven],
            "default_joint_pos": [joint["default"] for joint in joints],
            "command_names": [command["name"] for command in deployment["commands"]],
        }
    properties = {"run_path": str(metadata["run"] or "")}
    for name, values in lists.items():
        if not any(isinstance(value, str) and ("," in value or ";" in value) for value in values):
            properties[name] = ",".join(map(_entry, values))
    return properties


def _entry(value: object) -> str:
    if isinstance(value, list):
        return ";".join(map(_entry, value))
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _with_columns(terms: Sequence[ObservationColumns | ActionColumns]) -> list[dict[str, Any]]:
    """Return the layout of terms as data for JSON; `columns` is a term's first column and the column after its last."""
    entries, begin = [], 0
    for term in terms:
        entries.append({**term.model_dump(mode="json"), "columns": [begin, begin + term.size]})
        begin += term.size
    return entries
