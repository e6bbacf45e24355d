"""Trainers of plugins: ambiguous names, newer API versions, missing plugins."""

import textwrap

import pytest

from rlcli.errors import pip_install

TRAINER = """
    from rlcli.trainers import TrainerSpec
    SPEC = TrainerSpec(summary="Twice.", algorithms={"ppo": "rlcli.rl.ppo.config:PpoConfig"},
                       trainer="rlcli.rl.ppo.trainer:PpoTrainer"%s)
"""
POINTS = "[rlcli.trainers]\n%s = %s:SPEC\n"


@pytest.fixture
def mine(tmp_path, command):
    """mine(action, settings, words...) runs a command with an agent that has these settings."""

    def run(action, settings, *words, **environment):
        file = tmp_path / "agents.yaml"
        file.write_text(f"agents: {{mine: {settings}}}\n")
        return command(action, "cartpole", "--config", str(file), "--agent", "mine", *words, **environment)

    return run


def train(mine, trainer, algorithm="ppo"):
    settings = f"{{trainer: {trainer}, algorithm: {algorithm}, max_iterations: 1}}"
    return mine("train", settings, "--num-envs", "2", "--logger", "none", "-q", "--device", "cpu")


@pytest.fixture
def two(plugins):
    for name in ("first-learner", "second-learner"):
        package = name.replace("-", "_")
        plugins(name, TRAINER % "", entry_points=POINTS % ("learner", package))


def test_ambiguous_trainer_is_reported_and_can_be_qualified(two, mine):
    done = train(mine, "learner")
    assert done.returncode == 3, done.stderr
    assert "in several packages: first-learner 1.0 and second-learner 1.0" in done.stderr
    assert "first-learner:learner or second-learner:learner" in done.stderr
    chosen = train(mine, "'second-learner:learner'")
    assert chosen.returncode == 0, chosen.stderr


def test_ambiguous_trainer_does_not_affect_other_agents(two, command):
    done = command(
        "train", "cartpole", "--agent", "ppo", "--num-envs", "2", "--max-iterations", "1", "--device", "cpu", "-q"
    )
    assert done.returncode == 0, done.stderr
    assert command("list-tasks").returncode == 0


def test_trainer_with_newer_api_is_refused_in_train(plugins, mine):
    plugins("late-learner", TRAINER % ", api=99", entry_points=POINTS % ("late", "late_learner"))
    done = train(mine, "late")
    assert done.returncode == 4, done.stderr
    assert "'late-learner:late' (1.0) needs plugin API 99; this rlcli has 1" in done.stderr
    assert pip_install("--upgrade rlcli") in done.stderr


@pytest.mark.parametrize(
    ("name", "form", "line"),
    [
        ("rsl-rl", "ppo", "rlcli-rsl-rl"),
        ("rsl-rl", "{class_name: PPO, gamma: 0.9}", "rlcli-rsl-rl"),
        ("rl-games", "sac", "rlcli-rl-games"),
    ],
)
def test_missing_trainer_gives_pip_command(mine, name, form, line):
    settings = f"{{trainer: {name}, algorithm: {form}, params: {{config: {{max_epochs: 3}}}}}}"
    done = mine("train", settings, RLCLI_PLUGINS="rlcli")
    assert done.returncode == 7, done.stderr
    assert f"trainer '{name}' is not installed" in done.stderr
    assert line in done.stderr


def test_unknown_trainer_is_config_error(mine):
    done = train(mine, "skrl")
    assert done.returncode == 3
    assert "no trainer 'skrl'" in done.stderr
    assert "pip" not in done.stderr


def test_built_in_tasks_train_without_trainer_plugins(command):
    for task in ("cartpole", "cartpole-direct"):
        done = command("train", task, "--num-envs", "2", "--max-iterations", "1", "-q", RLCLI_PLUGINS="rlcli")
        assert done.returncode == 0, done.stderr
        checked = command("validate", task, RLCLI_PLUGINS="rlcli")
        assert checked.returncode == 0, checked.stderr
        assert "not checked" in checked.stderr + checked.stdout or "not installed" in checked.stderr + checked.stdout


def test_error_of_a_trainer_is_not_the_fault_of_the_task(plugins, mine):
    source = """
    from rlcli.config.schema import AgentConfig
    from rlcli.trainers import TrainerSpec

    class Settings(AgentConfig):
        lr: float = 1.0

    def trainer(env, config, *, seed, device, torch_threads):
        raise KeyError("gone")

    SPEC = TrainerSpec(summary="Own.", algorithms={"ppo": "own:Settings"}, trainer="own:trainer")
    """
    plugins("own", textwrap.dedent(source), entry_points=POINTS % ("own", "own"))
    done = train(mine, "own")
    assert "KeyError" in done.stderr
    assert "correct the code of the plugin own 1.0 at this line" in done.stderr
    assert "task's code" not in done.stderr


def test_algorithm_mapping_is_selected_by_class_name(plugins, mine):
    source = """
    from typing import Any
    from rlcli.config.schema import AgentConfig
    from rlcli.trainers import TrainerSpec

    class Settings(AgentConfig):
        algorithm: dict[str, Any]

    SPEC = TrainerSpec(summary="Own.", algorithms={"ppo": "own:Settings"}, trainer="own:Settings",
                       refused={"distillation": "it has no teacher"})
    """
    plugins("own", textwrap.dedent(source), entry_points=POINTS % ("own", "own"))
    shown = mine("show", "{trainer: own, algorithm: {class_name: PPO, lr: 1}, max_iterations: 1}")
    assert shown.returncode == 0, shown.stderr
    assert "lr: 1" in shown.stdout
    refused = train(mine, "own", algorithm="{class_name: Distillation}")
    assert refused.returncode == 3
    assert "it has no teacher" in refused.stderr
