"""`rlcli diff` on configurations: differences have a category, and cosmetic ones do not count."""

import json

import pytest

from rlcli.runs.config_diff import CATEGORIES, category

LIGHTER = ("joints: [slider]", "joints: [slider], scale: 2.0")


@pytest.fixture
def diff(in_process):
    """Return a function that runs `rlcli diff` and returns (exit code, document)."""

    def run(*arguments):
        code, out, err = in_process("diff", *arguments, "--json")
        assert "Traceback" not in err
        return code, json.loads(out)

    return run


def found(document):
    """Return key -> category of all differences."""
    return {d["where"]: d["category"] for s in document["sections"] for d in s["differences"]}


def test_override_has_category_and_both_origins(diff, small):
    changes = ["sim.dt=0.005", "rewards.alive.weight=2", "agent.learning_rate=1e-3", "viewer.width=320"]
    code, document = diff(small(), *changes)
    assert code == 9
    assert found(document) == {
        "sim.dt": "physics",
        "rewards.alive.weight": "MDP",
        "agent.learning_rate": "agent",
        "viewer.width": "cosmetic",
    }
    assert document["categories"] == dict.fromkeys(CATEGORIES, 1)
    first = document["first"]
    assert (first["where"], first["left"], first["right"]) == ("sim.dt", 0.01, 0.005)
    assert first["left_from"].endswith("task.yaml:4:7")
    assert first["right_from"] == "override 'sim.dt=0.005'"


@pytest.mark.parametrize(
    "change",
    ["summary=other", "viewer.eye=[1,1,1]", "sim.engine_threads=1", "agent.save_interval=7", "scene.lights.dome=null"],
)
def test_cosmetic_changes_are_no_difference(diff, small, change):
    code, document = diff(small(), change)
    assert (code, document["equal"], document["first"]) == (0, True, None)
    assert document["categories"]["cosmetic"] >= 1
    assert sum(document["categories"].values()) == document["categories"]["cosmetic"]


def test_both_sides_accept_overrides(diff, small):
    task = small()
    assert diff(task, "sim.dt=0.005", task, "sim.dt=0.005")[0] == 0
    code, document = diff(task, "sim.dt=0.005", task, "decimation=4")
    assert code == 9
    assert found(document) == {"sim.dt": "physics", "decimation": "MDP"}


def test_equal_numbers_in_different_notation_are_equal(diff, small):
    assert diff(small(), "sim.dt=1/100", "rewards.alive.weight=1")[0] == 0


def test_compares_names_folders_and_files(diff, small, here):
    task = small()
    (here / "other.yaml").write_text((here / "small/task.yaml").read_text().replace(*LIGHTER))
    (here / "other.yaml").rename(here / "small/other.yaml")
    assert diff(task, "small/task.yaml")[0] == 0
    code, document = diff(task, "small/other.yaml")
    assert code == 9
    assert found(document) == {"actions.push.scale": "MDP"}
    code, document = diff("cartpole", task)
    assert code == 9
    assert document["left"] == "cartpole"


def test_compares_models_and_code(diff, small, here):
    task = small(mine="X = 1\n")
    (here / "copy").mkdir()
    for file in (here / "small").iterdir():
        (here / "copy" / file.name).write_bytes(file.read_bytes())
    assert diff(task, "./copy")[0] == 0
    model = here / "copy/model.xml"
    model.write_text(model.read_text().replace('mass="1"', 'mass="3"'))
    (here / "copy/mine.py").write_text("X = 2\n")
    code, document = diff(task, "./copy")
    assert code == 9
    assert found(document) == {"model.xml": "physics", "mine.py": "MDP"}


def test_compares_chosen_agent_under_any_name(diff, small):
    agents = "  default: small\n  small: {trainer: sb3, algorithm: ppo, max_iterations: 1}\n"
    twin = agents + "  twin: {trainer: sb3, algorithm: ppo, max_iterations: 1, gamma: 0.9}\n"
    task = small((agents, twin))
    code, document = diff(task, "agents.default=twin")
    assert code == 9
    assert found(document) == {"agent.gamma": "agent", "agents.default": "cosmetic"}
    assert diff(task, "agents.default=twin", task, "agents.default=twin")[0] == 0
    assert found(diff(task, "agent.gamma=0.5", "--agent", "twin")[1]) == {"agent.gamma": "agent"}


def test_lights_are_not_cosmetic_for_camera_tasks(diff):
    change = "scene.lights.dome.intensity=100"
    assert diff("cartpole", change)[0] == 0
    code, document = diff("cartpole-camera", change)
    assert (code, found(document)) == (9, {"scene.lights.dome.intensity": "MDP"})


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("scene.num_envs", "agent"),
        ("scene.env_spacing", "cosmetic"),
        ("scene.terrain.rows", "physics"),
        ("scene.entities.robot.mass", "physics"),
        ("scene.entities.robot.init.joint_pos.hinge", "MDP"),
        ("scene.entities.robot.joints.hinge.damping", "physics"),
        ("scene.entities.robot.joints.hinge.velocity_limit", "MDP"),
        ("scene.sensors.feet.bodies", "MDP"),
        ("events.push.func", "MDP"),
        ("params.gain", "MDP"),
        ("play.viewer.width", "cosmetic"),
        ("play.sim.dt", "physics"),
        ("agent.torch_threads", "agent"),
        ("agent.eval_interval", "agent"),
        ("seed", "agent"),
        ("sim.engine", "physics"),
    ],
)
def test_category_of_key(path, kind):
    assert category(tuple(path.split("."))) == kind


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["cartpole"], 2, "expected two runs or tasks, found 1: cartpole"),
        (["cartpole", "cartpole", "cartpole"], 2, "found 3"),
        (["sim.dt=1", "cartpole"], 2, "the override 'sim.dt=1' comes before any task"),
        (["cartpoel", "cartpole"], 5, "did you mean 'cartpole'"),
        (["cartpole", "sim.tm=1"], 3, "unknown key 'tm'"),
        (["cartpole", "gone.yaml"], 4, "no file 'gone.yaml'"),
        (["cartpole", "ant", "--only", "weights"], 2, "--only applies to two runs"),
        (["cartpole", "ant", "--agent", "missing"], 3, "no agent 'missing'"),
    ],
)
def test_invalid_comparison_is_one_message(in_process, arguments, code, message):
    got, out, err = in_process("diff", *arguments)
    assert (got, out) == (code, "")
    assert message in err
    assert "Traceback" not in err


def test_verbose_shows_all_differences(in_process):
    code, out, _ = in_process("diff", "cartpole", "ant")
    assert code == 9
    assert "more (-v shows them)" in out
    every = in_process("diff", "cartpole", "ant", "-v")[1]
    assert "more (-v" not in every
    assert len(every.splitlines()) > len(out.splitlines())
