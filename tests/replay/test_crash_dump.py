"""Dump of a run's first divergence, and `rlcli replay` of trusted and untrusted dumps."""

import json
from pathlib import Path

import pytest
import safetensors.torch
import torch
from safetensors import safe_open

from rlcli.errors import CheckpointError
from rlcli.replay.resimulate import replay_calls
from rlcli.replay.trajectory import content_digest, read_trajectory

pytestmark = pytest.mark.usefixtures("empty_folder")

BREAKS = '''
import torch
from rlcli.envs.direct import DirectTask


class Task(DirectTask):
    """Task whose environment 5 diverges in the fourth and sixth step of its first episode."""

    num_observations = 1
    num_actions = 1

    def pre_physics_step(self, actions):
        for step, value in ((3, float("nan")), (5, 1e30)):
            if int(self.env.episode_index[5]) == 0 and int(self.progress_buf[5]) == step:
                self.env.engine.field("qvel")[5, 0] = value
        if int(self.env.episode_index[5]) == 1 and int(self.progress_buf[5]) == 5:
            self.env.engine.field("qvel")[5, 0] = 1e30

    def get_observations(self):
        self.obs_buf[:, 0] = self.progress_buf

    def calculate_metrics(self):
        self.rew_buf[:] = 1.0

    def is_done(self):
        self.reset_buf.zero_()
'''


@pytest.fixture
def diverging_task(coin):
    task = Path(coin) / "task.yaml"
    lines = task.read_text().splitlines()
    task.write_text("\n".join(line for line in lines if not line.startswith(("params", "success"))))
    (Path(coin) / "task.py").write_text(BREAKS)
    return coin


@pytest.fixture
def dump(diverging_task, cli):
    assert cli("eval", diverging_task, "--policy", "zero", "--episodes", "32", "--quiet").code == 0
    (file,) = Path("runs/dumps").iterdir()
    return file


def rewrite_dump(file, **changes):
    """Return a dump with changed content and a matching digest, as an attacker may write it."""
    with safe_open(file, "pt") as opened:
        document = json.loads(opened.metadata()["rlcli"])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    document.pop("sha256")
    tensors.update(changes.pop("tensors", {}))
    document["worlds"][0].update(changes.pop("world", {}))
    document.update(changes)
    document["sha256"] = content_digest(tensors, document)
    safetensors.torch.save_file(tensors, file, metadata={"rlcli": json.dumps(document)})


@pytest.mark.slow
def test_first_divergence_is_dumped_and_replayed(diverging_task, cli, only_run):
    trained = cli("train", diverging_task, "--max-iterations", "3", "--logger", "none")
    assert trained.code == 0, trained.err
    (line,) = [line for line in trained.err.splitlines() if "diverged for the first time" in line]
    (file,) = (only_run() / "dumps").iterdir()
    assert "environment 5: BADQVEL" in line
    assert f"rlcli replay {file}" in line
    rows = [json.loads(row) for row in (only_run() / "metrics.jsonl").read_text().splitlines()]
    assert [row.get("Sim/diverged/BADQVEL") for row in rows] == [1.0, 1.0, None], "counted in its iteration"
    shown = cli("replay", file)
    assert shown.code == 0
    assert "in physics step 0 of call 3, t = 0.03 s: joint 'robot/slide'" in shown.out
    assert "qvel nan" in shown.out
    assert "4 engine calls simulated again, 3 states compared: equal bit by bit" in shown.out
    document = cli("replay", file, "--json").json
    assert document["equal"] is True
    (found,) = document["environments"]
    assert (found["env"], found["cause"], found["where"]["call"]) == (5, "BADQVEL", 3)


def test_eval_without_a_run_counts_divergences_and_dumps_one(diverging_task, cli):
    message = cli("eval", diverging_task, "--policy", "zero", "--episodes", "32", "--json")
    assert message.code == 0
    assert message.json["diverged_by"] == {"BADQVEL": message.json["diverged"]}
    (file,) = Path("runs/dumps").iterdir()
    assert str(file) in message.err
    assert cli("replay", file).code == 0


def test_dump_replaces_no_other_one(dump, diverging_task, cli):
    first = dump.read_bytes()
    cli("eval", diverging_task, "--policy", "zero", "--episodes", "32", "--quiet")
    assert dump.read_bytes() == first
    assert sorted(file.name for file in Path("runs/dumps").iterdir()) == [f"{dump.stem}-2.safetensors", dump.name]


def test_dump_is_not_written_through_a_link(diverging_task, cli, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    Path("runs").mkdir()
    Path("runs/dumps").symlink_to(elsewhere)
    message = cli("eval", diverging_task, "--policy", "zero", "--episodes", "32")
    assert f"there is no dump: {Path('runs/dumps').absolute()} is a link" in message.err
    assert not list(elsewhere.iterdir())


def test_replay_of_a_changed_state_exits_9(dump, cli):
    model = Path("coin/model.xml")
    model.write_text(model.read_text().replace('type="slide"', 'type="slide" stiffness="10" springref="1"'))
    shown = cli("replay", dump, "--json")
    assert shown.code == 9
    assert (shown.json["equal"], shown.json["same_model"]) == (False, False)
    assert (shown.json["difference"]["env"], shown.json["difference"]["call"]) == (5, 0)
    assert "the task's model has changed since the file was written" in shown.err


def test_replay_refuses_a_dump_of_another_model(dump, cli):
    model = Path("coin/model.xml")
    model.write_text(model.read_text().replace("</body>", '<joint name="more" type="slide" axis="1 0 0"/></body>'))
    shown = cli("replay", dump)
    assert shown.code == 5
    assert "does not fit the installed task" in shown.err


def test_eval_continues_if_the_dump_cannot_be_written(diverging_task, cli):
    Path("runs").mkdir()
    Path("runs/dumps").write_text("in the way")
    message = cli("eval", diverging_task, "--policy", "zero", "--episodes", "32")
    assert message.code == 0
    assert "there is no dump" in message.err


def test_replay_refuses_recording_options_for_a_dump(dump, cli):
    assert cli("replay", dump, "--episode", "0").code == 2


ATTACKS = {
    "an endless call": {"world": {"nstep": [10**9] * 4}},
    "calls that are not there": {"world": {"nstep": [1] * 5}},
    "no environment": {"worlds": []},
    "another format": {"format": 1},
    "a key of its own": {"extra": "import os"},
    "a number for a text": {"config": 7},
    "states of another size": {"tensors": {"world.0.states": torch.zeros(4, 3, dtype=torch.float64),
                                           "world.0.final": torch.zeros(3, dtype=torch.float64)}},
    "states of whole numbers": {"tensors": {"world.0.states": torch.zeros(4, 12, dtype=torch.int64)}},
    "an address in the model": {"tensors": {"world.0.model.jnt_qposadr": torch.tensor([2**30], dtype=torch.int32)}},
    "a kind in the model": {"tensors": {"world.0.model.geom_type": torch.tensor([99, 99], dtype=torch.int32)}},
    "no field of the model": {"tensors": {"world.0.model.__class__": torch.zeros(1)}},
}  # fmt: skip


@pytest.mark.timeout(60)  # a call of 1e9 steps takes many minutes
@pytest.mark.parametrize("attack", ATTACKS)
def test_untrusted_dump_is_refused_with_file_and_reason(dump, cli, attack):
    changes = ATTACKS[attack]
    if "worlds" in changes:
        with safe_open(dump, "pt") as opened:
            document = json.loads(opened.metadata()["rlcli"])
        document["worlds"] = []
        safetensors.torch.save_file({}, dump, metadata={"rlcli": json.dumps(document)})
    else:
        rewrite_dump(dump, **{key: dict(value) if isinstance(value, dict) else value for key, value in changes.items()})
    shown = cli("replay", dump)
    assert shown.code == 5
    assert str(dump) in shown.err


def test_truncated_or_changed_dump_is_refused(dump):
    whole = dump.read_bytes()
    for end in range(0, len(whole), max(1, len(whole) // 25)):
        dump.write_bytes(whole[:end])
        with pytest.raises(CheckpointError):
            read_trajectory(dump)
    for place in range(0, len(whole), max(1, len(whole) // 40)):
        changed = bytearray(whole)
        changed[place] ^= 0x10
        dump.write_bytes(changed)
        with pytest.raises(CheckpointError):
            read_trajectory(dump)
    dump.write_bytes(whole)
    assert replay_calls(read_trajectory(dump)).difference is None


def test_deeply_nested_header_is_refused(tmp_path):
    file = tmp_path / "deep.safetensors"
    safetensors.torch.save_file({"x": torch.zeros(1)}, file, metadata={"rlcli": "[" * 1_000_000})
    with pytest.raises(CheckpointError, match="not a valid recording, crash dump or failure case") as caught:
        read_trajectory(file)
    assert "--record FILE makes a recording" in caught.value.hint
