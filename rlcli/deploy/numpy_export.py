"""Export of a policy to one Python file that needs only numpy.

The file is the template `deployed/policy.py`, filled with the weights and the metadata.
"""

import base64
import io
import json
import pprint
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.deploy.exported_module import DeployedPolicy

_TEMPLATE = Path(__file__).parent / "deployed" / "policy.py"


def numpy_bytes(graph: DeployedPolicy, metadata: str) -> bytes:
    """Return the content of the exported Python file: readable code, then the weights as an npz file in base64.

    `metadata` is JSON text.
    """
    weights = io.BytesIO()
    np.savez(weights, **_weights(graph))  # type: ignore[arg-type]
    text = _TEMPLATE.read_text(encoding="utf-8")
    code, _, tail = text.partition("_W = {}\n")
    lines = textwrap.wrap(base64.b64encode(weights.getvalue()).decode(), 110)
    packed = "WEIGHTS = (\n" + "\n".join(f'    "{line}"' for line in lines) + "\n)\n"
    # values of an untrusted checkpoint become literals, so that none of them can be executed as code
    values = {
        "METADATA: dict = {}": f"METADATA = {literal(json.loads(metadata))}",
        "NETWORK: dict = {}": f"NETWORK = {literal(_network(graph))}",
        'WEIGHTS = ""\n': "",
    }
    code = substitute(code, values)
    return (code + packed + "_W = {}\n" + tail).encode("ascii")


def read_numpy(file: Path) -> tuple[Any, str]:
    """Execute an exported Python file; return the policy as a `PolicyFunction`, and the metadata as JSON text.

    Call this function only with a file that this process has written.
    """
    space: dict[str, Any] = {"__name__": "policy"}
    exec(compile(file.read_text(encoding="utf-8"), str(file), "exec"), space)

    def run(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        out = space["run"]({name: value.numpy() for name, value in inputs.items()})
        return {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in out.items()}

    return run, json.dumps(space["METADATA"])


def literal(value: object) -> str:
    """Return data of JSON types (dicts, lists, numbers, strings, None) as Python source code in ASCII."""
    return pprint.pformat(value, width=110, sort_dicts=False).encode("ascii", "backslashreplace").decode()


def substitute(template: str, values: Mapping[str, str]) -> str:
    """Replace each key of `values` in a text by its value, in one pass: keys inside of values are not replaced."""
    return re.sub("|".join(map(re.escape, values)), lambda found: values[found[0]], template)


def _network(graph: DeployedPolicy) -> dict[str, Any]:
    spec = graph.policy.spec
    normalizer = graph.policy.normalizer
    bounds = [values.double() for values in (graph.clip, graph.limits) if values is not None]
    vision = spec.vision
    return {
        "kind": spec.kind,
        "normalize": normalizer is not None,
        "normalize_clip": None if normalizer is None else normalizer.clip,
        "lstm_sizes": list(spec.memory),
        "images": [] if vision is None else [(p.start, p.steps, *p.shape) for p in vision.pictures],
        "motion": None if vision is None else vision.motion,
        "kernels_and_strides": [] if vision is None else list(zip(vision.kernels, vision.strides, strict=True)),
        "layers": len(spec.hidden) + 1,
        "activation": spec.activation,
        "squashed": not spec.kind.startswith("gaussian-"),
        "bound": spec.action_bound,
        "scaled": graph.scaled,
        # Python has no literal for infinity; 3.4e38 is nearly the largest float32
        "bounds": [values.nan_to_num(posinf=3.4e38, neginf=-3.4e38).tolist() for values in bounds],
    }


def _weights(graph: DeployedPolicy) -> dict[str, np.ndarray]:
    policy, arrays = graph.policy, {}
    if policy.normalizer is not None:
        arrays["mean"] = policy.normalizer.mean.float()
        arrays["scale"] = (policy.normalizer.var + policy.normalizer.EPSILON).rsqrt().float()
    if policy.memory is not None:
        for number, cell in enumerate(policy.memory.layers):
            assert isinstance(cell, torch.nn.LSTMCell)
            arrays |= {f"in{number}": cell.weight_ih, f"rec{number}": cell.weight_hh}
            arrays[f"bias{number}"] = cell.bias_ih.double() + cell.bias_hh.double()
    if policy.vision is not None:
        for image, layers in enumerate(policy.vision.pictures):
            convolutions = [layer for layer in layers.modules() if isinstance(layer, torch.nn.Conv2d)]
            for number, conv in enumerate(convolutions):
                assert conv.bias is not None
                arrays |= {f"cw{image}_{number}": conv.weight.flatten(1), f"cb{image}_{number}": conv.bias}
    linear = [layer for layer in policy.actor if isinstance(layer, torch.nn.Linear)]
    for number, layer in enumerate(linear):
        arrays |= {f"w{number}": layer.weight, f"b{number}": layer.bias}
    arrays |= {"command_scale": graph.scale, "command_offset": graph.offset}
    return {name: value.detach().numpy() for name, value in arrays.items()}
