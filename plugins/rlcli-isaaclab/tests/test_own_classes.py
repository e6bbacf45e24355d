"""Classes of a task's own that rlcli does not run: its environment, assets, networks and algorithms are reported."""

import logging
import sys

import gymnasium
import pytest
from cartpole_files import AGENT, ENV, START, write
from test_isaaclab_packages import stepped
from test_isaaclab_user_code import rover

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError, TaskError
from rlcli.formats import log_notes
from rlcli.registry import find_task
from rlcli.registry.task_code_monitor import error_of_task
from rlcli_isaaclab.own_classes import own_methods
from rlcli_isaaclab.runtime import facade_of
from rlcli_isaaclab.scene_facade import Asset

ID = "Template-Cartpole-v0"


@pytest.fixture(autouse=True)
def forget_modules():
    known = set(sys.modules)
    yield
    for name in set(sys.modules) - known:
        if name.partition(".")[0] == "carts":
            del sys.modules[name]
    gymnasium.registry.pop(ID, None)


@pytest.fixture
def carts(tmp_path):
    return write(tmp_path / "carts")


OWN_ENV = """

class {name}(ManagerBasedRLEnv):
    def __init__(self, cfg, **kwargs):
        super().__init__(cfg, **kwargs)

    def bonus(self):
        return 1.0
{methods}
"""


@pytest.mark.parametrize(
    ("methods", "message"),
    [
        ("", ""),
        (
            "    def step(self, action):\n        return super().step(0.5 * action)\n"
            "    def _reset_idx(self, env_ids):\n        super()._reset_idx(env_ids)\n",
            "rlcli does not run the methods step, _reset_idx of the class StepEnv",
        ),
    ],
)
def test_workflow_methods_of_an_own_environment_class_are_named(carts, caplog, methods, message):
    name = "StepEnv" if message else "PlainEnv"
    (carts / "cartpole_env_cfg.py").write_text(ENV + OWN_ENV.format(name=name, methods=methods))
    own = START.replace('"isaaclab.envs:ManagerBasedRLEnv"', 'f"{__name__}.cartpole_env_cfg:' + name + '"')
    (carts / "__init__.py").write_text(own)
    with caplog.at_level(logging.WARNING):
        resolved = resolve(find_task(f"{carts}:{ID}"))
    (note,) = [note for note in resolved.notes if note.key == "entry_point"]
    assert note.status == "ignored"
    warned = [record.getMessage() for record in caplog.records]
    if message:
        assert message in note.text
        assert any(text.startswith(f"{carts / 'cartpole_env_cfg.py'}:") and message in text for text in warned)
    else:
        assert "does not run" not in note.text
        assert warned == []


OWN_ASSET = """
from isaaclab.assets import Articulation

class Remembers(Articulation):
    def update(self, dt):
        super().update(dt)
        self._last = self.data.joint_pos.clone()

    def set_debug_vis(self, shown):
        return False

def last(env):
    return env.scene["robot"]._last.sum(dim=1)
"""


def test_methods_of_an_own_asset_class_are_named_and_a_term_that_needs_them_stops(tmp_path, caplog):
    own = ("    robot = ArticulationCfg(", "    robot = ArticulationCfg(class_type=Remembers, ")
    reward = {"own": "RewardTermCfg(func=last, weight=1.0)"}
    with caplog.at_level(logging.WARNING):
        resolved = rover(tmp_path / "rover", OWN_ASSET, [own], rewards=reward)
    (note,) = [note for note in resolved.notes if note.key == "scene.robot.class_type"]
    assert "scene.robot: rlcli does not run the method update of the class Remembers" in note.text
    assert note.text.split(": read as")[0].startswith("read as Articulation; ")
    assert "rover_env.py:" in next(record.getMessage() for record in caplog.records)
    with pytest.raises(AttributeError, match="no private attribute '_last'") as found:
        stepped(resolved)
    error = error_of_task(found.value)
    assert isinstance(error, TaskError)
    assert "rover_env.py:" in error.message
    assert "rlcli does not run methods of a task's asset classes" in error.hint


def test_an_asset_can_be_asked_for_members_that_it_lacks(tmp_path):
    code = (
        "def has(env):\n    robot = env.scene['robot']\n    assert not hasattr(robot, '_cache')\n"
        "    assert getattr(robot, 'cache', None) is None\n    return torch.ones(env.num_envs)\n"
    )
    stepped(rover(tmp_path / "rover", code, rewards={"own": "RewardTermCfg(func=has, weight=1.0)"}))


def test_names_of_own_methods():
    class Base(Asset):
        number = 3

        def reset(self, env_ids=None):
            pass

    class Kind(Base):
        @property
        def speed(self):
            return 0.0

    assert own_methods(Kind) == ["reset", "speed"]
    assert own_methods(Kind, ("reset",)) == ["reset"]
    assert own_methods(Asset) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("init_noise_std=1.0,", 'class_name="ActorCriticBeta", init_noise_std=1.0,', "policy.class_name: .*Beta"),
        ("value_loss_coef=1.0,", 'class_name="PPOAMP", value_loss_coef=1.0,', "algorithm.class_name: .*PPOAMP"),
        ("    num_steps_per_env = 16", '    class_name = "AMPRunner"\n    num_steps_per_env = 16', "AMPRunner"),
    ],
)
def test_class_of_a_network_or_algorithm_that_rlcli_lacks_is_refused(carts, old, new, message):
    file = carts / "agents" / "rsl_rl_ppo_cfg.py"
    file.write_text(AGENT.replace(old, new, 1))
    with pytest.raises(ConfigError, match=message) as found:
        resolve(find_task(f"{carts}:{ID}"))
    assert all(problem.where.startswith(str(file)) for problem in found.value.problems)


@pytest.mark.parametrize("name", ["ActorCritic", "rsl_rl.modules:ActorCritic", "rsl_rl.modules.ActorCritic"])
def test_classes_that_rlcli_has_are_read_by_every_form_of_their_name(carts, name):
    text = AGENT.replace("init_noise_std=1.0,", f'class_name="{name}", init_noise_std=1.0,', 1)
    (carts / "agents" / "rsl_rl_ppo_cfg.py").write_text(text)
    assert resolve(find_task(f"{carts}:{ID}")).agent_name == "rsl-rl"


def test_intervals_of_checkpoints_by_iteration_are_ignored_with_a_note(carts):
    text = AGENT.replace("save_interval = 50", 'save_interval = {"0": 20, "200": 50}')
    (carts / "agents" / "rsl_rl_ppo_cfg.py").write_text(text)
    resolved = resolve(find_task(f"{carts}:{ID}"))
    (note,) = [note for note in resolved.notes if note.key == "agent.save_interval"]
    assert note.status == "ignored"
    assert resolved.agent.save_interval is None


SKRL = """
seed: 42
models:
  separate: false
  policy:
    class: GaussianMixin
    clip_actions: false
    initial_log_std: 0.0
    network: [{name: net, input: STATES, layers: [32, 32], activations: elu}]
    output: ACTIONS
  value:
    class: DeterministicMixin
    network: [{name: net, input: STATES, layers: [32, 32], activations: elu}]
    output: ONE
memory: {class: RandomMemory, memory_size: -1}
agent:
  class: PPO
  rollouts: 32
  learning_epochs: 8
  mini_batches: 8
  discount_factor: 0.99
  lambda: 0.95
  learning_rate: 5.0e-04
  ratio_clip: 0.2
  value_clip: 0.2
  grad_norm_clip: 1.0
  entropy_loss_scale: 0.0
  value_loss_scale: 2.0
  experiment: {directory: cartpole, experiment_name: "", write_interval: auto, checkpoint_interval: auto}
trainer: {class: SequentialTrainer, timesteps: 4800, environment_info: log}
"""


def test_notes_are_those_of_the_chosen_agent(carts, caplog):
    (carts / "agents" / "skrl_ppo_cfg.yaml").write_text(SKRL)
    more = '        "skrl_cfg_entry_point": f"{agents.__name__}:skrl_ppo_cfg.yaml",\n    },\n)'
    (carts / "__init__.py").write_text(START.replace("    },\n)", more))
    agents = {}
    for name in ("rsl-rl", "skrl"):
        resolved = resolve(find_task(f"{carts}:{ID}"), agent=name)
        agents[name] = {note.key for note in resolved.notes if note.agent}
        assert {note.agent for note in resolved.notes} <= {"", name}
        caplog.clear()
        with caplog.at_level(logging.INFO):
            log_notes(resolved.notes)
        assert ("experiment_name" in caplog.text) == (name == "rsl-rl")
    assert agents["rsl-rl"]
    assert agents["skrl"]
    assert not agents["rsl-rl"] & agents["skrl"]


def test_failing_import_in_a_package_names_the_line_of_the_import(carts, caplog):
    start = "from .missing import Nothing\n" + START
    (carts / "__init__.py").write_text(start)
    with caplog.at_level(logging.WARNING):
        resolve(find_task(f"{carts}:{ID}"))
    (text,) = [record.getMessage() for record in caplog.records if "is left out" in record.getMessage()]
    assert text.endswith(f"({carts / '__init__.py'}:1)")


def test_file_that_registers_the_task_of_a_package_is_named(carts):
    (carts / "__init__.py").write_text("")
    name = "Apart-Cartpole-v0"
    (carts / "tasks.py").write_text(START.replace("{__name__}.", "carts.").replace(ID, name))
    with pytest.raises(TaskError, match="does not register a task") as found:
        resolve(find_task(f"{carts}:{name}"))
    assert found.value.hint == f"name the file: {carts / 'tasks.py'}:{name}"


def test_name_that_isaac_lab_lacks_is_said_to_be_of_another_version(carts):
    file = carts / "cartpole_env_cfg.py"
    file.write_text("from isaaclab.actuators import SpringPDActuatorCfg\n" + ENV)
    with pytest.raises(
        TaskError, match=r"cannot import name 'SpringPDActuatorCfg' from 'isaaclab.actuators' \(.*py:1\)"
    ) as found:
        resolve(find_task(f"{carts}:{ID}"))
    assert found.value.hint.startswith("Isaac Lab 2.3.2 has no 'SpringPDActuatorCfg' (a newer or changed Isaac Lab")


def test_tasks_of_two_packages_of_one_name_use_their_own_environment_classes(tmp_path):
    found = []
    for value in ("1.0", "2.0"):
        folder = write(tmp_path / value[0] / "carts")
        methods = OWN_ENV.format(name="OwnEnv", methods="").replace("return 1.0", f"return {value}")
        (folder / "cartpole_env_cfg.py").write_text(ENV + methods)
        own = START.replace('"isaaclab.envs:ManagerBasedRLEnv"', 'f"{__name__}.cartpole_env_cfg:OwnEnv"')
        (folder / "__init__.py").write_text(own)
        found.append(resolve(find_task(f"{folder}:{ID}")))
        for name in [name for name in sys.modules if name.partition(".")[0] == "carts"]:
            del sys.modules[name]
        gymnasium.registry.pop(ID, None)
    assert [facade_of(make_env(resolved, seed=0)).bonus() for resolved in found] == [1.0, 2.0]
