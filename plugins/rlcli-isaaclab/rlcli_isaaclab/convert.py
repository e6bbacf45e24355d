"""Isaac Lab's settings, as nested dicts, to the data of a task. What has no counterpart is reported by name.

Both front ends come through here: configuration classes in Python, and the YAML files that Isaac Lab writes into runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli_isaaclab.config_class import is_missing
from rlcli_isaaclab.scene_reader import SceneReader
from rlcli_isaaclab.settings import Key, Node, Report, as_float
from rlcli_isaaclab.term_reader import Terms


def task(
    data: Mapping[str, Any],
    report: Report,
    root: Path,
    defaults: Any = None,
    models: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """The task that settings of a `ManagerBasedRLEnvCfg` describe; `models` name an MJCF for entities."""
    top = Node(data, (), report)
    for section in _TERMS:
        _check_members(data.get(section), (section,), report)
    made: dict[str, Any] = {
        "decimation": top.need("decimation"),
        "episode_length_s": as_float(top.need("episode_length_s")),
        "sim": _sim(top.node("sim")),
        "viewer": _viewer(top.node("viewer")),
    }
    scene = SceneReader(top.node("scene"), root, models)
    made["scene"] = scene.read()
    convert = Terms(scene, report)
    convert.driven(top.node("actions"))
    made["actions"] = {name: convert.action(node) for name, node in top.node("actions").nodes()}
    made["observations"] = {name: convert.group(node) for name, node in top.node("observations").nodes()}
    for section in ("events", "rewards", "terminations", "curriculum"):
        made[section] = {
            name: term for node in top.node(section).nodes() for name, term in convert.terms(section, *node)
        }
    made["commands"] = {name: convert.command(node) for name, node in top.node("commands").nodes()}
    scene.finish(convert.joints_driven)
    for section in ("events", "curriculum", "commands"):
        if not made[section]:
            del made[section]
    if top.data.get("is_finite_horizon"):
        top.say("ignored", "is_finite_horizon", "a time-out is bootstrapped")
    top.skip("ui_window_class_type", "wait_for_textures", "rerender_on_reset", "export_io_descriptors", "log_dir")
    top.skip("recorders", "teleop_devices", "xr", "is_finite_horizon")
    if "seed" in top:
        top.say("ignored", "seed", "--seed says it")
    report.stubs = convert.stubs
    report.finish(data, defaults)
    return {key: value for key, value in made.items() if value is not None}


_TERMS = ("actions", "observations", "events", "rewards", "terminations", "curriculum")


def _check_members(value: Any, key: Key, report: Report) -> None:
    """Note values that were never given, and functions where a term is wanted."""
    for name, item in value.items() if isinstance(value, Mapping) else ():
        if is_missing(item):
            report.problem(key, f"missing '{name}'")
        elif callable(item) and (len(key) == 1 or (len(key) == 2 and key[0] == "observations")) and name != "func":
            report.problem((*key, str(name)), "found a function, expected a term", "write ...TermCfg(func=...)")
        elif isinstance(item, Mapping):
            _check_members(item, (*key, str(name)), report)


def agent(data: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The `ppo` agent that settings of a `RslRlOnPolicyRunnerCfg` describe."""
    top = Node(data, (), report)
    policy, algorithm = top.node("policy"), top.node("algorithm")
    bound = top.get("clip_actions")
    made: dict[str, Any] = {
        "trainer": "ppo",
        "algorithm": "ppo",
        "dialect": "rsl_rl",
        "max_iterations": top.need("max_iterations"),
        "save_interval": top.need("save_interval"),
        "num_steps": top.need("num_steps_per_env"),
        "action_bound": None if bound is None else as_float(bound),
        "actor": _network(policy, "actor_hidden_dims"),
        "critic": _network(policy, "critic_hidden_dims"),
        "init_std": as_float(policy.get("init_noise_std", 1.0)),
        "std": policy.get("noise_std_type", "scalar"),
    }
    normalized = policy.get("actor_obs_normalization", top.get("empirical_normalization", False))
    if bool(policy.get("critic_obs_normalization", normalized)) != bool(normalized):
        policy.say("approximated", "critic_obs_normalization", "actor and critic share one normaliser")
    made["normalize_observations"] = bool(normalized)
    if policy.get("class_name", "ActorCritic") == "ActorCriticRecurrent":
        made["rnn"] = {
            "type": policy.need("rnn_type"),
            "hidden": policy.get("rnn_hidden_dim", 256),
            "layers": policy.get("rnn_num_layers", 1),
        }
    groups = top.get("obs_groups")
    if isinstance(groups, Mapping):
        if list(groups.get("policy", ["policy"])) != ["policy"]:
            top.say("ignored", "obs_groups", "the policy sees the group 'policy'")
        if groups.get("critic"):
            made["critic_obs"] = list(groups["critic"])
    adaptive = algorithm.get("schedule", "adaptive") == "adaptive"
    made |= {
        "num_epochs": algorithm.need("num_learning_epochs"),
        "num_minibatches": algorithm.need("num_mini_batches"),
        "learning_rate": as_float(algorithm.need("learning_rate")),
        "schedule": "adaptive" if adaptive else "constant",
        "desired_kl": algorithm.get("desired_kl") if adaptive else None,
        "gamma": algorithm.need("gamma"),
        "lam": algorithm.need("lam"),
        "entropy_coef": algorithm.need("entropy_coef"),
        "max_grad_norm": algorithm.need("max_grad_norm"),
        "value_coef": algorithm.need("value_loss_coef"),
        "clip_value": "larger" if algorithm.get("use_clipped_value_loss", True) else None,
        "clip_range": algorithm.need("clip_param"),
        "normalize_advantage": "minibatch" if algorithm.get("normalize_advantage_per_mini_batch") else "batch",
    }
    algorithm.skip("class_name", "desired_kl")
    top.skip("class_name", "logger", "neptune_project", "wandb_project", "resume", "load_run", "load_checkpoint")
    for name, why in (
        ("seed", "--seed"),
        ("device", "--device"),
        ("experiment_name", "--name"),
        ("run_name", "--name"),
    ):
        default = {"seed": 42, "device": "cuda:0"}.get(name)
        if top.data.get(name) == default:
            top.skip(name)
        elif top.data.get(name):
            top.say("ignored", name, f"{why} says it")
    report.finish(data)
    return made


def _network(policy: Node, name: str) -> dict[str, Any]:
    return {"hidden": list(policy.need(name) or []), "activation": policy.get("activation", "elu")}


def _sim(node: Node) -> dict[str, Any]:
    made: dict[str, Any] = {"dt": as_float(node.get("dt", 1.0 / 60.0))}
    interval = node.get("render_interval", 1)
    if interval != 1:
        made["render_interval"] = interval
    gravity = [as_float(g) for g in node.get("gravity", (0.0, 0.0, -9.81))]
    if gravity != [0.0, 0.0, -9.81]:
        made["gravity"] = gravity
    node.skip("physics_prim_path", "use_fabric", "enable_scene_query_support", "render", "create_stage_in_memory")
    if "device" in node:
        node.skip("device")
    material = node.data.get("physics_material")
    if isinstance(material, Mapping) and material:
        plain = material.get("static_friction", 0.5) == 0.5 and material.get("dynamic_friction", 0.5) == 0.5
        if plain:
            node.skip("physics_material")
        else:
            node.say("ignored", "physics_material", "friction is the MJCF's; scene.ground.friction for the ground")
    if node.data.get("physx"):
        node.say("ignored", "physx", "MuJoCo's solver has its own settings: sim.integrator, sim.iterations")
    return made


def _viewer(node: Node) -> dict[str, Any]:
    made = {
        "eye": [as_float(v) for v in node.get("eye", (7.5, 7.5, 7.5))],
        "lookat": [as_float(v) for v in node.get("lookat", (0.0, 0.0, 0.0))],
    }
    resolution = node.get("resolution", (1280, 720))
    if tuple(resolution) != (1280, 720):
        made["width"], made["height"] = resolution
    node.skip("cam_prim_path", "env_index", "asset_name", "body_name")
    if node.get("origin_type", "world") not in ("world", "env"):
        node.say("ignored", "origin_type", "the camera stands still")
    return made
