"""`rlcli autopsy`: recorded episodes of own and untrusted runs are listed and shown."""

import json
import os
import shutil
from pathlib import Path

import pytest
import safetensors.torch
import torch
from safetensors import safe_open

from rlcli.cli.commands.autopsy import sparkline
from rlcli.replay.trajectory import content_digest
from rlcli.runs.trusted_tasks import named_task

pytestmark = pytest.mark.usefixtures("empty_folder")

TRAIN = ("--max-iterations", "3", "--logger", "none", "--quiet", "agent.autopsy.keep=6")


@pytest.fixture(scope="module")
def trained_once(tmp_path_factory):
    """Folder for a run of the coin task, whose episodes fail at once or last to the end; trained once."""
    return tmp_path_factory.mktemp("once")


@pytest.fixture
def trained(coin, cli, trained_once, only_run):
    if not (trained_once / "runs").exists():
        assert cli("train", coin, *TRAIN).code == 0
        shutil.copytree("runs", trained_once / "runs")
    else:
        shutil.copytree(trained_once / "runs", "runs")
        record = only_run() / "run.json"
        data = json.loads(record.read_text())
        moved = str(named_task(coin).root)
        data["task"]["folder"] = moved
        record.write_text(json.dumps(data))
        for file in files(only_run()):
            rewrite(file, document=lambda d: d["task"].update(folder=moved))
    return only_run()


def rewrite(file, document=lambda d: None, tensors=lambda t: None):
    """Rewrite a case as an attacker could, with a correct digest."""
    with safe_open(file, "pt") as opened:
        data = json.loads(opened.metadata()["rlcli"])
        values = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    data.pop("sha256")
    document(data)
    tensors(values)
    data["sha256"] = content_digest(values, data)
    safetensors.torch.save_file(values, file, metadata={"rlcli": json.dumps(data)})


def files(run):
    return sorted((run / "autopsy").glob("*.safetensors"))


def test_list_has_step_environment_and_reason(trained, cli):
    shown = cli("autopsy", trained)
    assert shown.code == 0
    lines = shown.out.splitlines()
    assert lines[0].split() == ["CASE", "ITERATION", "STEP", "ENV", "EPISODE", "LENGTH", "RETURN", "KEPT", "FOR", "ENDED", "BY", "RECORDED"]  # fmt: skip # noqa: E501
    document = cli("autopsy", trained, "--json").json
    assert document["command"] == "autopsy"
    cases = document["cases"]
    assert len(cases) == len(lines) - 1 == len(files(trained))
    assert [case["case"] for case in cases] == list(range(len(cases)))
    assert [case["step"] for case in cases] == sorted(case["step"] for case in cases)
    failed = [case for case in cases if case["kept_for"] == "terminated"]
    assert failed
    for case in failed:
        assert case["step"] == case["iteration"] * 32 * 8
        assert (case["length"], case["return"], case["ended_by"], case["truncated"]) == (1, 1.0, ["task"], False)
        assert case["steps_kept"] == 1
        assert Path(case["file"]).is_file()


def test_sorting_keeps_case_numbers(trained, cli):
    plain = {case["case"]: case["file"] for case in cli("autopsy", trained, "--json").json["cases"]}
    for order, key in (("length", "length"), ("return", "return"), ("kind", "kept_for")):
        cases = cli("autopsy", trained, "--sort", order, "--json").json["cases"]
        assert [case[key] for case in cases] == sorted(case[key] for case in cases)
        assert {case["case"]: case["file"] for case in cases} == plain


def test_case_is_shown_and_replays_bit_by_bit(trained, cli):
    shown = cli("autopsy", trained, "0")
    assert shown.code == 0
    assert "kept for: terminated; ended by: task" in shown.out
    assert "contacts at the end: none" in shown.out
    document = cli("autopsy", trained, "0", "--json").json
    assert document["reward"] == [1.0]
    assert list(document["observations"]) == ["obs_buf"]
    assert document["observations"]["obs_buf"] == [1.0]
    assert document["time"] == [0.01]
    assert document["same_model"] is True
    assert len(document["actions"]["actions"]) == 1
    for file in files(trained):
        replayed = cli("replay", file, "--json")
        assert replayed.code == 0
        assert replayed.json["equal"] is True
        assert f"rlcli replay {file}" in cli("autopsy", trained, files(trained).index(file)).out


def test_replay_with_changed_model_differs(trained, cli):
    model = Path("coin/model.xml")
    model.write_text(model.read_text().replace('type="slide"', 'type="slide" stiffness="10" springref="1"'))
    shown = cli("replay", files(trained)[0], "--json")
    assert (shown.code, shown.json["equal"], shown.json["same_model"]) == (9, False, False)
    assert "the model of the installed task differs from the model in training" in cli("autopsy", trained, "0").err


def test_unknown_case_is_usage_error(trained, cli):
    shown = cli("autopsy", trained, "99", "--json")
    assert shown.code == 2
    assert f"give a number from 0 to {len(files(trained)) - 1}" in shown.json["error"]["hint"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sort", "lenth"], "did you mean 'length'"),
        (["--video", "x.mp4"], "--video needs the number of a recorded episode"),
        (["0", "--video", "x.avi"], "is not a video file"),
    ],
)
def test_invalid_options_are_usage_errors(trained, cli, arguments, message):
    shown = cli("autopsy", trained, *arguments)
    assert shown.code == 2
    assert message in shown.err


def test_disabled_autopsy_records_nothing(coin, cli, only_run):
    assert cli("train", coin, "--max-iterations", "1", "--logger", "none", "agent.autopsy=null").code == 0
    assert not (only_run() / "autopsy").exists()
    shown = cli("autopsy", only_run(), "--json")
    assert (shown.code, shown.json["cases"]) == (0, [])
    assert "agent.autopsy" in shown.json["why_none"]


def test_gpu_run_explains_missing_cases(trained, cli):
    for file in files(trained):
        file.unlink()
    record = json.loads((trained / "run.json").read_text()) | {"device": "cuda"}
    (trained / "run.json").write_text(json.dumps(record))
    shown = cli("autopsy", trained)
    assert shown.code == 0
    assert "the run was trained on cuda, where steps cannot be replayed" in shown.err
    assert cli("autopsy", trained, "0").code == 2


def test_untrusted_task_code_is_not_run(trained, cli, monkeypatch, tmp_path):
    monkeypatch.setenv("RLCLI_STATE_DIR", str(tmp_path / "empty"))
    (Path("coin") / "task.py").write_text("import pathlib; pathlib.Path('executed').touch()")
    shown = cli("autopsy", trained, "0")
    assert shown.code == 0
    assert "contacts cannot be shown: " in shown.err
    assert "has not been used on this machine before" in shown.err
    assert "REWARD PER STEP" in shown.out
    assert cli("autopsy", trained).code == 0
    assert cli("autopsy", trained, "0", "--video", "x.gif").code == 5
    assert not Path("executed").exists()


SEEN = "episode.0.observations"
ATTACKS = {
    "steps that are not there": {"tensors": lambda t: t.update({"episode.0.rewards": torch.ones(7)})},
    "no steps": {"tensors": lambda t: t.update({"episode.0.rewards": torch.ones(0), SEEN: torch.ones(0, 1)})},
    "kept steps that are not there": {"document": lambda d: d["episodes"][0].update(kept=7)},
    "an observation too many": {"tensors": lambda t: t.update({SEEN: torch.ones(1, 2)})},
    "observations of whole numbers": {"tensors": lambda t: t.update({SEEN: torch.ones(1, 1, dtype=torch.int64)})},
    "another kind of file": {"document": lambda d: d.update(kind="recording")},
    "a call beyond the last": {"document": lambda d: d["worlds"][0].update(first=5)},
    "a world too many": {"document": lambda d: d["worlds"].append(d["worlds"][0])},
    "an endless call": {"document": lambda d: d["worlds"][0].update(nstep=[10**9])},
    "no time": {"document": lambda d: d.update(step_dt=0.0)},
    "steps that take for ever": {"document": lambda d: d.update(step_dt=1e308)},
    "an episode longer than any float": {"document": lambda d: d["episodes"][0].update(length=10**400)},
    "an environment of 400 digits": {"document": lambda d: d["worlds"][0].update(env=10**400)},
    "a task from nowhere": {"document": lambda d: d.update(task={})},
    "a task without a name": {"document": lambda d: d["task"].update(name=None)},
    "a kind of its own": {"document": lambda d: d["failure"].update(kind="rm -rf")},
    "text for a number": {"document": lambda d: d["episodes"][0].update(index="1")},
    "a key of its own": {"document": lambda d: d["failure"].update(extra=1)},
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("attack", ATTACKS)
def test_corrupt_case_is_skipped_with_file_and_reason(trained, cli, attack):
    first, *others = files(trained)
    rewrite(first, **ATTACKS[attack])
    shown = cli("autopsy", trained, "--json")
    assert shown.code == 0
    assert [case["file"] for case in shown.json["cases"]] == [str(file) for file in others]
    assert f"skipped: {first}" in shown.err
    assert cli("replay", first).code == 5


def test_untrusted_text_has_no_control_characters(trained, cli):
    rewrite(files(trained)[0], document=lambda d: d["episodes"][0].update(causes=["\x1b[2J\x1b]0;owned\x07"]))
    for arguments in ((), ("0",)):
        shown = cli("autopsy", trained, *arguments)
        assert shown.code == 0
        assert "\x1b" not in shown.out
        assert "owned" in shown.out


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes here")
@pytest.mark.timeout(60)
@pytest.mark.parametrize("what", ["a link in the folder", "a link as the folder", "a pipe", "a folder", "half a file"])
def test_links_pipes_and_folders_are_not_read(trained, cli, tmp_path, what):
    folder, first = trained / "autopsy", files(trained)[0]
    if what == "a link as the folder":
        folder.rename(tmp_path / "elsewhere")
        folder.symlink_to(tmp_path / "elsewhere")
    elif what == "half a file":
        first.write_bytes(first.read_bytes()[:-5])
    else:
        first.rename(tmp_path / "moved")
        if what == "a link in the folder":
            first.symlink_to(tmp_path / "moved")
        elif what == "a pipe":
            os.mkfifo(first)
        else:
            first.mkdir()
    shown = cli("autopsy", trained)
    assert shown.code == (5 if what.startswith("a link") else 0)
    assert ("is a link" if what.startswith("a link") else f"skipped: {first}") in shown.err


def test_sparkline_follows_values():
    assert sparkline([0.0, 1.0, 2.0, 7.0]) == "▁▂▃█"
    assert sparkline([5.0, 5.0]) == "▄▄"
    assert sparkline([0.0, float("nan"), 7.0]) == "▁?█"
    assert sparkline([]) == ""
    assert len(sparkline(range(1000))) == 48
    assert sparkline(range(1000)) == "".join(sorted(sparkline(range(1000))))


@pytest.mark.slow
def test_case_video_is_written(trained, cli):
    imageio = pytest.importorskip("imageio.v2")
    longest = max(cli("autopsy", trained, "--json").json["cases"], key=lambda case: case["length"])
    shown = cli("autopsy", trained, longest["case"], "--video", "x.gif", "--json")
    assert shown.code == 0, shown.err
    assert shown.json["frames"] >= 1
    assert imageio.mimread("x.gif")[0].std() > 0
