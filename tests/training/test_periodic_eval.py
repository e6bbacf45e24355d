"""Tests of evaluations between iterations: they choose the best checkpoint and do not change training."""

import json
import re
from pathlib import Path

import pytest
import torch

from rlcli.cli.app import main
from rlcli.runs.metric_rows import read_rows
from rlcli.training.periodic_eval import PeriodicEval

SMALL = ("--num-envs", "8", "--logger", "none", "-q", "sim.engine_threads=1", "agent.torch_threads=1")


@pytest.fixture(autouse=True)
def _temporary_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def run_of(name):
    (run,) = Path("runs").glob(f"*/*-{name}")
    return run


def train(task, name, *words):
    assert main(["train", task, "--name", name, *SMALL, *words]) == 0
    return run_of(name)


def without_times(run, *, evaluation=True):
    rows = [*read_rows(run / "metrics.jsonl")]
    excluded = "Perf/" if evaluation else ("Perf/", "Eval/")
    return [{name: value for name, value in row.items() if not name.startswith(excluded)} for row in rows]


def weights(run):
    return [file.read_bytes() for file in sorted(run.glob("checkpoints/*/policy.safetensors"))][-1]


@pytest.mark.parametrize(("task", "agent"), [("cartpole", "sb3-ppo"), ("cartpole-direct", "ppo")])
def test_evaluation_does_not_change_training(task, agent, capsys):
    words = ("--agent", agent, "--max-iterations", "4", "episode_length_s=0.3", "agent.eval_episodes=4")
    plain = train(task, "plain", *words)
    with_eval = train(task, "with_eval", *words, "agent.eval_interval=2")
    assert weights(plain) == weights(with_eval)
    assert without_times(plain) == without_times(with_eval, evaluation=False)
    evaluated = [row["iteration"] for row in without_times(with_eval) if "Eval/mean_reward" in row]
    assert evaluated == [2, 4]


def test_best_evaluation_has_a_checkpoint_and_a_reference(capsys):
    run = train(
        "cartpole", "a", "--max-iterations", "4", "agent.eval_interval=1", "agent.eval_episodes=8", "agent.keep_last=1"
    )
    rows = without_times(run)
    scores = {row["step"]: (row["Eval/success_rate"], row["Eval/mean_reward"]) for row in rows}
    best = json.loads((run / "run.json").read_text())["best"]
    assert scores[best] == max(scores.values())
    assert min(step for step, score in scores.items() if score == scores[best]) == best
    assert {0, best, max(scores)} == {int(f.parent.name) for f in run.glob("checkpoints/*/manifest.json")}
    assert main(["eval", "--checkpoint", f"{run}@best", "--episodes", "4", "--num-envs", "4"]) == 0
    assert "its best evaluation" in capsys.readouterr().err


def test_resumed_run_keeps_its_best_checkpoint(capsys):
    words = ("--agent", "ppo", "agent.eval_interval=1", "agent.eval_episodes=8", "agent.save_interval=1")
    whole = train("cartpole", "whole", "--max-iterations", "4", *words)
    cut = train("cartpole", "cut", "--max-iterations", "4", *words)
    step = sorted(int(f.parent.name) for f in cut.glob("checkpoints/*/manifest.json"))[2]
    assert main(["train", "--resume", f"{cut}@step:{step}", "--max-iterations", "4", "-q"]) == 0
    assert without_times(cut) == without_times(whole)
    best = [json.loads((run / "run.json").read_text())["best"] for run in (cut, whole)]
    assert best[0] == best[1]
    assert weights(cut) == weights(whole)


def test_resume_before_the_best_checkpoint_removes_it(capsys):
    words = ("--agent", "ppo", "agent.eval_interval=1", "agent.eval_episodes=8", "agent.save_interval=1")
    run = train("cartpole", "a", "--max-iterations", "3", *words)
    steps = sorted(int(f.parent.name) for f in run.glob("checkpoints/*/manifest.json"))
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**record, "best": steps[-1]}))
    assert main(["train", "--resume", f"{run}@step:{steps[1]}", "--max-iterations", "2", "-q"]) == 0
    assert json.loads((run / "run.json").read_text())["best"] in steps[:3]


def test_success_rate_counts_before_return():
    evaluator = PeriodicEval(
        lambda: None, 1, 1, [{"step": 7, "Eval/success_rate": 0.5, "Eval/mean_reward": 9.0}, {"step": 9}]
    )
    assert evaluator.best == 7
    assert not evaluator.improves({"Eval/success_rate": 0.4, "Eval/mean_reward": 20.0})
    assert not evaluator.improves({"Eval/success_rate": 0.5, "Eval/mean_reward": 9.0})
    assert evaluator.improves({"Eval/success_rate": 0.5, "Eval/mean_reward": 9.5})
    assert evaluator.improves({"Eval/success_rate": 0.6, "Eval/mean_reward": 1.0})


def test_each_evaluation_prints_a_line_with_the_value_that_until_compares(capsys):
    words = [*SMALL, "episode_length_s=1.0", "agent.eval_interval=2", "agent.eval_episodes=8"]
    words.remove("-q")
    assert main(["train", "cartpole", *words, "--max-iterations", "4", "--until", "return=1000"]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("evaluation after")]
    assert [line.split(":")[0] for line in lines] == ["evaluation after iteration 2", "evaluation after iteration 4"]
    result = re.compile(r": return -?[\d.]+ of 8 episodes, without exploration noise; lower end")
    assert all(map(result.search, lines))
    assert lines[0].endswith("return=1000 is needed")
