"""`rlcli diff` reports the first difference of two runs; `rlcli reproduce` trains a run again and compares."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save

from rlcli.runs.checkpoint_reader import sha256
from rlcli.runs.run_diff import SECTIONS

pytestmark = pytest.mark.usefixtures("empty_folder")

SMALL = ("agent.n_steps=8", "scene.num_envs=8", "agent.save_interval=1", "--max-iterations", "3", "-q")
SMALL += ("--logger", "none")


@pytest.fixture
def trained(cli, coin):
    """Return a function that trains the coin task and returns the run folder."""

    def train(*arguments):
        result = cli("train", coin, *SMALL, *arguments)
        assert result.code == 0, result.err
        return Path(result.out.strip())

    return train


_TRAINED = []
"""The run that all tests of this process copy."""


@pytest.fixture
def run(request):
    if not _TRAINED:
        _TRAINED.append(request.getfixturevalue("trained")("--name", "first").resolve())
    return Path(shutil.copytree(_TRAINED[0], Path("runs/coin/a-run")))


@pytest.fixture
def copy(run):
    """A copy of the run for changes."""
    return Path(shutil.copytree(run, run.with_name("copy")))


def edit(file, change):
    """Change a JSON file in place."""
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def last(run):
    return sorted((run / "checkpoints").glob("[0-9]*"))[-1]


def replace(folder, part, change):
    """Change one file of a checkpoint, and its entry in the manifest."""
    file = folder / f"{part}.safetensors"
    tensors = load_file(file)
    change(tensors)
    data = save(tensors)
    file.write_bytes(data)
    entry = {"size": len(data), "sha256": sha256(data)}
    edit(folder / "manifest.json", lambda manifest: manifest["files"].update({file.name: entry}))


def sections(result):
    return {section["name"]: section["differences"] for section in result.json["sections"]}


@pytest.mark.slow
def test_runs_with_same_seed_have_no_difference(cli, trained):
    one, other = trained(), trained()
    result = cli("diff", one, other)
    assert (result.code, result.err) == (0, "")
    assert result.out.splitlines()[-1] == "no difference"
    assert "3 iterations" in result.out
    assert "4 steps" in result.out


def test_run_compared_with_itself_has_no_difference(cli, run):
    result = cli("diff", run, run.name, "--json")
    assert result.code == 0
    assert (result.json["command"], result.json["equal"], result.json["first"]) == ("diff", True, None)
    assert tuple(section["name"] for section in result.json["sections"]) == SECTIONS


@pytest.mark.slow
def test_configuration_difference_comes_before_its_effects(cli, trained, run):
    other = trained("--seed", "5", "params.chance=0.25")
    result = cli("diff", run, other, "--json")
    assert result.code == 9
    first = result.json["first"]
    assert (first["section"], first["where"], first["left"], first["right"]) == (
        "configuration",
        "params.chance",
        0.5,
        0.25,
    )
    found = sections(result)
    assert [(d["where"], d["left"], d["right"]) for d in found["configuration"]][1:] == [("seed", 42, 5)]
    (chance,) = [d for d in found["configuration"] if d["where"] == "params.chance"]
    assert (chance["left"], chance["right"]) == (0.5, 0.25)
    assert chance["left_from"].startswith("config.yaml:")
    assert chance["right_from"] == "override 'params.chance=0.25'"
    assert found["environment"] == []
    assert found["metrics"][0]["where"].startswith("iteration 1: ")
    assert found["weights"][0]["where"].startswith("step 0: policy ")
    assert found["policy"][0]["where"] == "step 192: policy.safetensors sha256"


def test_run_and_task_compare_configuration_and_files(cli, run, coin):
    result = cli("diff", run, coin, "--json")
    assert result.code == 9
    found = {d["where"]: (d["left"], d["right"], d["category"]) for d in sections(result)["configuration"]}
    assert found["agent.max_iterations"] == (3, 2, "agent")
    assert found["scene.num_envs"][::2] == (8, "agent")
    assert found["agent.save_interval"] == (1, None, "cosmetic")
    assert "seed" not in found, "a task has none"
    assert sections(result)["files"] == []
    same = cli("diff", coin, *SMALL[:3], "agent.max_iterations=3", run, "--json")
    assert (same.code, sections(same)["configuration"]) == (0, [])
    model = (
        Path(shutil.copytree(coin, "other")) / "model.xml"
    )  # a copy, because all runs of this process share the task
    model.write_text(model.read_text().replace('mass="1"', 'mass="2"'))
    changed = cli("diff", "./other", *SMALL[:3], "agent.max_iterations=3", run, "--json")
    assert (changed.code, [d["where"] for d in sections(changed)["files"]]) == (9, ["model.xml"])
    assert cli("diff", run, "sim.dt=0.1", coin).code == 2, "a run has no overrides"


def test_environment_section_has_facts_that_change_bits(cli, run, copy):
    def change(record):
        record["versions"]["torch"] = "2.10.0"
        record["variables"]["MKL_CBWR"] = "AVX2"
        record["torch"]["cpu_capability"] = "NEON"
        record["pid"], record["platform"], record["command"], record["started"] = 1, "elsewhere", [], "1970"

    edit(copy / "run.json", change)
    result = cli("diff", run, copy, "--json")
    assert result.code == 9
    assert [d["where"] for d in sections(result)["environment"]] == [
        "versions.torch", "variables.MKL_CBWR", "torch.cpu_capability",
    ]  # fmt: skip
    assert sum(len(found) for found in sections(result).values()) == 3
    assert cli("diff", run, copy, "--only", "metrics", "--only", "weights").code == 0


def test_older_records_compare_common_entries(cli, run, copy):
    def forget(record):
        for key in ("sources", "cpu", "variables", "torch", "model", "libc", "given"):
            del record[key]

    edit(copy / "run.json", forget)
    result = cli("diff", run, copy)
    assert result.code == 0
    assert "the entries that both have recorded" in result.out


def test_first_differing_metric_ignores_timings(cli, run, copy):
    rows = [json.loads(line) for line in (copy / "metrics.jsonl").read_text().splitlines()]
    for row in rows:
        row["Perf/total_fps"] += 1.0
    (copy / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert cli("diff", run, copy).code == 0
    was = rows[1]["Loss/value"]
    rows[1]["Loss/value"] = was + 1.0
    rows[2]["Loss/entropy"] = 0.0
    (copy / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    result = cli("diff", run, copy)
    assert result.code == 9
    assert f"first difference: metrics iteration 2: Loss/value: {was!r} | {was + 1.0!r}" in result.out
    (copy / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows[:1]))
    assert "metrics iteration 2: recorded | -" in cli("diff", run, copy).out
    assert cli("diff", f"{run}@step:64", copy, "--only", "metrics").code == 0, "as far as that checkpoint"


def test_first_differing_weight_has_step_and_index(cli, run, copy):
    def nudge(tensors):
        weight = tensors["actor.0.weight"]
        weight[3, 0] = torch.nextafter(weight[3, 0], torch.tensor(9.0))

    folders = sorted((copy / "checkpoints").glob("[0-9]*"))
    replace(folders[1], "policy", nudge)
    replace(folders[3], "policy", lambda tensors: tensors["actor.0.weight"].zero_())
    result = cli("diff", run, copy, "--json")
    assert result.code == 9
    assert result.json["first"]["where"] == "step 64: policy actor.0.weight[3, 0]"
    value = float(load_file(run / "checkpoints" / folders[1].name / "policy.safetensors")["actor.0.weight"][3, 0])
    assert result.json["first"]["left"] == value
    assert result.json["first"]["right"] != value
    assert sections(result)["policy"][0]["where"].startswith("step 192")
    assert cli("diff", f"{run}@step:0", copy).code == 0
    assert cli("diff", run, folders[1]).code == 9


@pytest.mark.parametrize(
    ("part", "change", "where"),
    [
        ("trainer", lambda t: next(v for v in t.values() if v.is_floating_point()).add_(1.0), "trainer "),
        ("rng", lambda t: t["torch"].add_(1), "rng torch[0]"),
        ("env", lambda t: t["engine.state"].mul_(float("nan")), "env engine.state[0, 0]"),
        ("policy", lambda t: t.update(more=torch.zeros(1)), "policy more"),
        ("policy", lambda t: t.update({"actor.0.bias": t["actor.0.bias"].double()}), "policy actor.0.bias"),
    ],
)
def test_compares_optimizer_rng_environment_and_shapes(cli, run, copy, part, change, where):
    replace(last(copy), part, change)
    result = cli("diff", run, copy, "--json")
    assert result.code == 9
    assert result.json["first"]["where"].startswith(f"step 192: {where}")


def test_nan_equals_nan_and_minus_zero_differs_from_zero(cli, run, copy):
    for folder in (run, copy):
        replace(last(folder), "env", lambda tensors: tensors["engine.state"].mul_(float("nan")))
    assert cli("diff", run, copy).code == 0
    replace(last(run), "policy", lambda tensors: tensors["actor.0.bias"].zero_())
    replace(last(copy), "policy", lambda tensors: tensors["actor.0.bias"].zero_().neg_())
    assert cli("diff", run, copy).code == 9


def test_corrupt_file_is_checkpoint_error(cli, run, copy):
    file = last(copy) / "policy.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    result = cli("diff", run, copy)
    assert result.code == 5
    assert f"{file} is corrupt" in result.err


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("config.yaml", b"a: &a [*a]\n", "config.yaml:1:"),
        ("config.yaml", b"a: !!python/object/apply:os.system [true]\n", "config.yaml:1:"),
        ("metrics.jsonl", b"[1]\n", "metrics.jsonl:1 is corrupt"),
        ("metrics.jsonl", b'{"iteration": 1}\n', "metrics.jsonl:1 is corrupt"),
        ("metrics.jsonl", b"[" * 100_000 + b"\n", "metrics.jsonl:1 is corrupt"),
        ("metrics.jsonl", b" " * (1 << 21), "metrics.jsonl:1 is corrupt"),
        ("run.json", b"[" * 100_000, "run.json is corrupt"),
    ],
)
def test_malformed_run_file_is_checkpoint_error(cli, run, copy, file, content, message):
    (copy / file).write_bytes(content)
    result = cli("diff", run, copy)
    assert result.code == 5
    assert message in result.err


def test_untrusted_text_has_no_control_characters(cli, run, copy):
    edit(copy / "run.json", lambda record: record["versions"].update({"x\x1b[2J": "\x1b]0;gone\x07"}))
    result = cli("diff", run, copy)
    assert result.code == 9
    assert "\x1b" not in result.out
    assert "\\x1b[2J" in result.out


@pytest.mark.parametrize("depth", [200, 900, 2000, 50_000])
def test_deeply_nested_values_do_not_crash(cli, run, copy, depth):
    deep = "[" * depth + "]" * depth
    text = (copy / "run.json").read_text()
    (copy / "run.json").write_text(text.replace('"libc": ', f'"libc": {deep}, "was": ', 1))
    result = cli("diff", run, copy, "--json")
    assert result.code in (5, 9), result.err


def test_invalid_comparison_is_refused(cli, run, tmp_path):
    assert cli("diff", run, tmp_path).code == 5
    assert cli("diff", run, "nowhere").code == 5
    assert cli("diff", run, f"{run}@step:7").code == 5
    assert cli("diff", f"{run}@step:0", f"{run}@step:64").code == 2
    result = cli("diff", run, run, "--only", "weight")
    assert result.code == 2
    assert "weights" in result.err


def test_replay_buffers_of_different_shards_are_compared_by_row(cli, coin, tmp_path):
    agent = tmp_path / "agent.yaml"
    agent.write_text(
        "agents: {x: {trainer: sb3, algorithm: sac, max_iterations: 4, train_freq: 4, gradient_steps: 1,"
        " learning_starts: 8, batch_size: 8, buffer_size: 64}}\n"
    )
    command = ("train", coin, "--config", agent, "--agent", "x", "-q", "--logger", "none", "scene.num_envs=4")
    whole, parts = (Path(cli(*command, f"agent.save_interval={every}").out.strip()) for every in (4, 1))
    assert cli("diff", whole, parts, "--only", "weights").code == 0
    shard = sorted((parts / "checkpoints" / "logs").glob("*/*.safetensors"))[-1]
    tensors = load_file(shard)
    next(value for value in tensors.values() if value.is_floating_point()).add_(1.0)
    data = save(tensors)
    shard.write_bytes(data)

    def sign(manifest):
        (log,) = manifest["logs"].values()
        log["shards"][-1].update(size=len(data), sha256=sha256(data))

    edit(last(parts) / "manifest.json", sign)
    result = cli("diff", whole, parts, "--only", "weights", "--json")
    assert result.code == 9
    assert " from row 0: " in result.json["first"]["where"]


@pytest.mark.slow
def test_reproduce_is_bitwise_equal(cli, run):
    result = cli("reproduce", run, "--json")
    assert result.code == 0, result.err
    assert (result.json["equal"], result.json["iterations"], result.json["environment"]) == (True, 3, [])
    again = Path(result.json["right"])
    assert again.name.endswith("-reproduced")
    record = json.loads((again / "run.json").read_text())
    assert (record["state"], record["iteration"], record["reproduces"]) == ("finished", 3, str(run))
    assert cli("diff", run, again).code == 0, "environment and configuration too"


def test_reproduce_first_iterations_only(cli, run):
    result = cli("reproduce", run, "--iterations", "1", "--json")
    assert result.code == 0, result.err
    again = Path(result.json["right"])
    assert [folder.name for folder in sorted((again / "checkpoints").glob("0*"))] == [f"{0:012d}", f"{64:012d}"]
    assert len((again / "metrics.jsonl").read_text().splitlines()) == 1


def test_reproduce_reports_first_difference(cli, run):
    rows = (run / "metrics.jsonl").read_text().splitlines()
    rows[0] = json.dumps(json.loads(rows[0]) | {"Loss/value": 7.0})
    (run / "metrics.jsonl").write_text("\n".join(rows) + "\n")
    result = cli("reproduce", run, "--iterations", "1")
    assert result.code == 9
    assert "first difference: metrics iteration 1: Loss/value: 7.0 | " in result.out


def test_reproduce_stops_before_training_in_changed_environment(cli, run):
    edit(run / "run.json", lambda record: record["versions"].update(mujoco="3.9.9"))
    result = cli("reproduce", run)
    assert result.code == 9
    assert "3.9.9" in result.out
    assert "--force" in result.err
    assert [folder.name for folder in run.parent.iterdir()] == [run.name]
    forced = cli("reproduce", run, "--force", "--iterations", "1", "--json")
    assert forced.code == 0
    assert [row["name"] for row in forced.json["environment"]] == ["versions.mujoco"]


def test_changed_model_file_is_changed_environment(cli, trained):
    run = trained()
    model = Path("coin/model.xml")
    model.write_text(model.read_text().replace('mass="1"', 'mass="1.5"'))
    result = cli("reproduce", run, "--json")
    assert result.code == 9
    assert [row["name"] for row in result.json["environment"]] == ["sources.model.xml"]


def test_changed_compiled_model_stops_before_training(cli, run):
    edit(run / "run.json", lambda record: record.update(model="0" * 64))
    result = cli("reproduce", run, "--json")
    assert result.code == 9
    assert [row["name"] for row in result.json["environment"]] == ["model"]
    assert [folder.name for folder in run.parent.iterdir()] == [run.name]


@pytest.mark.slow
def test_reproduce_of_resumed_run(cli, trained, coin):
    run = Path(cli("train", coin, *SMALL[:3], "--max-iterations", "1", "-q", "--logger", "none").out.strip())
    assert cli("train", "--resume", run, "--max-iterations", "3", "-q").code == 0
    assert cli("diff", run, trained(), "--only", "metrics", "--only", "weights").code == 0
    assert cli("reproduce", run).code == 0
    assert "resumed" not in json.loads((run / "run.json").read_text()), "in the same environment"


def test_reproduce_of_killed_run_ends_at_last_metrics(cli, run):
    edit(run / "run.json", lambda record: (record.update(state="running"), record.pop("iteration")))
    shutil.rmtree(last(run))
    lines = (run / "metrics.jsonl").read_text().splitlines()
    (run / "metrics.jsonl").write_text("\n".join(lines[:2]) + "\n" + lines[2][:20])
    result = cli("reproduce", run, "--json")
    assert result.code == 0, result.err
    assert result.json["iterations"] == 2


def test_resume_in_changed_environment_warns(cli, run):
    edit(run / "run.json", lambda record: record.update(libc="another"))
    result = cli("train", "--resume", run, "--max-iterations", "4")
    assert result.code == 0
    assert "resumed on another machine or with other versions" in result.err
    (entry,) = json.loads((run / "run.json").read_text())["resumed"]
    assert entry["step"] == 192
    assert list(entry["changed"]) == ["libc"]


@pytest.mark.slow
def test_reproduce_of_run_with_initial_weights(cli, trained, run):
    second = trained("--init-from", f"{run}@step:128")
    assert cli("reproduce", second).code == 0
    replace(run / "checkpoints" / f"{128:012d}", "policy", lambda tensors: tensors["actor.0.bias"].zero_())
    result = cli("reproduce", second)
    assert result.code == 5
    assert "has changed since the run started from it" in result.err


@pytest.mark.parametrize("change", [{"device": "cuda"}, {"processes": 2}])
def test_reproduce_refuses_gpu_and_multi_process_runs(cli, run, change):
    edit(run / "run.json", lambda record: record.update(change))
    result = cli("reproduce", run)
    assert result.code == 2
    assert ("cannot be reproduced bit by bit" if "device" in change else "trained by 2 processes") in result.err


def test_reproduce_without_iterations_is_refused(cli, run):
    (run / "metrics.jsonl").write_text("")
    assert cli("reproduce", run).code == 2
    assert cli("reproduce", "nowhere").code == 5
