"""Damaged and malicious checkpoints and run folders, made from a good one; each damage has a name."""

import os
import pickle
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from support.checkpoint_damage import (
    Bomb,
    a_folder,
    both,
    content,
    document,
    drop,
    every,
    fill,
    first,
    flipped,
    halved,
    header,
    linked,
    manifest,
    missing,
    nested,
    on_rows,
    pickled,
    piped,
    put,
    rows,
    setting,
    sparse,
    tensor,
    tensors,
    truncated,
    with_hashes,
    without,
    written,
)

PLAYED = ("play", "eval", "export", "init")
"""Commands that read only the policy."""
EVERY = (*PLAYED, "resume")
RESUMED = ("resume",)
FILES = (
    "manifest.json",
    "policy.json",
    "policy.safetensors",
    "trainer.safetensors",
    "env.safetensors",
    "rng.safetensors",
    "state.json",
)


@dataclass(frozen=True)
class Case:
    """A damage, the commands that refuse it, and the run: `ppo` with normalisation, or `sac` with a buffer."""

    name: str
    damage: Callable[[Path], None]
    readers: tuple[str, ...]
    run: str = "ppo"
    bomb: bool = False
    """Whether the file requests more memory than allowed."""


def manifests():
    format_, step, files = (lambda to, key=key: setting(key, to=to) for key in ("format", "step", "files"))
    for value in (0, 2, -1, "1", 1.0, True, None, [1], 10**19, 10**30):
        yield f"format {value!r}", manifest(format_(value))
    for value in ("x", -1, 1.5, True, None, 7, 10**19, [768]):
        yield f"step {value!r}", manifest(step(value))
    for value in (None, [], {}, {"policy.json": 3}, {"policy.json": {}}, "policy.json"):
        yield f"files {value!r}", manifest(files(value))
    for key, value in (
        ("size", "5"), ("size", -1), ("size", 2**70), ("size", True), ("size", None), ("size", 2**61),
        ("sha256", None), ("sha256", "0" * 10**6), ("sha256", 5), ("sha256", "0" * 64), ("sha256", "é" * 64),
    ):  # fmt: skip
        yield f"{key} {str(value)[:8]}", manifest(setting("files", "policy.safetensors", key, to=value))
    for name in (
        "../policy.json", "/etc/passwd", "..", "", ".", "a/b.json", "a\\b.json", "policy.json\0", "\0", "policy.pkl",
        "POLICY.json", "policy.json ", "p" * 300 + ".json", "policy.safetensors.pt", "~/.bashrc", "con\n.json",
    ):  # fmt: skip
        yield f"file {name[:20]!r}", manifest(setting("files", name, to={"size": 5, "sha256": "0" * 64}))
    many = {f"p{i}.json": {"size": 1, "sha256": "0"} for i in range(5000)}
    yield "5,000 files", manifest(lambda value: value["files"].update(many))
    for key in ("format", "step", "files"):
        yield f"no {key}", manifest(without(key))
    for name, data in (
        ("nothing", b""), ("a brace", b"{"), ("a list", b"[]"), ("text", b'"manifest"'), ("no UTF-8", b"\xff\xfe{}"),
        ("NaN", b'{"format": 1, "step": NaN, "files": {}}'), ("infinity", b'{"format": 1, "step": Infinity}'),
        ("1e999", b'{"format": 1, "step": 1e999, "files": {}}'), ("two steps", b'{"format": 1, "step": 1, "step": 2}'),
        ("5,000 digits", b'{"format": 1, "step": ' + b"9" * 5000 + b"}"), ("30 digits", b'{"a": ' + b"9" * 30 + b"}"),
        ("40 levels", nested(40)), ("100,000 levels", nested(100_000)), ("100,000 brackets", b"[" * 100_000),
        ("zeros", bytes(1000)), ("UTF-16", '{"format": 1}'.encode("utf-16")),
    ):  # fmt: skip
        yield f"manifest: {name}", content("manifest.json", data)


def policies():
    file = "policy.json"
    for key, value in (
        ("observation_size", 0), ("observation_size", -1), ("observation_size", "x"), ("observation_size", 2**40),
        ("observation_size", 10**9), ("observation_size", 5), ("observation_size", None), ("action_size", 0),
        ("action_size", 10**9), ("action_size", 2), ("hidden", [10**9, 10**9]), ("hidden", [64] * 10**5),
        ("hidden", []), ("hidden", [0]), ("hidden", ["a"]), ("hidden", None), ("hidden", [-1]), ("hidden", [2**24] * 9),
        ("activation", "os.system"), ("activation", None), ("kind", "pickle"), ("kind", "gaussian-lstm"),
        ("kind", "squashed-gaussian-mlp"), ("action_bound", -1), ("action_bound", 0), ("action_bound", "x"),
        ("normalize", False), ("normalize_clip", -1), ("memory", [8]), ("memory", [10**9]), ("memory", "x"),
        ("group", "g" * 10**6), ("group", 3), ("log_std_range", [1]), ("__class__", "Policy"), ("surprise", 1),
    ):  # fmt: skip
        yield f"policy {key} {str(value)[:12]}", document(file, setting(key, to=value))
    for key in ("observation_size", "action_size", "hidden", "activation"):
        yield f"policy without {key}", document(file, without(key))
    for name, data in (
        ("nothing", b""), ("a list", b"[]"), ("100,000 levels", nested(100_000)), ("NaN", b'{"kind": NaN}'),
        ("1e400", b'{"action_bound": 1e400}'), ("two kinds", b'{"kind": 1, "kind": 2}'), ("no UTF-8", b"\xff\xff"),
    ):  # fmt: skip
        yield f"policy.json: {name}", content(file, data)


def weights():
    layer = "actor.0.weight"
    for name, change in (
        ("NaN", put(layer, fill(float("nan")))),
        ("infinity", put(layer, fill(float("inf")))),
        ("one NaN", put("log_std", fill(float("nan")))),
        ("missing", drop(layer)),
        ("none at all", drop("")),
        ("one too many", lambda values: values.update(extra=torch.zeros(1))),
        ("transposed", put(layer, lambda w: w.T.contiguous())),
        ("float64", put(layer, torch.Tensor.double)),
        ("float16", put(layer, torch.Tensor.half)),
        ("integers", put(layer, torch.Tensor.long)),
        ("empty", put(layer, lambda w: w[:0].clone())),
        ("one row less", put(layer, lambda w: w[1:].clone())),
        ("a dimension more", put(layer, lambda w: w[None].clone())),
        ("variance below 0", put("normalizer.var", fill(-1.0))),
        ("count below 0", put("normalizer.count", fill(-5.0))),
        ("NaN variance", put("normalizer.var", fill(float("nan")))),
        ("mean of one", put("normalizer.mean", lambda m: m[:1].clone())),
        ("float32 mean", put("normalizer.mean", torch.Tensor.float)),
        ("count of two", put("normalizer.count", lambda c: c.repeat(2))),
    ):
        yield f"weights: {name}", tensors("policy", change)
    part = "policy.safetensors"
    for name, damage in (
        ("header of 2**60", header(part, 2**60)),
        ("header of 2**63", header(part, 2**63)),
        ("header of 2**64 - 1", header(part, 2**64 - 1)),
        ("header of 100 MB", header(part, 10**8)),
        ("a header of 0", header(part, 0)),
        ("2**80 elements", header(part, w=tensor([2**40, 2**40]))),
        ("2**62 rows of none", header(part, w=tensor([2**62, 2**62, 0], 0))),
        ("10,000 dimensions", header(part, w=tensor([1] * 10_000, 4))),
        ("offsets behind the end", header(part, w=tensor([100], 400))),
        ("offsets backwards", header(part, w=tensor([2], 0, begin=8))),
        ("offsets below 0", header(part, w=tensor([2], 8, begin=-8))),
        ("overlapping", header(part, a=tensor([2]), b=tensor([2]))),
        ("unknown type", header(part, w=tensor([2], dtype="X32"))),
        ("shape of text", header(part, w=tensor("2"))),
        ("shape below 0", header(part, w=tensor([-2]))),
        ("shape of floats", header(part, w=tensor([2.0]))),
        ("no shape", header(part, w={"dtype": "F32"})),
        ("no entry", header(part, w=3)),
        ("a list", content(part, struct.pack("<Q", 2) + b"[]")),
        ("no JSON", content(part, struct.pack("<Q", 4) + b"\x80\x04.\x00")),
        ("seven bytes", content(part, bytes(7))),
        ("nothing", content(part, b"")),
        ("100,000 levels", content(part, struct.pack("<Q", 600_001) + nested(100_000))),
        ("a name twice", content(part, struct.pack("<Q", 27) + b'{"a": {"b": 1}, "a": 2}    ')),
    ):
        yield f"tensor file: {name}", damage


def places():
    """Return cases with directories, pipes and missing files in place of files."""
    for name in FILES:
        who = EVERY if name.startswith(("manifest", "policy")) else RESUMED
        yield Case(f"{name} missing", missing(name), who)
        yield Case(f"{name} links outside", linked(name, None), who)
        yield Case(f"{name} links to a device", linked(name, "/dev/zero"), who)
        yield Case(f"{name} links to itself", linked(name, name), who)
        yield Case(f"{name} is a pipe", piped(name), who)
        yield Case(f"{name} is a folder", a_folder(name), who)
        yield Case(f"{name} of 100 GB", sparse(name, 10**11), who, bomb=True)
        yield Case(f"{name} of 3 GB", sparse(name, 3 * 10**9), who, bomb=True)
        yield Case(f"{name} is a pickle", pickled(name, "pickle"), who)
        yield Case(f"{name} is a torch pickle", pickled(name, "torch"), who)
    yield Case(
        "manifest of 100 MB", content("manifest.json", lambda: b'{"a": "' + b"x" * 10**8 + b'"}'), EVERY, bomb=True
    )
    yield Case(
        "manifest of 1,300,000 lists", content("manifest.json", b"[" + b"[]," * 1_300_000 + b"1]"), EVERY, bomb=True
    )
    yield Case("network of 2 GB", document("policy.json", setting("hidden", to=[16384] * 3)), EVERY, bomb=True)
    yield Case(
        "network of 10**12 weights", document("policy.json", setting("hidden", to=[2**24] * 3)), EVERY, bomb=True
    )


def layouts():
    for value in (None, [], "x", {}, {"observations": 3}, {"observations": {"policy": [{"name": "x", "size": 99}]}}):
        yield Case(f"layout {value!r}", manifest(setting("layout", to=value)), EVERY)
    for key, value in (("step_dt", "x"), ("step_dt", 5.0), ("actions", []), ("actions", [3]), ("observations", {})):
        yield Case(f"layout {key} {value!r}", manifest(setting("layout", key, to=value)), EVERY)
    yield Case("no layout", manifest(without("layout")), EVERY)
    yield Case(
        "another task's columns",
        manifest(setting("layout", "observations", "policy", 0, "name", to="gaze")),
        PLAYED[:2],
    )
    yield Case("another trainer", manifest(setting("trainer", to="ppo")), RESUMED)
    yield Case("a trainer that is a number", manifest(setting("trainer", to=5)), RESUMED)


def states():
    file = "state.json"
    for key, value in (
        ("iteration", "x"),
        ("iteration", -1),
        ("iteration", 1.5),
        ("iteration", True),
        ("iteration", None),
        ("iteration", 10**19),
        ("env_steps", 7),
        ("env_steps", "128"),
        ("env_steps", -128),
        ("env_steps", 128.0),
        ("learning_rate", "x"),
        ("learning_rate", -1.0),
        ("learning_rate", None),
        ("learning_rate", [1]),
        ("learning_rate", 1e300),
        ("updates", "x"),
        ("updates", -1),
        ("updates", None),
        ("statistics", None),
        ("statistics", []),
        ("statistics", {"recent": 3, "total": 1}),
        ("statistics", {"recent": [[1, 2]], "total": 1}),
        ("statistics", {"recent": [["a"] * 4], "total": 1}),
        ("statistics", {"recent": [], "total": "x"}),
        ("statistics", {"recent": [[0, 1, 1, 1]], "total": 1}),
        ("statistics", {}),
        ("policy", None),
        ("policy", {}),
        ("policy", []),
    ):
        yield f"state {key} {str(value)[:30]}", document(file, setting(key, to=value))
    for key in ("iteration", "env_steps", "learning_rate", "updates", "statistics", "policy"):
        yield f"state without {key}", document(file, without(key))
    for name, data in (
        ("nothing", b""),
        ("a list", b"[]"),
        ("100,000 levels", nested(100_000)),
        ("NaN", b'{"a": NaN}'),
    ):
        yield f"state.json: {name}", content(file, data)


def learners():
    nan, slot = fill(float("nan")), "optimizer.policy.1.exp_avg"
    for name, part, change in (
        ("a critic of NaN", "trainer", first("weights.value_net.", nan)),
        ("no critic", "trainer", drop("weights.value_net.")),
        (
            "a critic of another shape",
            "trainer",
            first("weights.value_net.", lambda w: w.repeat(2, *[1] * (w.dim() - 1))),
        ),
        ("a critic of float64", "trainer", first("weights.value_net.", torch.Tensor.double)),
        ("a critic of integers", "trainer", first("weights.value_net.", torch.Tensor.long)),
        ("a moment of another shape", "trainer", put(slot, lambda m: torch.zeros(3, 3))),
        ("a moment of one number", "trainer", put(slot, lambda m: torch.zeros(1))),
        ("a moment of integers", "trainer", put(slot, torch.Tensor.long)),
        ("a moment of NaN", "trainer", put(slot, nan)),
        ("no second moment", "trainer", drop("optimizer.policy.0.exp_avg_sq")),
        ("steps of two", "trainer", put("optimizer.policy.0.step", lambda s: torch.zeros(2))),
        ("a moment of nobody", "trainer", lambda v: v.update({"optimizer.policy.99.step": torch.zeros(())})),
        ("a moment without a number", "trainer", lambda v: v.update({"optimizer.policy.x.step": torch.zeros(())})),
        ("a moment with dots", "trainer", lambda v: v.update({"optimizer.policy.0.a.b": torch.zeros(())})),
        ("wide observations", "trainer", put("observations", lambda o: torch.zeros(4, 99))),
        ("flat observations", "trainer", put("observations", torch.Tensor.flatten)),
        ("half of the environments", "env", every(halved)),
        ("lengths of one", "env", put("episode_length", lambda v: v[:1].clone())),
        ("lengths of floats", "env", put("episode_length", torch.Tensor.float)),
        ("no lengths", "env", drop("episode_length")),
        ("engine state of one", "env", put("engine.state", lambda v: v[:1].clone())),
        ("no engine state", "env", drop("engine.state")),
        ("engine state of float32", "env", put("engine.state", torch.Tensor.float)),
        ("no warnings", "env", drop("engine.warning")),
        ("warnings of one", "env", put("engine.warning", lambda v: v[:1].clone())),
        (
            "a model field that selects",
            "env",
            lambda v: v.update({"engine.model.body_parentid": torch.zeros(8, 3, dtype=torch.int32)}),
        ),
        ("a model field of one", "env", lambda v: v.update({"engine.model.body_mass": torch.zeros(1, 1)})),
        ("a model field that there is not", "env", lambda v: v.update({"engine.model.__class__": torch.zeros(1)})),
        ("a substep of nothing", "env", lambda v: v.update({"engine.substep.nothing": torch.zeros(8)})),
        ("seed of two", "env", put("seed", lambda v: v.repeat(2))),
        ("no seed", "env", drop("seed")),
        ("nothing", "env", drop("")),
        ("starts of one", "env", put("episode_starts", lambda v: v[:1].clone())),
        ("no starts", "env", drop("episode_starts")),
        ("starts of numbers", "env", put("episode_starts", torch.Tensor.float)),
        ("no workflow", "env", drop("workflow.")),
        ("a workflow of one", "env", first("workflow.", lambda v: v[:1].clone() if v.dim() else v.repeat(2), "sums")),
        ("torch's generator cut", "rng", put("torch", lambda v: v[:100].clone())),
        ("nothing", "rng", drop("")),
        ("torch's generator longer", "rng", put("torch", lambda v: v.repeat(2))),
        ("torch's of floats", "rng", put("torch", torch.Tensor.float)),
        ("numpy's keys cut", "rng", put("numpy.keys", lambda v: v[:5].clone())),
        ("numpy's position beyond", "rng", put("numpy.position", fill(10**6))),
        ("numpy's position below 0", "rng", put("numpy.position", fill(-1))),
        ("numpy's keys below 0", "rng", put("numpy.keys", fill(-1))),
        ("numpy's position of one", "rng", put("numpy.position", lambda v: v[:1].clone())),
        ("Python's words cut", "rng", put("python.words", lambda v: v[:9].clone())),
        ("Python's words below 0", "rng", put("python.words", fill(-1))),
        ("Python's of another version", "rng", put("python.words", fill(7))),
        ("no generator of Python", "rng", drop("python.")),
        ("gauss of two", "rng", put("python.gauss", lambda v: v.repeat(2))),
    ):
        yield Case(f"{part}: {name}", tensors(part, change), RESUMED)
    for name, part, change in (
        ("temperature of two", "trainer", put("log_ent_coef", lambda v: torch.zeros(2))),
        ("temperature of NaN", "trainer", put("log_ent_coef", nan)),
        ("a method of the task", "env", lambda v: v.update({"workflow.task.reset_idx": torch.zeros(8)})),
        ("a class of the task", "env", lambda v: v.update({"workflow.task.__class__": torch.zeros(8)})),
        ("a dictionary of the task", "env", lambda v: v.update({"workflow.task.__dict__": torch.zeros(8)})),
        ("a buffer of one", "env", put("workflow.task.obs_buf", lambda v: v[:1].clone())),
        ("the task's environment", "env", written("env", 3)),
        ("a method as a value", "env", written("reset_idx", 3)),
        ("the class of the task", "env", written("__class__.reset_idx", 3)),
        ("names of a module", "env", written("reset_idx.__globals__", ["dict", []])),
        ("names of its module", "env", written("__init__.__globals__", ["dict", [["os", 1]]])),
        ("an attribute of the environment", "env", written("env.seed", 3)),
        ("an object of numpy", "env", written("fresh", ["scalar", "O", 3])),
        ("bytes of numpy", "env", written("fresh", ["scalar", "V1000000000000", 3])),
        ("no kind of value", "env", written("fresh", ["exec", ["x"]])),
        ("values of text", "env", lambda v: v.update({"workflow.task.plain": torch.zeros(5, dtype=torch.uint8)})),
    ):
        yield Case(f"{part}: {name}", tensors(part, change), RESUMED, "sac")


def logs():
    log, shard = ("logs", "replay"), ("logs", "replay", "shards", 0)
    elsewhere = {"first": 0, "stop": 0, "shards": []}
    for name, damage in (
        ("no rewards", rows(drop("reward"))),
        ("rewards of float64", rows(put("reward", torch.Tensor.double))),
        ("narrow observations", rows(put("obs", lambda v: v[..., :1].clone()))),
        ("one environment", rows(put("obs", lambda v: v[:, :1].clone()))),
        ("a row less", rows(every(lambda v: v[1:].clone()))),
        ("a row less in a column", rows(put("obs", lambda v: v[1:].clone()))),
        ("no columns", rows(drop(""))),
        ("cut", on_rows(lambda file: file.write_bytes(file.read_bytes()[:-9]))),
        ("missing", on_rows(Path.unlink)),
        ("a pickle", on_rows(lambda file: file.write_bytes(pickle.dumps(Bomb())))),
        ("a pipe", on_rows(lambda file: (file.unlink(), os.mkfifo(file)))),
        ("a link", on_rows(lambda file: (file.rename(file.parent / "x"), file.symlink_to(file.parent / "x")))),
        ("from row text", manifest(setting(*shard, "start", to="../../x"))),
        ("from row -1", manifest(setting(*shard, "start", to=-1))),
        ("to row 10**15", manifest(setting(*shard, "stop", to=10**15))),
        (
            "all to row 10**15",
            both(manifest(setting(*shard, "stop", to=10**15)), manifest(setting(*log, "stop", to=10**15))),
        ),
        ("no rows", manifest(setting(*log, "shards", to=[]))),
        ("rows backwards", manifest(setting(*log, "first", to=99))),
        ("first text", manifest(setting(*log, "first", to="0"))),
        ("a size of 2**61", manifest(setting(*shard, "size", to=2**61))),
        ("a hash of nobody", manifest(setting(*shard, "sha256", to="0" * 64))),
        ("a key more", manifest(setting(*shard, "file", to="../../../etc/passwd"))),
        ("shards of text", manifest(setting(*log, "shards", to="abc"))),
        ("a list of logs", manifest(setting("logs", to=[]))),
        ("a log that is a number", manifest(setting(*log, to=3))),
        ("5,000 files", manifest(lambda m: setting(*log, "shards", to=m["logs"]["replay"]["shards"] * 5000)(m))),
        ("elsewhere", manifest(setting("logs", "../../../x", to=elsewhere))),
        ("of the root", manifest(setting("logs", "/etc", to=elsewhere))),
        ("with NUL", manifest(setting("logs", "re\0play", to=elsewhere))),
        ("no iteration", manifest(without("iteration"))),
        ("iteration of text", manifest(setting("iteration", to="x"))),
    ):
        yield Case(f"rows: {name}", damage, RESUMED, "sac")


def named():
    """Return all cases with a name."""
    found = [Case(name, damage, EVERY) for some in (manifests, policies, weights) for name, damage in some()]
    found += [Case(name, damage, RESUMED) for name, damage in states()]
    return [*found, *places(), *layouts(), *learners(), *logs()]


def cut_and_flipped(count):
    """Return truncations and flipped bits all over the files, as disk errors make them: hashes do not match."""
    for number in range(count):
        name = FILES[1:][number % 6]
        where, who = (number * 0.6180339887) % 1.0, EVERY if name.startswith("policy") else RESUMED
        yield Case(f"{name} cut at {where:.4f}", truncated(name, where), who)
        yield Case(f"{name} bit {number % 8} at {where:.4f}", flipped(name, where, number % 8), who)


def forged(count):
    """Return the same damages with matching hashes: the file is read as a policy or refused."""
    for number in range(count):
        name = FILES[number % 7]
        where = (number * 0.7548776662) % 1.0
        for kind, damage in (("cut", truncated(name, where)), ("flipped", flipped(name, where, number % 8))):
            agreeing = damage if name == "manifest.json" else with_hashes(damage, name)
            yield Case(f"forged {name} {kind} at {where:.4f}", agreeing, ())
