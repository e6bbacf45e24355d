"""A trained policy that needs only numpy: `outputs = run({"obs": obs})`, rows of float32 in and out.

`METADATA` describes the columns. The outputs are `action`, the argument of env.step, and `command`, what the actuators
receive. A recurrent policy also has the inputs `h_in` and `c_in`, zeros when an episode begins, and the outputs `h_out`
and `c_out`, the inputs of the next step. `run` stores nothing between calls; an `Episode` does.
"""

import base64
import io

import numpy as np

METADATA: dict = {}
NETWORK: dict = {}
WEIGHTS = ""


def run(inputs):
    """Compute the outputs, (n, columns) each, from observations (n, observations). Layers compute in float64."""
    x = np.asarray(inputs["obs"], np.float32)
    _require_columns("obs", x, [(term["name"], term["size"]) for term in METADATA["observations"]])
    if NETWORK["normalize"]:
        x = (x - _W["mean"]) * _W["scale"]
        clip = NETWORK["normalize_clip"]
        x = x if clip is None else np.clip(x, -clip, clip)
    x, outputs = x.astype(np.float64), {}
    if NETWORK["images"]:
        x = _convolve_images(x)
    if NETWORK["lstm_sizes"]:
        hidden, cells = [], []
        for layer, (h, c) in enumerate(zip(inputs["h_in"], inputs["c_in"], strict=True)):
            gates = x @ _W[f"in{layer}"].T + h.astype(np.float64) @ _W[f"rec{layer}"].T + _W[f"bias{layer}"]
            i, f, g, o = np.split(gates, 4, axis=1)
            c = _sigmoid(f) * c + _sigmoid(i) * np.tanh(g)
            x = _sigmoid(o) * np.tanh(c)
            hidden.append(x)
            cells.append(c)
        outputs = {"h_out": np.array(hidden, np.float32), "c_out": np.array(cells, np.float32)}
    for layer in range(NETWORK["layers"]):
        x = x @ _W[f"w{layer}"].T + _W[f"b{layer}"]
        if layer < NETWORK["layers"] - 1:
            x = _ACTIVATIONS[NETWORK["activation"]](x)
    action, bound = x.astype(np.float32), NETWORK["bound"]
    if NETWORK["squashed"]:
        action = np.tanh(action) * np.float32(bound)
    if bound is not None:
        action = np.clip(action, np.float32(-bound), np.float32(bound))
    command = action * _W["command_scale"] + _W["command_offset"] if NETWORK["scaled"] else action.copy()
    for low, high in NETWORK["bounds"]:
        command = np.minimum(np.maximum(command, np.float32(low)), np.float32(high))
    return {"action": action, "command": command, **outputs}


class Episode:
    """State of one robot's episode: the history of observation terms, and the policy's hidden state."""

    def __init__(self):
        self.terms, self.rows, self.memory = METADATA["observations"], {}, {}
        for part in METADATA["memory"]:
            self.memory[part["input"]] = np.zeros(part["single"], np.float32)

    def step(self, now):
        """Return the action, and the commands for the actuators, for the observation of this step.

        `now` has the present value of each term; this object adds the values of earlier steps to terms with a history.
        """
        start, values, now = 0, [], np.asarray(now, np.float32)
        _require_columns("now", now, [(term["name"], term["size"] // term["history"]) for term in self.terms], 1)
        for term in self.terms:
            width = term["size"] // term["history"]
            row = now[start : start + width]
            rows = self.rows.get(term["name"], [row] * term["history"])  # the first value fills the history
            self.rows[term["name"]] = [*rows[1:], row]
            values += self.rows[term["name"]]
            start += width
        out = run({"obs": np.concatenate(values)[None], **self.memory})
        self.memory = {part["input"]: out[part["output"]] for part in METADATA["memory"]}
        return out["action"][0], out["command"][0]


def _require_columns(name, x, widths, dimensions=2):
    needed = sum(width for _, width in widths)
    if x.ndim != dimensions or x.shape[-1] != needed:
        shape = ("(columns,)", "(n, columns)")[dimensions - 1]
        parts = ", ".join(f"{term} {width}" for term, width in widths)
        raise ValueError(f"{name} has the shape {x.shape}, the policy needs {shape} with {needed} columns: {parts}")


def _convolve_images(x):
    """Apply the convolutions to the images, (channels, rows, columns) each; the other columns follow unchanged."""
    features, others, end = [], [], 0
    for number, (start, steps, *shape) in enumerate(NETWORK["images"]):
        stop = start + int(np.prod(shape))
        pixels, (c, h, w) = x[:, start:stop], shape
        if NETWORK["motion"] is not None and steps > 1:
            frames = pixels.reshape(len(x), steps, -1)
            change = NETWORK["motion"] * (frames[:, -1:] - frames[:, :-1])
            pixels = np.concatenate([change, frames[:, -1:]], axis=1).reshape(len(x), -1)
        for layer, (edge, step) in enumerate(NETWORK["kernels_and_strides"]):
            down, right = (step * np.arange((size - edge) // step + 1) for size in (h, w))
            # convolution as a matrix product: each row of `index` has the pixels below one kernel position
            window = (np.arange(c)[:, None, None] * h + np.arange(edge)[:, None]) * w + np.arange(edge)
            index = (down[:, None] * w + right).reshape(-1, 1) + window.reshape(1, -1)
            pixels = pixels[:, index] @ _W[f"cw{number}_{layer}"].T + _W[f"cb{number}_{layer}"]
            pixels = _ACTIVATIONS[NETWORK["activation"]](pixels).transpose(0, 2, 1)
            c, h, w = pixels.shape[1], len(down), len(right)
            pixels = pixels.reshape(len(x), -1)
        features.append(pixels)
        others.append(x[:, end:start])
        end = stop
    return np.concatenate([*features, *others, x[:, end:]], axis=1)


def _sigmoid(x):
    small = np.exp(-np.abs(x))  # exp of -|x| cannot overflow
    return np.where(x >= 0, 1.0, small) / (1.0 + small)


_ACTIVATIONS: dict = {
    "elu": lambda x: np.where(x > 0, x, np.exp(np.minimum(x, 0.0)) - 1.0),
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "silu": lambda x: x * _sigmoid(x),
}
_W = {}
if WEIGHTS:
    with np.load(io.BytesIO(base64.b64decode(WEIGHTS)), allow_pickle=False) as _file:
        _W = {_name: _file[_name] for _name in _file.files}
