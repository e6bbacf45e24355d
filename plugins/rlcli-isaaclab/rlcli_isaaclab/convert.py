"""Conversion of Isaac Lab's settings (nested dicts) to a task of rlcli. Keys without a counterpart are reported.

The settings come from configuration classes in Python, or from the YAML files that Isaac Lab writes into runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli_isaaclab.config_class import is_missing, to_dict
from rlcli_isaaclab.reset_state import keeps_state
from rlcli_isaaclab.scene_reader import SceneReader
from rlcli_isaaclab.settings import Key, Node, Report, as_float, kind_of
from rlcli_isaaclab.term_reader import TermReader
from rlcli_isaaclab.user_actuators import actuator_events


def task(
    data: Mapping[str, Any],
    report: Report,
    root: Path,
    defaults: Any = None,
    models: Mapping[str, Any] | None = None,
    cfg: Any = None,
) -> dict[str, Any]:
    """Return the content of a `task.yaml` for the settings of a `ManagerBasedRLEnvCfg`.

    Args:
        data: settings as nested dicts.
        report: receives how each key was translated.
        root: folder to which paths of models are relative.
        defaults: default settings, as nested dicts; keys with the default value are not reported.
        models: entity -> MJCF that replaces its USD file.
        cfg: the user's configuration object, which the user's terms may read.

    Raises:
        ConfigError: if the settings do not describe a valid task.
    """
    data = {**data, **{name: _own_members(data[name], name, report) for name in _OPTIONAL if name in data}}
    top = Node(data, (), report)
    for section in _SECTIONS:
        _check_members(data.get(section), (section,), report)
    config: dict[str, Any] = {
        "decimation": top.require("decimation"),
        "episode_length_s": as_float(top.require("episode_length_s")),
        "sim": read_sim(top.node("sim")),
        "viewer": read_viewer(top.node("viewer")),
    }
    scene = SceneReader(top.node("scene"), root, models)
    config["scene"] = scene.read()
    terms = TermReader(scene, report, cfg, data)
    terms.record_driven_joints(top.node("actions"))
    config["actions"] = {name: terms.read_action(node) for name, node in top.node("actions").nodes()}
    config["observations"] = {name: terms.read_group(node) for name, node in top.node("observations").nodes()}
    if "policy" not in config["observations"] and "actor" in config["observations"]:
        config["observations"]["policy"] = config["observations"].pop("actor")  # the name in RSL-RL 5
    for section in ("events", "rewards", "terminations", "curriculum"):
        terms_of_section = (terms.read_terms(section, *member) for member in top.node(section).nodes())
        config[section] = {name: term for pairs in terms_of_section for name, term in pairs}
    config["events"] |= actuator_events(scene.user_actuators)
    if keeps_state(config["events"], scene, config["scene"]["entities"]):
        config["keep_state_at_reset"] = True
    if not config["rewards"]:
        config["rewards"] = {"no_reward": {"func": "is_alive", "weight": 0.0}}
    config["commands"] = {name: terms.read_command(node) for name, node in top.node("commands").nodes()}
    scene.add_joint_settings(terms.driven_joints)
    config["sim"] |= scene.integrator()
    for section in ("events", "curriculum", "commands"):
        if not config[section]:
            del config[section]
    note_general_settings(top)
    top.mark_mapped("export_io_descriptors", "recorders", "teleop_devices")
    report.stubs = terms.stubs
    report.finish(data, defaults)
    return {key: value for key, value in config.items() if value is not None}


def note_general_settings(top: Node) -> None:
    """Note the settings without an effect in rlcli that manager-based and direct tasks have in common."""
    top.mark_mapped(
        "ui_window_class_type", "wait_for_textures", "rerender_on_reset", "num_rerenders_on_reset", "log_dir"
    )
    top.mark_mapped("xr", "is_finite_horizon")
    if top.data.get("is_finite_horizon"):
        top.note("ignored", "is_finite_horizon", "rlcli always bootstraps at a time-out")
    if "seed" in top:
        top.note("ignored", "seed", "set the seed on the command line: --seed N")


_OPTIONAL = ("events", "terminations", "curriculum", "commands")
"""Sections of a manager-based configuration that may be missing."""


def _own_members(value: Any, section: str, report: Report) -> Any:
    """Return the settings of a section such as `rewards`, from its configuration object.

    As in Isaac Lab, an object without @configclass has only the attributes of the object itself, not of its class.
    """
    if not hasattr(value, "__dict__") or isinstance(value, type) or is_missing(value):
        return value
    kind = type(value).__name__
    report.entries[(section,)] = ("ignored", f"the class {kind} has no @configclass: Isaac Lab reads no terms of it")
    return to_dict(vars(value))


_SECTIONS = ("actions", "observations", "events", "rewards", "terminations", "curriculum")


def _check_members(value: Any, key: Key, report: Report) -> None:
    """Report values that are missing, and functions where a term is expected."""
    for name, item in value.items() if isinstance(value, Mapping) else ():
        if is_missing(item):
            report.problem(key, f"missing '{name}'; give it a value")
        elif callable(item) and (len(key) == 1 or (len(key) == 2 and key[0] == "observations")) and name != "func":
            report.problem(
                (*key, str(name)), "found a function, expected a term", "write NAME = ...TermCfg(func=FUNCTION)"
            )
        elif isinstance(item, Mapping):
            _check_members(item, (*key, str(name)), report)


def agent(data: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Return the settings of a `ppo` agent for the settings of a `RslRlOnPolicyRunnerCfg`.

    Args:
        data: settings as nested dicts.
        report: receives how each key was translated.

    Raises:
        ConfigError: if a setting is missing or wrong.
    """
    top = Node(data, (), report)
    policy, algorithm = _policy(top), top.node("algorithm")
    bound = top.get("clip_actions")
    config: dict[str, Any] = {
        "trainer": "ppo",
        "algorithm": "ppo",
        "dialect": "rsl_rl",
        "max_iterations": top.require("max_iterations"),
        "save_interval": _save_interval(top),
        "num_steps": top.require("num_steps_per_env"),
        "action_bound": None if bound is None else as_float(bound),
        "actor": _network(policy, "actor_hidden_dims"),
        "critic": _network(policy, "critic_hidden_dims"),
        "init_std": as_float(policy.get("init_noise_std", 1.0)),
        "std": policy.get("noise_std_type", "scalar"),
    }
    normalized = policy.get("actor_obs_normalization", top.get("empirical_normalization", False))
    if bool(policy.get("critic_obs_normalization", normalized)) != bool(normalized):
        policy.note("approximated", "critic_obs_normalization", "actor and critic share one observation normaliser")
    config["normalize_observations"] = bool(normalized)
    _require_class(top, "OnPolicyRunner")
    _require_class(algorithm, "PPO")
    if _require_class(policy, "ActorCritic", "ActorCriticRecurrent") == "ActorCriticRecurrent":
        config["rnn"] = {
            "type": policy.require("rnn_type"),
            "hidden": policy.get("rnn_hidden_dim", 256),
            "layers": policy.get("rnn_num_layers", 1),
        }
    adaptive = algorithm.get("schedule", "adaptive") == "adaptive"
    config |= {
        "num_epochs": algorithm.require("num_learning_epochs"),
        "num_minibatches": algorithm.require("num_mini_batches"),
        "learning_rate": as_float(algorithm.require("learning_rate")),
        "schedule": "adaptive" if adaptive else "constant",
        "desired_kl": algorithm.get("desired_kl") if adaptive else None,
        "gamma": algorithm.require("gamma"),
        "lam": algorithm.require("lam"),
        "entropy_coef": algorithm.require("entropy_coef"),
        "max_grad_norm": algorithm.require("max_grad_norm"),
        "value_coef": algorithm.require("value_loss_coef"),
        "clip_value": "larger" if algorithm.get("use_clipped_value_loss", True) else None,
        "clip_range": algorithm.require("clip_param"),
        "normalize_advantage": "minibatch" if algorithm.get("normalize_advantage_per_mini_batch") else "batch",
    }
    symmetry = algorithm.node("symmetry_cfg")
    augment, loss = symmetry.get("use_data_augmentation"), symmetry.get("use_mirror_loss")
    coefficient = as_float(symmetry.get("mirror_loss_coeff", 0.0))
    coefficient = coefficient if loss else 0.0
    if augment or coefficient:
        config["symmetry"] = {"augment": bool(augment), "mirror_coef": coefficient}
        how = "the mirror image of left and right, found from the model, replaces the function"
        symmetry.note("approximated", "data_augmentation_func", how)
    if str(algorithm.get("optimizer", "adam")).lower() != "adam":
        algorithm.note("ignored", "optimizer", "rlcli's ppo uses Adam")
    algorithm.mark_mapped("desired_kl")
    top.mark_mapped(
        "obs_groups",
        "logger",
        "neptune_project",
        "wandb_project",
        "resume",
        "load_run",
        "load_checkpoint",
    )
    for name, option in (
        ("seed", "--seed"),
        ("device", "--device"),
        ("experiment_name", "--name"),
        ("run_name", "--name"),
    ):
        default = {"seed": 42, "device": "cuda:0"}.get(name)
        if top.data.get(name) == default:
            top.mark_mapped(name)
        elif top.data.get(name):
            top.note("ignored", name, f"use the option {option} of rlcli")
    report.finish(data)
    return config


def _require_class(node: Node, *known: str) -> str:
    """Return the name of RSL-RL's class that settings belong to, without its module; report any class but the known."""
    value = node.get("class_name", known[0])
    name = kind_of(value)
    if name not in known:
        what = f"the class '{name}' has no counterpart in rlcli, which trains RSL-RL's {' or '.join(known)}"
        node.report.problem((*node.key, "class_name"), what, f"write {known[0]}, or register another agent")
    return name


def _save_interval(top: Node) -> Any:
    """Return the number of iterations between checkpoints; None if the setting has another form, which is noted."""
    value = top.require("save_interval")
    if isinstance(value, Mapping | list | tuple):
        top.note("ignored", "save_interval", "rlcli reads a number of iterations; it chooses the checkpoints itself")
        return None
    return value


def _policy(top: Node) -> Node:
    """Return the settings of actor and critic, with the keys of the setting `policy` of RSL-RL before version 5.

    RSL-RL 5 has the settings `actor` and `critic` instead, whose keys are translated.
    """
    if "policy" in top or "actor" not in top:
        return top.node("policy")
    actor, critic = top.node("actor"), top.node("critic")
    recurrent = [_require_class(model, "MLPModel", "RNNModel") == "RNNModel" for model in (actor, critic)]
    memory = [{key: model.get(key) for key in _RNN_KEYS} for model in (actor, critic)]
    if recurrent[0] != recurrent[1] or (all(recurrent) and memory[0] != memory[1]):
        what = "the networks of actor and critic differ in class_name or in their rnn_ settings"
        top.report.problem(critic.key, what, "give both networks the same class_name, rnn_type and rnn_hidden_dim")
    distribution = actor.node("distribution_cfg")
    if distribution.get("class_name", "GaussianDistribution").rpartition(".")[2] != "GaussianDistribution":
        what = "this distribution of actions has no counterpart in rlcli"
        top.report.problem(distribution.key, what, "use GaussianDistribution")
    if critic.get("activation", "elu") != actor.get("activation", "elu"):
        critic.note("approximated", "activation", "both networks have the activation of the actor")
    data = {
        "actor_hidden_dims": actor.get("hidden_dims"),
        "critic_hidden_dims": critic.get("hidden_dims"),
        "activation": actor.get("activation"),
        "actor_obs_normalization": bool(actor.get("obs_normalization", False)),
        "critic_obs_normalization": bool(critic.get("obs_normalization", False)),
        "init_noise_std": distribution.get("init_std", 1.0),
        "noise_std_type": distribution.get("std_type", "scalar"),
    }
    if recurrent[0]:
        data |= {"class_name": "ActorCriticRecurrent", **memory[0]}
    top.get("policy")
    return Node(data, ("policy",), top.report)


_RNN_KEYS = ("rnn_type", "rnn_hidden_dim", "rnn_num_layers")


def _network(policy: Node, name: str) -> dict[str, Any]:
    return {"hidden": list(policy.require(name) or []), "activation": policy.get("activation", "elu")}


def read_sim(node: Node) -> dict[str, Any]:
    """Return the section `sim:` of the task."""
    config: dict[str, Any] = {"dt": as_float(node.get("dt", 1.0 / 60.0))}
    interval = node.get("render_interval", 1)
    if interval != 1:
        config["render_interval"] = interval
    gravity = [as_float(g) for g in node.get("gravity", (0.0, 0.0, -9.81))]
    if gravity != [0.0, 0.0, -9.81]:
        config["gravity"] = gravity
    node.mark_mapped(
        "physics_prim_path", "use_fabric", "enable_scene_query_support", "render", "create_stage_in_memory"
    )
    node.mark_mapped("logging_level", "save_logs_to_file", "log_dir")
    if "device" in node:
        node.mark_mapped("device")
    material = node.data.get("physics_material")
    if isinstance(material, Mapping) and material:
        plain = material.get("static_friction", 0.5) == 0.5 and material.get("dynamic_friction", 0.5) == 0.5
        if plain:
            node.mark_mapped("physics_material")
        else:
            text = "the MJCF sets the friction of bodies; scene.ground.friction sets the friction of the ground"
            node.note("ignored", "physics_material", text)
    if node.data.get("physx"):
        text = "MuJoCo's solver has its own settings: sim.iterations, sim.ls_iterations, the <option> of the MJCF"
        node.note("ignored", "physx", text)
    return config


def read_viewer(node: Node) -> dict[str, Any]:
    """Return the section `viewer:` of the task."""
    config = {
        "eye": [as_float(v) for v in node.get("eye", (7.5, 7.5, 7.5))],
        "lookat": [as_float(v) for v in node.get("lookat", (0.0, 0.0, 0.0))],
    }
    resolution = node.get("resolution", (1280, 720))
    if tuple(resolution) != (1280, 720):
        config["width"], config["height"] = resolution
    node.mark_mapped("cam_prim_path", "env_index", "asset_name", "body_name")
    if node.get("origin_type", "world") not in ("world", "env"):
        node.note("ignored", "origin_type", "the camera does not follow an asset")
    return config
