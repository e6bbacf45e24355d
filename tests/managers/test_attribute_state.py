"""`AttributeState`: the state of a task's own objects is found, saved and restored."""

import collections
import itertools
import json
import random
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rlcli.managers.attribute_state import AttributeState


class Helper:
    def __init__(self):
        self.level, self.table = 0, torch.zeros(2)


class Owner:
    def __init__(self):
        self.vector = torch.zeros(3)
        self.scalar = torch.tensor(0.0)
        self.array = np.zeros(2)
        self.tables = {"a": torch.zeros(2), "b": [torch.zeros(1), torch.zeros(1)]}
        self.phase, self.name, self.on, self.count = 0.0, "first", False, 0
        self.window = collections.deque([1.0], maxlen=None)
        self.seen = set()
        self.range = (0.0, 1.0)
        self.generator = torch.Generator().manual_seed(1)
        self.numpy = np.random.default_rng(2)
        self.python = random.Random(3)
        self.helper = Helper()
        self.helper.owner = self  # a cycle of references

    def change(self):
        self.vector += 1.0
        self.scalar.add_(2.0)
        self.array += 3.0
        self.tables["a"] += 4.0
        self.tables["b"][1] += 5.0
        self.phase, self.name, self.on, self.count = 0.1 + 0.2, "sécond", True, 2**70
        self.window.append(float("inf"))
        self.seen.add("x")
        self.range = (0.5, 1.5)
        self.helper.level += 1
        self.helper.table += 6.0
        self.made = torch.ones(2)

    def draws(self):
        return torch.rand(2, generator=self.generator).tolist(), self.numpy.random(2).tolist(), self.python.random()


def snapshot(owner):
    plain = (owner.phase, owner.name, owner.on, owner.count, list(owner.window), sorted(owner.seen), owner.range)
    tensors = [owner.vector, owner.scalar, owner.tables["a"], *owner.tables["b"], owner.helper.table]
    made = getattr(owner, "made", torch.zeros(0)).tolist()
    return plain, [t.tolist() for t in tensors], owner.array.tolist(), owner.helper.level, made, owner.draws()


def through_a_file(state):
    assert all(isinstance(value, torch.Tensor) for value in state.values())
    return {name: value.clone() for name, value in state.items()}


def test_term_state_restores_another_object():
    first, second = Owner(), Owner()
    memory, other = AttributeState(first), AttributeState(second)
    first.change()
    first.draws()
    state = through_a_file(memory.state_dict())
    other.load_state_dict(state)
    assert snapshot(first) == snapshot(second)


def test_term_state_restores_first_state():
    owner = Owner()
    memory = AttributeState(owner)
    begin = through_a_file(memory.state_dict())
    fresh = Owner()
    owner.change()
    memory.state_dict()
    memory.load_state_dict(begin)
    del owner.made  # an attribute that did not exist at first
    assert snapshot(owner) == snapshot(fresh)


def test_load_state_dict_writes_in_place():
    owner = Owner()
    memory = AttributeState(owner)
    view, window = owner.vector[:2], owner.window
    owner.change()
    state = memory.state_dict()
    owner.vector.zero_()
    owner.window.clear()
    memory.load_state_dict(state)
    assert view.tolist() == [1.0, 1.0]
    assert window is owner.window
    assert list(window) == [1.0, float("inf")]


def test_state_dict_is_a_copy():
    owner = Owner()
    state = AttributeState(owner).state_dict()
    owner.change()
    assert state["vector"].tolist() == [0.0, 0.0, 0.0]
    assert state["tables/b/1"].tolist() == [0.0]


def test_state_dict_omits_constants():
    owner = Owner()
    memory = AttributeState(owner)
    assert "plain" not in memory.state_dict()
    owner.phase = 1.0
    assert list(json.loads(bytes(memory.state_dict()["plain"].tolist()))) == ["phase"]


@pytest.mark.parametrize(
    ("value", "kind"),
    [(itertools.count(), "count"), ((n for n in range(3)), "generator"), (np.random.RandomState(1), "RandomState")],
)
def test_unsaved_lists_attributes_with_types(value, kind):
    owner = SimpleNamespace(fine=1.0)
    memory = AttributeState(owner)
    assert memory.unsaved() == []
    owner.odd = value
    assert memory.unsaved() == [f"SimpleNamespace.odd ({kind})"]


def test_load_state_dict_rejects_state_of_other_object():
    with pytest.raises(ValueError, match=r"'helper\.table', but class SimpleNamespace has no such"):
        AttributeState(SimpleNamespace()).load_state_dict({"helper.table": torch.zeros(2)})


def state_with(**slots):
    kept = {slot.replace("__DOT__", "."): json.dumps(value) for slot, value in slots.items()}
    return {"plain": torch.frombuffer(bytearray(json.dumps(kept).encode()), dtype=torch.uint8)}


@pytest.mark.parametrize(
    ("slot", "value"),
    [
        ("change", 3),
        ("__class__", 3),
        ("__class__.change", 3),
        ("change.__globals__", ["dict", []]),
        ("__init__.__globals__", ["dict", [["torch", 1]]]),
        ("helper", 3),
        ("helper.__dict__", ["dict", []]),
        ("vector.data", 3),
        ("name.x", 3),
        ("name", ["scalar", "O", 3]),
        ("a b", 3),
        ("numpy", ["dict", [["bit_generator", "MT19937"], ["state", ["dict", [["pos", 10**6]]]]]]),
        ("numpy", ["dict", [["bit_generator", "Philox"], ["buffer_pos", -9]]]),
    ],
)
def test_load_state_dict_rejects_other_attributes(slot, value):
    owner = Owner()
    memory, was = AttributeState(owner), torch.zeros
    with pytest.raises((ValueError, TypeError)):
        memory.load_state_dict(state_with(**{slot: value}))
    assert torch.zeros is was
    assert callable(owner.change)
    assert isinstance(owner.helper, Helper)


@pytest.mark.parametrize(
    "path", ["change", "helper", "__class__", "helper.__class__", "tables/b", "name/x", "missing.x"]
)
def test_load_state_dict_rejects_tensor_for_other_type(path):
    owner = Owner()
    with pytest.raises(ValueError, match=path.partition("/")[0].partition(".")[0]):
        AttributeState(owner).load_state_dict({path: torch.zeros(7)})
