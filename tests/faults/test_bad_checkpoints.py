"""Untrusted checkpoints and runs: refused with one message; no code runs, no file changes, memory is limited."""

import hashlib
import json
import shutil
from itertools import cycle
from pathlib import Path

import pytest
import torch
from support.bad_checkpoints import Case, cut_and_flipped, forged, named
from support.checkpoint_damage import Bomb
from support.fault_sizes import amount, chosen

from rlcli.cli.app import main
from rlcli.errors import CheckpointError
from rlcli.runs.checkpoint_reader import open_checkpoint

SMALL = ("scene.num_envs=8", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none", "-q")
SAC = """
agents:
  sac: {trainer: sb3, algorithm: sac, learning_starts: 64, gradient_steps: 1, batch_size: 32, buffer_size: 1000,
        ent_coef: auto, policy: {hidden: [8]}}
"""
GIB = 2**30
LINKS = (".lock", "metrics.jsonl", "run.json", "config.yaml", "checkpoints", "exports", "tb", "checkpoints/latest")


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Path]:
    """Two small runs: PPO with a normaliser on the managed cartpole, SAC on the direct one."""
    folder = tmp_path_factory.mktemp("good")
    (folder / "sac.yaml").write_text(SAC)
    threads = torch.get_num_threads()
    for name, words in (
        ("ppo", ("cartpole", *SMALL, "agent.normalize_observations=true")),
        ("sac", ("cartpole-direct", *SMALL, "--config", str(folder / "sac.yaml"), "--agent", "sac")),
    ):
        assert main(["train", *words, "--max-iterations", "1", "--runs-dir", str(folder / name)]) == 0
    torch.set_num_threads(threads)
    return {name: next((folder / name).glob("*/*")) for name in ("ppo", "sac")}


@pytest.fixture
def stage(runs, tmp_path, monkeypatch):
    """stage(case) -> a copy of its run with the damage in the newest checkpoint, and that checkpoint."""
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()

    def prepare(case):
        run = tmp_path / "runs" / "task" / "run"
        shutil.copytree(runs[case.run], run)
        folder = max(p for p in (run / "checkpoints").iterdir() if p.name.isdecimal())
        case.damage(folder)
        return run, folder

    yield prepare
    torch.set_num_threads(threads)


def command(reader: str, folder: Path | str, run: str = "ppo") -> list[str]:
    """Return the command line of a reader."""
    task = "cartpole" if run == "ppo" else "cartpole-direct"
    other = Path.cwd() / "other"
    return {
        "play": ["play", "--checkpoint", str(folder), "--viewer", "none", "--num-envs", "2"],
        "eval": ["eval", "--checkpoint", str(folder), "--episodes", "2", "--num-envs", "2"],
        "export": ["export", "--checkpoint", str(folder), "--format", "torch", "--output", str(other / "policy.pt2")],
        "init": [
            "train", task, *SMALL, "--init-from", str(folder), "--max-iterations", "1", "--runs-dir", str(other),
            "agent.normalize_observations=true",
        ],
        "resume": ["train", "--resume", str(folder), "--max-iterations", "2", "--runs-dir", str(Path.cwd() / "runs")],
    }[reader]  # fmt: skip


def snapshot(folder: Path) -> dict[str, str]:
    """Return the content of all files below a folder; for special files, their type."""
    found = {}
    for path in sorted(folder.rglob("*")):
        kind = path.lstat().st_mode & 0o170000
        small = path.is_file() and not path.is_symlink() and path.stat().st_size < 2**27
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if small else path.lstat().st_size
        found[str(path.relative_to(folder))] = f"{kind:o} {digest if path.suffix != '.lock' else ''}"
    found.pop(".lock", None)
    return found


def refuse(case: Case, reader: str, run: Path, folder: Path, child, capfd) -> None:
    """Check that the reader reports one error with the file, and changes nothing."""
    before = snapshot(run)
    code, out, err = run_reader(case, command(reader, folder, case.run), child, capfd)
    assert code == 5, f"{case.name}, {reader}: exit {code}\n{err}"
    assert "Traceback" not in err
    errors = [line for line in err.splitlines() if line.startswith("error:") and not line.startswith("error:   ")]
    assert len(errors) == 1, err
    assert run.name in errors[0] or "checkpoints" in errors[0], errors
    assert len(errors[0]) < 1000, "a message is no copy of the file"
    assert out == ""
    assert snapshot(run) == before
    assert not Path("executed").exists()
    assert not list(Path("other").rglob("*.pt2"))
    assert not list(Path("other").rglob("run.json")), "a run that did not begin was left"


def run_reader(case: Case, arguments: list[str], child, capfd) -> tuple[int, str, str]:
    """Run a command; return its exit code and output. Cases that request much memory run as a child with limits."""
    capfd.readouterr()
    if case.bomb:
        ended = child(Path.cwd(), *arguments, memory=GIB).ended()
        return ended.code, ended.out, ended.err
    code = main(arguments)
    return code, *capfd.readouterr()


def with_reader(cases):
    """Return each case with one of the readers that must refuse it, in turn."""
    turn = cycle(range(60))
    return [(case, case.readers[next(turn) % len(case.readers)]) for case in cases]


NAMED = chosen(with_reader(named()), 30)
DAMAGED = with_reader(cut_and_flipped(amount(4, 36, 700)))


@pytest.mark.parametrize(("case", "reader"), [pytest.param(c, r, id=f"{c.name}-{r}"[:80]) for c, r in NAMED + DAMAGED])
def test_damaged_checkpoint_is_refused_and_the_run_unchanged(case, reader, stage, child, capfd):
    run, folder = stage(case)
    refuse(case, reader, run, folder, child, capfd)


@pytest.mark.parametrize("case", [pytest.param(c, id=c.name) for c in forged(amount(7, 60, 700))])
def test_rehashed_checkpoint_is_refused_or_gives_a_valid_policy(case, stage):
    _, folder = stage(case)
    try:
        checkpoint = open_checkpoint(folder)
        policy, state = checkpoint.policy(), checkpoint.state()
    except CheckpointError:
        return
    finite = [value.isfinite().all() for value in policy.state_dict().values()]
    assert all(finite)
    assert policy(torch.zeros(3, policy.spec.observation_size)).shape == (3, policy.spec.action_size)
    assert state.values["env_steps"] == checkpoint.step


def test_file_missing_in_the_manifest_is_not_read(stage):
    def damage(folder):
        torch.save(Bomb(), folder / "policy.pt")
        (folder / "optimizer.pkl").write_bytes(b"\x80\x04garbage")

    _, folder = stage(Case("", damage, ()))
    checkpoint = open_checkpoint(folder)
    assert checkpoint.policy().spec.observation_size == 4
    assert set(checkpoint.state().tensors) == {"policy", "trainer", "env", "rng"}


@pytest.fixture
def continued(stage):
    """Return a run that was resumed once, with checkpoints at steps 0, 128 and 256, and the newest one."""
    run, _ = stage(Case("", lambda folder: None, ()))
    assert main(command("resume", run)) == 0
    return run, run / "checkpoints" / "000000000256"


@pytest.mark.parametrize("reader", ["eval", "init", "resume"])
def test_newest_valid_checkpoint_is_used_with_a_warning(reader, continued, capfd):
    run, folder = continued
    (folder / "policy.safetensors").write_bytes(b"gone")
    words = [
        *command(reader, run),
        *(["-q"] if reader != "init" else []),
        *(["--max-iterations", "3"] * (reader == "resume")),
    ]
    assert main(words) == 0
    err = capfd.readouterr().err
    assert f"warning: checkpoint {folder.name} is skipped: {folder}/policy.safetensors is corrupt" in err
    if reader == "resume":
        assert (folder.parent / "000000000128").is_dir()
        assert (folder.with_name("000000000256.unreadable") / "policy.safetensors").read_bytes() == b"gone"
        open_checkpoint(folder.parent / "000000000384").state()


@pytest.mark.parametrize(
    ("damage", "reader"),
    [
        ("newer format", "resume"), ("newer format", "init"), ("no policy", "resume"), ("no manifest", "resume"),
        ("no manifest", "eval"), ("no checkpoint", "resume"), ("a file", "resume"),
    ],
)  # fmt: skip
def test_trained_policy_is_not_replaced_by_the_untrained_one(damage, reader, stage, capfd):
    run, folder = stage(Case("", lambda folder: None, ()))
    if damage == "newer format":
        manifest = json.loads((folder / "manifest.json").read_text())
        (folder / "manifest.json").write_text(json.dumps({**manifest, "format": 99}))
    elif damage == "a file":
        shutil.rmtree(folder)
        folder.write_text("not a folder")
    else:
        for file in {"no policy": ["policy.safetensors"], "no manifest": ["manifest.json"]}.get(
            damage, folder.iterdir()
        ):
            (folder / file).rename(folder / f"{Path(file).name}.bak")
    before = snapshot(run)
    assert main(command(reader, run)) == 5
    err = capfd.readouterr().err
    expected = "has checkpoint format 99; this rlcli reads 1" if damage == "newer format" else "RUN@step:0"
    assert expected in err
    assert snapshot(run) == before


def test_play_ignores_damage_of_the_training_state(stage, capfd):
    run, folder = stage(Case("", lambda folder: (folder / "rng.safetensors").unlink(), ()))
    assert main(command("eval", run)) == 0
    assert f"{folder.name} (as named, its newest checkpoint)" in capfd.readouterr().err


def test_run_without_a_valid_checkpoint_is_refused(stage, capfd):
    def damage(folder):
        for file in folder.parent.glob("*/policy.json"):
            file.write_text("{")

    run, _ = stage(Case("", damage, ()))
    assert main(command("eval", run)) == 5
    err = capfd.readouterr().err
    assert err.count("error:") == 1
    assert "policy.json is corrupt" in err


@pytest.mark.parametrize(("name", "reader"), chosen([(n, r) for n in LINKS for r in ("eval", "resume")], 4))
def test_run_with_links_is_refused_and_targets_unchanged(name, reader, stage, tmp_path, capfd):
    run, _ = stage(Case("", lambda folder: None, ()))
    own, precious = run / name, tmp_path / "precious"
    if own.exists():
        shutil.move(own, precious)
    else:
        precious.mkdir()
    own.symlink_to(precious)
    before = snapshot(precious) if precious.is_dir() else precious.read_bytes()
    assert main(command(reader, run)) == 5
    err = capfd.readouterr().err
    assert name in err
    assert "a link" in err
    assert (snapshot(precious) if precious.is_dir() else precious.read_bytes()) == before


def test_control_characters_of_a_file_are_not_printed(stage, capfd):
    def damage(folder):
        document = json.loads((folder / "manifest.json").read_text())
        document["layout"]["observations"]["policy"][0]["name"] = "\x1b[2J\x1b]0;title\x07\x9b31m"
        (folder / "manifest.json").write_text(json.dumps(document))

    _, folder = stage(Case("", damage, ()))
    assert main(command("eval", folder)) == 5
    err = capfd.readouterr().err
    assert "title" in err
    assert all(c.isprintable() or c == "\n" for c in err)


@pytest.mark.parametrize(
    "record",
    chosen([b"", b"[]", b"{", b"\xff", b'{"task": 3, "seed": 1}', b'{"seed": NaN}', b'{"a":' * 100_000, b"9" * 5000,
     b'{"task": {"name": "cartpole"}, "seed": 1}', b'{"task": {"name": "cartpole", "folder": "."}, "seed": "x"}',
     b'{"task": {}, "task": {}}', b'{"seed": ' + b"1" * 30 + b"}"], 4),
)  # fmt: skip
def test_malformed_run_record_is_refused(record, stage, capfd):
    run, folder = stage(Case("", lambda folder: None, ()))
    (run / "run.json").write_bytes(record)
    assert main(command("resume", folder)) == 5
    assert "run.json" in capfd.readouterr().err
