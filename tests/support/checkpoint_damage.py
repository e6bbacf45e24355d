"""Kinds of damage to a good checkpoint.

Each function returns a damage: a function that gets the folder of a checkpoint and changes it. `setting`, `put` and the
like return changes of a document or of tensors. Where `rehash` is called the manifest agrees with the change
afterwards: whoever can write the files can write their hashes.
"""

import hashlib
import json
import os
import pickle
import shutil
import struct

import safetensors.torch
import torch

from support.saved_states import rehash


class Bomb:
    """Object that reports when it is unpickled."""

    def __reduce__(self):
        return (os.system, ("touch executed",))


def manifest(change):
    def damage(folder):
        document = json.loads((folder / "manifest.json").read_text())
        changed = change(document)
        (folder / "manifest.json").write_text(json.dumps(document if changed is None else changed))

    return damage


def document(name, change):
    def damage(folder):
        value = json.loads((folder / name).read_text())
        changed = change(value)
        (folder / name).write_text(json.dumps(value if changed is None else changed))
        rehash(folder, name)

    return damage


def tensors(part, change):
    def damage(folder):
        file = folder / f"{part}.safetensors"
        values = safetensors.torch.load(file.read_bytes())
        change(values)
        file.write_bytes(safetensors.torch.save(values))
        rehash(folder, file.name)

    return damage


def content(name, data):
    def damage(folder):
        (folder / name).write_bytes(data() if callable(data) else data)
        if name != "manifest.json":
            rehash(folder, name)

    return damage


def header(name, length=None, **entries):
    """Replace the header of a safetensors file; `length` is the length that the file states."""

    def damage(folder):
        text = json.dumps(entries).encode() if entries else b"{}"
        data = struct.pack("<Q", len(text) if length is None else length) + text + bytes(64)
        (folder / name).write_bytes(data)
        rehash(folder, name)

    return damage


def tensor(shape, end=8, dtype="F32", begin=0):
    return {"dtype": dtype, "shape": shape, "data_offsets": [begin, end]}


def truncated(name, where):
    def damage(folder):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(where * len(data))])

    return damage


def flipped(name, where, bit):
    def damage(folder):
        data = bytearray((folder / name).read_bytes())
        data[int(where * len(data))] ^= 1 << bit
        (folder / name).write_bytes(bytes(data))

    return damage


def with_hashes(damage, name):
    def both(folder):
        damage(folder)
        rehash(folder, name)

    return both


def both(*damages):
    def damage(folder):
        for each in damages:
            each(folder)

    return damage


def missing(name):
    return lambda folder: (folder / name).unlink()


def linked(name, target):
    """Replace a file by a link; the manifest fits the link's target."""

    def damage(folder):
        file = folder / name
        outside = folder.parents[2] / f"outside-{name}"
        shutil.copy(file, outside)
        file.unlink()
        file.symlink_to(outside if target is None else target)

    return damage


def piped(name):
    def damage(folder):
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return damage


def a_folder(name):
    def damage(folder):
        (folder / name).unlink()
        (folder / name).mkdir()

    return damage


def sparse(name, size):
    """Replace a file by a sparse file of gigabytes."""

    def damage(folder):
        with (folder / name).open("wb") as file:
            file.truncate(size)
        if name != "manifest.json":
            value = json.loads((folder / "manifest.json").read_text())
            value["files"][name]["size"] = size
            (folder / "manifest.json").write_text(json.dumps(value))

    return damage


def pickled(name, kind):
    def damage(folder):
        if kind == "pickle":
            (folder / name).write_bytes(pickle.dumps(Bomb()))
        else:
            torch.save({"log_std": Bomb()}, folder / name)
        if name != "manifest.json":
            rehash(folder, name)

    return damage


def setting(*path, to):
    """Return a change that sets the value at a path of a JSON document."""

    def change(value):
        for key in path[:-1]:
            value = value[key]
        value[path[-1]] = to

    return change


def without(key):
    return lambda value: value.pop(key) and None


def put(name, make):
    """Return a change that replaces a tensor by `make(tensor)`."""
    return lambda values: values.update({name: make(values[name])})


def first(prefix, make, suffix=""):
    """Return a change that replaces the first tensor whose name has a prefix."""

    def change(values):
        name = next(key for key in sorted(values) if key.startswith(prefix) and key.endswith(suffix))
        values[name] = make(values[name])

    return change


def fill(number):
    return lambda value: torch.full_like(value, number)


def halved(value):
    return value[: len(value) // 2].clone() if value.dim() else value


def every(make):
    return lambda values: values.update({name: make(value) for name, value in values.items()})


def written(slot, value):
    """Return a change that stores an attribute of the task with a value that is not a tensor."""

    def change(values):
        data = json.dumps({slot: json.dumps(value)}).encode()
        values["workflow.task.plain"] = torch.frombuffer(bytearray(data), dtype=torch.uint8)

    return change


def drop(prefix):
    def change(values):
        for name in [key for key in values if key.startswith(prefix)]:
            del values[name]

    return change


def nested(depth):
    return b'{"a":' * depth + b"1" + b"}" * depth


def rows(change):
    """Return a damage that changes a file of the replay buffer's rows."""

    def damage(folder):
        document = json.loads((folder / "manifest.json").read_text())
        (file,) = (folder.parent / "logs/replay").glob("*.safetensors")
        values = safetensors.torch.load(file.read_bytes())
        change(values)
        data = safetensors.torch.save(values)
        file.write_bytes(data)
        document["logs"]["replay"]["shards"][0] |= {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        (folder / "manifest.json").write_text(json.dumps(document))

    return damage


def on_rows(damage):
    """Return a damage of that file that leaves its manifest unchanged."""

    def outer(folder):
        (file,) = (folder.parent / "logs/replay").glob("*.safetensors")
        damage(file)

    return outer
