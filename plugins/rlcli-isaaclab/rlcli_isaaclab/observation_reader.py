"""Reader of the operations on an observation term's value: modifiers, noise, clip, scale and history."""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.settings import Node, as_float, kind_of, to_plain


def read_processing(node: Node) -> dict[str, Any]:
    """Return rlcli's keys for the operations on an observation: modifiers, noise, clip, scale and history."""
    config: dict[str, Any] = {}
    modifiers = node.get("modifiers")
    if modifiers:
        config["modifiers"] = [_read_modifier(Node(m, (*node.key, "modifiers"), node.report)) for m in modifiers]
    if "noise" in node:
        noise = node.node("noise")
        kind = kind_of(noise.get("class_type"))
        if kind:
            noise.mark_mapped("sample_bias_per_component", "func")
            config["noise"] = _read_noise(noise.node("noise_cfg"))
            if "bias_noise_cfg" in noise:
                config["bias"] = _read_noise(noise.node("bias_noise_cfg"))
        else:
            config["noise"] = _read_noise(noise)
    if "noise" not in node:
        node.mark_mapped("noise")
    clip, scale = node.get("clip"), node.get("scale")
    if clip is not None:
        config["clip"] = [as_float(v) for v in clip]
    if scale is not None:
        config["scale"] = to_plain(scale)
    history = node.get("history_length", 0)
    if history:
        config["history"] = history
    node.mark_mapped("flatten_history_dim")
    return config


def _read_noise(node: Node) -> dict[str, Any]:
    """Return the settings of one noise: uniform, gaussian or constant."""
    operation = node.get("operation", "add")
    config: dict[str, Any] = {} if operation == "add" else {"operation": "set" if operation == "abs" else operation}
    node.mark_mapped("func")
    if "n_min" in node.data:
        return {"kind": "uniform", "low": to_plain(node.get("n_min")), "high": to_plain(node.get("n_max")), **config}
    if "std" in node.data:
        return {"kind": "gaussian", "mean": to_plain(node.get("mean", 0.0)), "std": to_plain(node.get("std")), **config}
    return {"kind": "constant", "value": to_plain(node.get("bias", node.get("value", 0.0))), **config}


def _read_modifier(node: Node) -> dict[str, Any]:
    """Return the settings of one modifier."""
    kind, params = kind_of(node.get("func")), node.node("params")
    if kind == "scale":
        return {"kind": "scale", "factor": to_plain(params.get("multiplier"))}
    if kind == "bias":
        return {"kind": "bias", "offset": to_plain(params.get("value"))}
    if kind == "clip":
        return {"kind": "clip", "bounds": to_plain(params.get("bounds"))}
    if kind == "DigitalFilter":
        return {"kind": "digital_filter", "a": to_plain(node.get("A")), "b": to_plain(node.get("B"))}
    if kind == "Integrator":
        return {"kind": "integrator"}
    node.report.problem(node.key, f"the modifier '{kind}' has no counterpart in rlcli; remove it")
    return {"kind": "integrator"}
