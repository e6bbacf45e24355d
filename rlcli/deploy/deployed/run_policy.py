"""Lets an exported policy drive its robot in MuJoCo: `python run_policy.py [STEPS]`. Needs numpy, mujoco, onnxruntime.

For a robot keep `Controller`: every `step_dt` seconds give `act` an object with the fields that formulas name (qpos,
qvel, ...; SI, quaternions w x y z, joints where `deployment.joints` says) and send what it returns, in the order of
`deployment.actuators`; `reset` before an episode. `inputs`: `command/NAME`, `observation/NAME` without a formula.
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
        self.about = json.loads(session.get_modelmeta().custom_metadata_map["rlcli"])
        self.policy = lambda x: dict(zip([o.name for o in session.get_outputs()], session.run(None, x), strict=True))
        self.plan = self.about["deployment"]
        self.ends = np.reshape([a["range"] or (-np.inf, np.inf) for a in self.plan["actuators"]], (-1, 2)).T
        self.reset()

    def reset(self):  # histories fill with the first value that comes; filters and memories begin at zero
        self.steps, self.past, self.history = 0, {}, {}
        self.action = np.zeros(self.about["outputs"]["action"]["shape"][1], np.float32)
        self.memory = {part["input"]: np.zeros(part["single"], np.float32) for part in self.about["memory"]}

    def value(self, f, data, given):  # of a formula: constants, what is measured or given, or made of other rows
        if "op" not in f:
            row = np.ravel(getattr(data, f["field"]) if "field" in f else given[f["given"]] if "given" in f else f)
            return np.float32(row[f["at"]] if "at" in f else row)
        of = [self.value(part, data, given) for part in f["of"]]
        if f["op"] != "filter":
            return OPS[f["op"]](*of)
        xs, ys = self.past.get(f["key"], ([0 * of[0]] * len(f["b"]), [0 * of[0]] * len(f["a"])))
        xs = [of[0], *xs[:-1]]  # newest first, as the weights b of inputs and a of earlier outputs
        y = np.float32(sum(map(np.multiply, f["b"], xs)) - sum(map(np.multiply, f["a"], ys)))
        self.past[f["key"]] = xs, [y, *ys][: len(ys)]
        return y

    def act(self, data, inputs):
        given = {"last_action": self.action, "steps": self.steps, **inputs}
        for term in self.plan["observations"]:
            now = self.value(term["value"], data, given)
            self.history[term["name"]] = [*self.history.get(term["name"], [now] * term["history"])[1:], now]
        self.obs = np.concatenate([row for rows in self.history.values() for row in rows])
        out = self.policy({"obs": self.obs[None], **self.memory})
        self.memory = {part["input"]: out[part["output"]] for part in self.about["memory"]}
        self.action, self.steps, ctrl = out["action"][0], self.steps + 1, np.array(data.ctrl)
        for control in self.plan["controls"]:
            ctrl[control["ctrl"]] = self.value(control["value"] or [], data, out)
        return np.clip(ctrl, *self.ends)


if __name__ == "__main__":
    controller = Controller(Path(__file__).with_name("policy.onnx"))
    model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("model.xml")))
    data, plan = mujoco.MjData(model), controller.plan
    data.qpos[:], data.qvel[:] = plan["start"]["qpos"], plan["start"]["qvel"]
    mujoco.mj_forward(model, data)
    for _ in range(steps := int((*sys.argv, "300")[1])):
        data.ctrl[:] = controller.act(data, {f"command/{c['name']}": np.zeros(c["size"]) for c in plan["commands"]})
        mujoco.mj_step(model, data, controller.about["decimation"])
        mujoco.mj_step1(model, data)  # positions, velocities and their sensors of the state as it is now
    print(f"{steps} steps, {data.time:.2f} s; qpos", *np.round(data.qpos, 3))
