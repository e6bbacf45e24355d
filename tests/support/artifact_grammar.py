"""Random damage to every kind of file that rlcli writes, and to its folders; checksums are written again after it.

Each case copies a folder of good artifacts, changes one file or puts a link, a pipe or a folder in its place, and runs
a command that reads it. The command must end with a documented exit code, without a traceback, in little time, and must
change nothing outside of the copy.
"""

import contextlib
import hashlib
import io
import json
import math
import os
import random
import resource
import shutil
import signal
import sys
import time
from pathlib import Path

import safetensors.torch
import torch
from safetensors import safe_open

from rlcli.cli.app import main
from rlcli.replay.trajectory import content_digest
from support.case_runs import run_cases
from support.yaml_grammar import VALUES, Raw, paths

SECONDS = 10
CODES = (0, 2, 3, 4, 5, 6, 7, 8, 9, 10)
SMALL = ("scene.num_envs=4", "sim.engine_threads=1", "agent.torch_threads=1", "agent.n_steps=8",
         "agent.num_minibatches=2", "agent.policy.hidden=[4]", "episode_length_s=0.3", "-q")  # fmt: skip
TRAIN = ("train", "cartpole", *SMALL, "agent.save_interval=1", "agent.autopsy.keep=10")
SWEEP = ("sweep", "cartpole", *SMALL, "--param", "agent.learning_rate=1e-4:1e-3", "--trials", "2", "--episodes", "2",
         "--max-iterations", "1", "--name", "s")  # fmt: skip
EVAL = ("eval", "--checkpoint", "{run}", "--episodes", "2", *SMALL[:2])
EXPORT = ("export", "--checkpoint", "{run}", "--format")
NUMBERS = [math.nan, math.inf, -1, 0, 2**31, 2**62, 10**30, 1e300, True]
READERS = {
    "run": [
        ("runs",), ("diff", "{run}", "{other}"), ("watch", "{run}", "--json"), ("plot", "{run}", "--output", "p.png"),
        ("report", "{run}", "--no-eval", "--no-video"), EVAL, (*EVAL, "--record", "{run}/rec.safetensors"),
        ("train", "--resume", "{run}", "--max-iterations", "3", "-q"), ("autopsy", "{run}"), ("autopsy", "{run}", "0"),
        (*EXPORT, "torch"), (*EXPORT, "numpy"), (*EXPORT, "numpy", "--verify", "--episodes", "2"), (*EXPORT, "bundle"),
        ("validate", "{run}/config.yaml"),
        (*TRAIN, "--max-iterations", "1", "--init-from", "{run}"),
    ],
    "rec.safetensors": [("replay", "rec.safetensors")],
    "bundle": [
        ("eval", "--checkpoint", "bundle", "--episodes", "2", *SMALL[:2]),
        ("export", "--checkpoint", "bundle", "--format", "numpy", "--output", "x.py"),
    ],
    "study": [
        ("runs",), ("train", "--resume", "{study}", "--max-iterations", "3", "-q"),
        ("plot", "{study}", "--output", "p.png"),
    ],
    "sweep": [("sweep", "show", "s"), SWEEP, ("sweep", "show", "{sweep}", "--plot"), ("runs",)],
}  # fmt: skip
"""Artifact -> the commands that read it."""


def make_artifacts(folder):
    """Write good artifacts into a folder."""
    with contextlib.chdir(folder):
        runs = (*TRAIN, "--max-iterations", "2", "agent.eval_interval=1", "agent.eval_episodes=2")
        assert main([*runs, "--name", "a"]) == 0
        assert main([*runs, "--name", "b", "--seed", "5"]) == 0
        (run,) = Path("runs/cartpole").glob("*-a")
        evaluation = ("eval", "--checkpoint", str(run), "--episodes", "4", *SMALL[:2], "-q")
        assert main([*evaluation, "--record", "rec.safetensors"]) == 0
        assert main(["export", "--checkpoint", str(run), "--format", "bundle", "--output", "bundle", "-q"]) == 0
        assert main([*TRAIN, "--max-iterations", "1", "--seeds", "2", "--name", "seeds"]) == 0
        assert main(list(SWEEP)) == 0
    return folder


def places(folder):
    """Return the path of each artifact."""
    tasks = folder / "runs" / "cartpole"
    found = {"run": "*-a", "other": "*-b", "study": "*-seeds", "sweep": "sweep-s"}
    return {name: str(next(tasks.glob(pattern)).relative_to(folder)) for name, pattern in found.items()}


def plain(value):
    """Return a value of the YAML grammar that JSON can hold."""
    if isinstance(value, Raw):
        return str(value)
    return value


def mutate_json(draw, data):
    """Change JSON data once."""
    found = list(paths(data))
    value = plain(draw.choice([*VALUES, *NUMBERS, *NUMBERS]))
    if not found or draw.random() < 0.05:
        return value
    *outer, last = draw.choice(found)
    container = data
    for step in outer:
        container = container[step]
    kind = draw.randrange(6)
    if kind == 0:
        del container[last]
    elif kind == 1 and isinstance(container, dict):
        container[str(plain(draw.choice(VALUES)))[:300]] = container[last]
    elif kind == 2 and isinstance(container[last], list):
        container[last] = container[last] * draw.choice([2, 1000]) or [value]
    else:
        container[last] = value
    return data


def mutate_bytes(draw, data):
    """Change bytes at a few places, or cut them."""
    data = bytearray(data)
    for _ in range(draw.randint(1, 3)):
        at, kind = draw.randrange(len(data) + 1), draw.randrange(5)
        if kind == 0:
            del data[at:]
        elif kind == 1:
            data[at : at + 8] = draw.choice([b"\xff" * 8, b"\0" * 8, b"\n", b"{}", b"9" * 400, b"[" * 5000])
        elif kind == 2:
            data[at : at + draw.randint(1, 30)] = b""
        elif kind == 3:
            data[at : at + 1] = bytes([draw.randrange(256)])
        else:
            data[at:at] = data[: draw.randint(1, 200)]
    return bytes(data)


def mutate_tensors(draw, file):
    """Change the tensors or the metadata of a safetensors file, and write its digest again."""
    with safe_open(file, "pt") as opened:
        metadata = dict(opened.metadata() or {})
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    document = json.loads(metadata["rlcli"]) if "rlcli" in metadata else None
    if document is not None and (draw.random() < 0.6 or not tensors):
        had_digest = document.pop("sha256", None) is not None
        document = mutate_json(draw, document)
    else:
        had_digest = document is not None and document.pop("sha256", None) is not None
        name = draw.choice(sorted(tensors)) if tensors else "x"
        value = tensors.get(name, torch.zeros(1))
        tensors[name] = draw.choice([
            lambda: value.to(draw.choice([torch.float16, torch.int64, torch.bool, torch.uint8])),
            lambda: value.reshape(-1)[: draw.randrange(value.numel() + 1)], lambda: value[None],
            lambda: torch.full_like(value, draw.choice([0, 1, 2])) * 100,
            lambda: torch.zeros(draw.choice([0, 1, 10**6])),
            lambda: value.double() * math.nan, lambda: value.double() + 1e300, lambda: value.double() * 0 - 7,
        ])().contiguous()  # fmt: skip
        if draw.random() < 0.2:
            del tensors[name]
    if document is not None:
        if had_digest and isinstance(document, dict):
            document["sha256"] = content_digest(tensors, document)
        metadata["rlcli"] = json.dumps(document).encode("utf-8", "replace").decode()
    safetensors.torch.save_file(tensors, file, metadata=metadata)


def mutate_file(draw, file):
    """Damage one file; return what was done."""
    if draw.random() < 0.12:
        return replace_file(draw, file)
    if file.suffix == ".safetensors" and draw.random() < 0.7:
        mutate_tensors(draw, file)
        return "tensors"
    if (file.suffix in (".json", ".jsonl") or file.name == "journal.log") and draw.random() < 0.85:
        lines = file.read_text().splitlines() if file.suffix != ".json" else [file.read_text()]
        at = draw.randrange(max(1, len(lines)))
        lines[at : at + 1] = [json.dumps(mutate_json(draw, json.loads(lines[at])))]
        file.write_text("\n".join(lines) + "\n")
        return "json"
    file.write_bytes(mutate_bytes(draw, file.read_bytes()))
    return "bytes"


def replace_file(draw, file):
    """Put something in place of a file."""
    kind = draw.choice(["pipe", "link out", "link to itself", "link to a device", "folder", "nothing", "empty", "hole"])
    content = file.read_bytes()
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "link out":
        file.symlink_to(Path.cwd().parent / "victim")
        (Path.cwd().parent / "victim").write_bytes(content)
    elif kind == "link to itself":
        file.symlink_to(file.name)
    elif kind == "link to a device":
        file.symlink_to(draw.choice(["/dev/zero", "/dev/tty", "/dev/full", "/proc/self/mem"]))
    elif kind == "folder":
        file.mkdir()
    elif kind == "empty":
        file.touch()
    elif kind == "hole":
        with file.open("wb") as opened:
            opened.truncate(3 << 30)
    return kind


def rehash(folder):
    """Write the sizes and digests of the manifests in a folder again."""
    found = (file for file in folder.rglob("manifest.json") if file.is_file() and file.stat().st_size < 1e6)
    for manifest in found:
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
            document = json.loads(manifest.read_text())
            for name, entry in document["files"].items():
                file = manifest.parent / name
                data = file.read_bytes() if file.is_file() and file.stat().st_size < 1e8 else b""
                entry.update({"sha256": hashlib.sha256(data).hexdigest()})
                if "bytes" in entry:
                    entry["bytes"] = len(data)
                if "size" in entry:
                    entry["size"] = len(data)
            manifest.write_text(json.dumps(document))


class Hang(BaseException):
    """Command that takes too long."""


def hang(*_):
    raise Hang


def run(seed, good, folder):
    """Run a case in an empty folder; return its exit code and what is wrong (empty: nothing)."""
    draw = random.Random(seed)
    work = folder / "work"
    shutil.copytree(good, work, symlinks=True)
    with contextlib.chdir(work):
        where = {**places(work), "bundle": "bundle", "rec.safetensors": "rec.safetensors"}
        name = draw.choice(list(READERS))
        at = Path(where[name])
        files = (
            [at] if at.is_file() else sorted(file for file in at.rglob("*") if file.is_file() and not file.is_symlink())
        )
        file = draw.choice(files)
        words = [word.format(**where) for word in draw.choice(READERS[name])]
        done = mutate_file(draw, file)
        if draw.random() < 0.7:
            rehash(at)
        victim = folder / "victim"
        before = victim.read_bytes() if victim.exists() else None
        out, err = io.StringIO(), io.StringIO()
        begin, code = time.process_time(), None
        signal.signal(signal.SIGALRM, hang)
        signal.alarm(20 * SECONDS)
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                code = main(words)
        except Hang:
            return None, f"{file} ({done}): {' '.join(words)}: hangs"
        finally:
            signal.alarm(0)
        seconds = time.process_time() - begin
        wrong = complaint(code, out.getvalue(), err.getvalue(), seconds)
        if victim.exists() and victim.read_bytes() != before:
            wrong = "a file outside was written"
    return code, wrong and f"{file} ({done}): {' '.join(words)}: {wrong}"


def complaint(code, out, err, seconds):
    """Return what is wrong with the result of a command."""
    if "Traceback" in err or "bug in rlcli" in err or code not in CODES:
        return f"exit {code}: {err[-1500:]}"
    if seconds > SECONDS:
        return f"{seconds:.0f} s"
    for line in (out + err).splitlines():
        if len(line) > 2500 or "\x1b" in line or "\u202e" in line or any("\ud800" <= c < "\ue000" for c in line):
            return f"long or unsafe line: {line[:300]!r}"
    for line in err.splitlines():
        if line.startswith("hint: run: curl"):
            return f"foreign line {line[:200]!r}"
        if line.startswith(("error: ", "hint: ", "warning: ")) and any(len(word) > 260 for word in line.split()):
            return f"long word: {line[:300]!r}"
    return "" if not code or err.strip() or out.strip() else "no message"


def run_all(first, count, good, folder):
    """Run cases; print each bad one and the counts; return the number of bad ones."""
    torch.set_num_threads(1)
    return run_cases(lambda seed: run(seed, good, folder), first, count, folder)


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))
    base = Path(sys.argv[3]).resolve()
    if not (base / "good").exists():
        (base / "good").mkdir(parents=True)
        make_artifacts(base / "good")
    sys.exit(run_all(int(sys.argv[1]), int(sys.argv[2]), base / "good", base / f"cases-{sys.argv[1]}") > 0)
