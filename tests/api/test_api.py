"""`rlcli.api`: the functions of the commands, called from Python."""

import pytest
import torch

from rlcli.api import evaluate, export, load_policy, make, train
from rlcli.errors import ConfigError, TaskError, UsageError
from rlcli.scaffold import create

pytestmark = pytest.mark.usefixtures("empty_folder")


def test_make_returns_environment_with_overrides():
    env = make("cartpole", num_envs=3, seed=5, overrides=["episode_length_s=1.0"])
    assert env.reset()["policy"].shape == (3, 4)
    assert env.max_episode_length == 60
    env.close()


def test_make_raises_task_and_config_errors():
    with pytest.raises(TaskError, match="no task 'cartpool'"):
        make("cartpool")
    with pytest.raises(ConfigError, match="episode_lenght_s"):
        make("cartpole", overrides=["episode_lenght_s=1.0"])


@pytest.mark.parametrize("seed", ["x", 1.5, None, -5, 2**70])
def test_seed_is_an_integer_in_range(seed):
    with pytest.raises(UsageError, match="give an integer from 0 to"):
        make("cartpole", seed=seed)


def test_wrong_arguments_are_usage_errors():
    with pytest.raises(UsageError, match="neither a task nor a run to resume is given"):
        train()
    with pytest.raises(UsageError, match=r"overrides must be a list, found the string 'rewards\.alive\.weight=2'"):
        make("cartpole", overrides="rewards.alive.weight=2")
    for episodes in (0, -1, 2.5, "x"):
        with pytest.raises(UsageError, match="give an integer above 0"):
            evaluate("shipped", task="cartpole", episodes=episodes)


def test_train_evaluate_act_and_export_work_together(tmp_path):
    rows = []
    first = train("cartpole", num_envs=8, max_iterations=2, seed=3, on_progress=lambda now: rows.append(now.iteration))
    assert rows == [1, 2]
    assert first.iteration == 2
    again = train(resume=first.run, max_iterations=3)
    assert again.iteration == 3
    summary = evaluate(first.run, episodes=8)
    assert summary["episodes"] == 8
    env = make("cartpole", num_envs=2)
    policy = load_policy(env, first.run)
    assert policy(env.reset()["policy"]).shape == (2, 1)
    env.close()
    done = export(first.run, tmp_path / "policy.py", format="numpy")
    assert done.file.is_file()


def test_policy_of_a_task_in_a_folder_is_found(tmp_path):
    create("my-arm", "yaml", tmp_path / "package", None)
    folder = str(tmp_path / "package" / "my_arm")
    run = train(folder, num_envs=4, max_iterations=1).run
    env = make(folder, num_envs=2)
    for checkpoint in (run, None):
        assert load_policy(env, checkpoint)(env.reset()["policy"]).shape[0] == 2
    env.close()


def test_train_gives_the_weights_of_the_command(cli):
    from safetensors.torch import load_file

    ours = train("cartpole", num_envs=8, max_iterations=1, seed=3)
    theirs = cli("train", "cartpole", "--num-envs", "8", "--max-iterations", "1", "--seed", "3").out.strip()
    weights = [
        load_file(f"{ours.checkpoint}/policy.safetensors"),
        load_file(f"{theirs}/checkpoints/{ours.step:012d}/policy.safetensors"),
    ]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
