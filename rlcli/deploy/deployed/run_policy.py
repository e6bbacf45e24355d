"""Runs an exported policy on its robot in MuJoCo: `python run_policy.py [STEPS]`. Needs numpy, mujoco, onnxruntime.

On a robot use `Controller`: `reset` before an episode, then `act` every `step_dt` s. `data` has fields that formulas
read (qpos, qvel, ...; SI units, quaternions w x y z), as `deployment.joints` in the metadata says. `inputs` maps
`command/NAME` and `observation/NAME` (without a formula) to values; controls are in the order `deployment.actuators`.
"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime

OPS: dict = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "clip": np.clip, "cross": np.cross,
    "rotate": lambda q, v: v + 2 * (q[0] * np.cross(q[1:], v) + np.cross(q[1:], np.cross(q[1:], v))),
    "unrotate": lambda q, v: v - 2 * (q[0] * np.cross(q[1:], v) - np.cross(q[1:], np.cross(q[1:], v))),
    "product": lambda p, q: np.r_[p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])],
    "inverse": lambda q: q * np.array([1, -1, -1, -1], np.float32), "unique": lambda q: -q if q[0] < 0 else q,
    "dot": lambda x, y: (x * y).sum()[None], "sqrt": np.sqrt, "cat": lambda *x: np.concatenate(x),
    "take": lambda x, at: x[at.astype(int)], "angle": lambda x: np.arctan2(x[1:2], x[:1]), "asin": np.arcsin,
    "wrap": lambda x: x - np.round(x / np.float32(2 * np.pi)) * np.float32(2 * np.pi),
    "below": lambda x, limit, yes, no: np.where(x < limit, yes, no),
}  # fmt: skip


class Controller:
    def __init__(self, file):
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        self.metadata = json.loads(session.get_modelmeta().custom_metadata_map["rlcli"])
        self.policy = lambda x: dict(zip([o.name for o in session.get_outputs()], session.run(None, x), strict=True))
        self.plan = self.metadata["deployment"]
        self.bounds = np.reshape([a["range"] or (-np.inf, np.inf) for a in self.plan["actuators"]], (-1, 2)).T
        self.reset()

    def reset(self):  # the first value fills a history; filters and hidden states begin at zero
        self.steps, self.filters, self.history = 0, {}, {}
        self.action = np.zeros(self.metadata["outputs"]["action"]["shape"][1], np.float32)
        self.memory = {part["input"]: np.zeros(part["single"], np.float32) for part in self.metadata["memory"]}

    def value(self, f, data, given):  # value of a formula f: constants, fields of data, inputs, or an operation
        if "op" not in f:
            row = np.ravel(getattr(data, f["field"]) if "field" in f else given[f["given"]] if "given" in f else f)
            return np.float32(row[f["at"]] if "at" in f else row)
        of = [self.value(part, data, given) for part in f["of"]]
        if f["op"] != "filter":
            return OPS[f["op"]](*of)
        xs, ys = self.filters.get(f["key"], ([0 * of[0]] * len(f["b"]), [0 * of[0]] * len(f["a"])))
        xs = [of[0], *xs[:-1]]  # newest first, like the weights b of the inputs and a of the earlier outputs
        y = np.float32(sum(map(np.multiply, f["b"], xs)) - sum(map(np.multiply, f["a"], ys)))
        self.filters[f["key"]] = xs, [y, *ys][: len(ys)]
        return y

    def act(self, data, inputs):
        given, ctrl = {"last_action": self.action, "steps": self.steps, **inputs}, np.array(data.ctrl)
        for term in self.plan["observations"]:
            now = self.value(term["value"], data, given)
            self.history[term["name"]] = [*self.history.get(term["name"], [now] * term["history"])[1:], now]
        self.obs = np.concatenate([row for rows in self.history.values() for row in rows])
        out = self.policy({"obs": self.obs[None], **self.memory})
        self.memory = {part["input"]: out[part["output"]] for part in self.metadata["memory"]}
        self.action, self.command, self.steps = out["action"][0], out["command"][0], self.steps + 1
        for control in self.plan["controls"]:
            ctrl[control["ctrl"]] = self.value(control["value"] or [], data, out)
        return np.clip(ctrl, *self.bounds)


if __name__ == "__main__":
    policy, xml = (Path(__file__).with_name(name).resolve(strict=True) for name in ("policy.onnx", "model.xml"))
    controller, model = Controller(policy), mujoco.MjModel.from_xml_path(str(xml))
    data, plan = mujoco.MjData(model), controller.plan
    data.qpos[:], data.qvel[:] = plan["start"]["qpos"], plan["start"]["qvel"]
    mujoco.mj_forward(model, data)
    for _ in range(steps := int((*sys.argv, "300")[1])):
        data.ctrl[:] = controller.act(data, {f"command/{c['name']}": np.zeros(c["size"]) for c in plan["commands"]})
        mujoco.mj_step(model, data, controller.metadata["decimation"])
        mujoco.mj_step1(model, data)  # mj_step leaves positions and sensors of the state before it
    print(f"{steps} steps, {data.time:.2f} s; qpos", *np.round(data.qpos, 3))
