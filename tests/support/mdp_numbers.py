"""States of three environments in plain numbers, and values that follow from them: rotations, positions, velocities.

This module does not use rlcli: tests compare terms with it.
"""

from dataclasses import dataclass, field
from math import pi
from types import SimpleNamespace

import numpy as np

HIPS = ["hip_fl", "hip_fr", "hip_bl", "hip_br"]
FEET = ["leg_fl", "leg_fr", "leg_bl", "leg_br"]
AT = np.array([[0.18, 0.14, 0.0], [0.18, -0.14, 0.0], [-0.18, 0.14, 0.0], [-0.18, -0.14, 0.0]])
"""Positions of the hips on the torso [m]."""
TIP = np.array([0.02, 0.0, -0.25])
"""Position of a foot's site on its leg [m]."""
LIMIT = pi / 3
DEFAULT = np.array([0.1, -0.1, 0.1, -0.1])
GRAVITY = np.array([[0.0, 0.0, -9.81], [3.0, 0.0, -4.0], [0.0, 0.0, -1.6]])
"""Gravity of each environment [m/s^2]."""


def turn(axis, angle):
    """Return the rotation matrix about x, y or z."""
    c, s = np.cos(angle), np.sin(angle)
    if axis == "x":
        return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    if axis == "y":
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def product(a, b):
    """Return the product of two quaternions."""
    w, v, x, u = a[0], np.asarray(a[1:]), b[0], np.asarray(b[1:])
    return np.array([w * x - v @ u, *(w * u + x * v + np.cross(v, u))])


def quaternion(rpy):
    """Return the quaternion of a turn about x, then y, then z."""
    parts = [np.array([np.cos(a / 2), *(np.sin(a / 2) * np.eye(3)[i])]) for i, a in enumerate(rpy)]
    return product(parts[2], product(parts[1], parts[0]))


def inverse(quat):
    return quat * np.array([1, -1, -1, -1])


def positive(quat):
    return -quat if quat[0] < 0 else quat


def angle_of(quat):
    return 2 * np.arctan2(np.linalg.norm(quat[1:]), abs(quat[0]))


def matrix(rpy):
    return turn("z", rpy[2]) @ turn("y", rpy[1]) @ turn("x", rpy[0])


def wrapped(angle):
    return (angle + pi) % (2 * pi) - pi


@dataclass
class State:
    """State of one environment."""

    index: int
    origin: np.ndarray
    pos: np.ndarray
    rpy: np.ndarray
    lin: np.ndarray  # world frame
    ang: np.ndarray  # body frame
    q: np.ndarray
    v: np.ndarray
    acc: np.ndarray
    effort: np.ndarray
    ctrl: np.ndarray  # targets of the hips' position actuators
    action: np.ndarray
    previous: np.ndarray
    steps: int
    terminated: bool
    timed_out: bool
    arm: np.ndarray  # shoulder, elbow [rad], finger [m]
    arm_vel: np.ndarray
    arm_ctrl: float  # of the shoulder's motor
    drawer: float
    thing: np.ndarray
    thing_rpy: np.ndarray
    readings: dict
    velocity: np.ndarray  # command
    pose: np.ndarray  # command: position, quaternion in the arm's root frame
    place: np.ndarray  # command: x, y, z, heading
    feet: SimpleNamespace
    rays: SimpleNamespace
    gravity: np.ndarray = field(init=False)

    def __post_init__(self):
        self.gravity = GRAVITY[self.index]
        self.down = self.gravity / np.linalg.norm(self.gravity)
        self.R, self.quat = matrix(self.rpy), quaternion(self.rpy)
        self.lin_b, self.ang_w = self.R.T @ self.lin, self.R @ self.ang
        self.down_b = self.R.T @ self.down
        self.above = self.pos - self.origin
        self.leg_R = [self.R @ turn("y", q) for q in self.q]
        self.leg_quat = [product(self.quat, quaternion([0, q, 0])) for q in self.q]
        self.leg_pos = np.array([self.pos + self.R @ at for at in AT])
        self.leg_ang = np.array([self.ang_w + self.R @ [0, v, 0] for v in self.v])
        self.leg_lin = np.array([self.lin + np.cross(self.ang_w, p - self.pos) for p in self.leg_pos])
        self.tip = np.array([p + R @ TIP for p, R in zip(self.leg_pos, self.leg_R, strict=True)])
        self.tip_lin = np.array([
            v + np.cross(w, tip - p)
            for v, w, tip, p in zip(self.leg_lin, self.leg_ang, self.tip, self.leg_pos, strict=True)
        ])  # fmt: skip
        # the arm stands at (1, 0, 0.5), turned by 90 degrees about z; both joints about its y axis
        self.base, self.base_R = np.array([1.0, 0.0, 0.5]), turn("z", pi / 2)
        self.base_quat = quaternion([0, 0, pi / 2])
        upper = self.base_R @ turn("y", self.arm[0])
        self.fore_R = upper @ turn("y", self.arm[1])
        self.fore = self.base + upper @ [0, 0, 0.4]
        self.fore_quat = product(self.base_quat, quaternion([0, self.arm[0] + self.arm[1], 0]))
        self.grip = self.fore + self.fore_R @ [0, 0, 0.3]
        self.goal = self.base + self.base_R @ self.pose[:3]
        self.goal_quat = product(self.base_quat, self.pose[3:])
        self.thing_quat = quaternion(self.thing_rpy)
        self.handle = np.array([2.0, 0.5, 0.6]) - [self.drawer, 0, 0]
        self.handle_R = turn("z", 0.3)
        self.asked = np.linalg.norm(self.velocity[:2])
        self.strongest = np.linalg.norm(self.feet.force_history, axis=-1).max(axis=0)


def states():
    """Return the states of three environments that differ in everything."""
    a = np.array
    rng = np.random.default_rng(7)

    def feet(found, air, contact, first):
        return SimpleNamespace(
            found=a(found), air_time=a(air), contact_time=a(contact), first_contact=a(first),
            last_air_time=rng.uniform(0.1, 0.9, 4), last_contact_time=rng.uniform(0.1, 0.9, 4),
            force_history=rng.uniform(-3, 3, (2, 4, 3)) * a(found)[:, None],
        )  # fmt: skip

    def rays(missed):
        return SimpleNamespace(position=rng.uniform(0, 1, 3), hits=rng.uniform(-0.2, 0.2, (3, 3)), missed=a(missed))

    def readings(rpy):
        return {"acc": rng.uniform(-5, 5, 3), "gyro": rng.uniform(-1, 1, 3), "attitude": quaternion(rpy),
                "spin": rng.uniform(-1, 1, 3)}  # fmt: skip

    some = [
        State(0, a([0, 0, 0.]), a([1, 2, 0.5]), a([0, 0.6, 0]), a([1, 0, 0.5]), a([0.1, 0.2, 0.3]),
              a([0.1, -0.2, 0.3, -1.2]), a([1, -2.1, 3, -4.]), a([1, 2, -3, 4.]), a([0.5, -1, 2, -4.]),
              a([0.3, -0.2, 0.3, 2.0]), a([0.5, -0.5, 1, 0]), a([0.5, 0.5, 0, 0]), 7, False, True,
              a([0.3, -0.5, 0.01]), a([0.4, 0.2, 0.1]), 9.0, 0.05, a([1.2, 0.2, 1.1]), a([0, 0.2, 0]),
              readings([0.1, 0, 0]), a([1.0, 0.2, -0.3]), a([0.1, 0.2, 0.6, *quaternion([0.1, 0.2, 0.3])]),
              a([0.3, 0.4, 0, -0.5]), feet([True, False, True, True], [0, 0.3, 0, 0], [0.2, 0, 0.4, 0.02],
              [False, False, False, True]), rays([False, False, True])),
        State(1, a([4, -3, 0.25]), a([4.5, -3.5, 0.8]), a([0.4, -0.3, 2.0]), a([-0.3, 0.7, -0.2]), a([-0.5, 0.4, 1.0]),
              a([1.1, -0.1, 0, 0.2]), a([0, 0.5, 0, 6.0]), a([0, 0, 1, 0.5]), a([-1, 0, 3, 1.]),
              a([0, 0, 0, 0.]), a([0, 0.2, -0.3, 0.9]), a([0.1, 0, 0, 1.0]), 3, True, False,
              a([-0.7, 0.2, 0.03]), a([-0.4, 0, 0.2]), -2.0, 0.25, a([0.6, 0.7, 0.1]), a([0.5, 0, 1.0]),
              readings([0, 0.5, 1]), a([0.0, 0.0, 0.0]), a([0.3, -0.2, 0.1, *quaternion([0, 0, 2.0])]),
              a([1, 2, 2, 0.7]), feet([False, True, False, False], [0.1, 0, 0.6, 0.2], [0, 0.1, 0, 0],
              [False, True, False, False]), rays([False, False, False])),
        State(2, a([-4, 2, -0.1]), a([-4.2, 2.2, 0.1]), a([-1.0, 0.5, -2.5]), a([0.05, 0, 0]), a([0, 0, 0.01]),
              a([0.1, -0.1, 0.1, -0.1]), a([0.2, 0, 0, 0]), a([0, 0, 0, 0.]), a([0, 0, 0, 0.]),
              a([0.1, -0.1, 0.1, -0.1]), a([0, 0, 0, 0.]), a([0, 0, 0, 0.]), 0, False, False,
              a([0, 0, 0.]), a([0, 0, 0.]), 0.0, 0.32, a([1.0, 0.0, 1.2]), a([0, 0, pi / 2]),
              readings([0.3, 0.3, 0.3]), a([0.0, 0.05, 0.0]), a([0, 0, 0.7, *quaternion([0, 0, 0])]),
              a([0, 0, 0, 0.]), feet([True, True, False, False], [0, 0, 0.45, 0.5], [0.05, 0.6, 0, 0],
              [True, False, False, False]), rays([True, True, True])),
    ]  # fmt: skip
    return some
