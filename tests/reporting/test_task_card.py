"""Task card: description of the MDP from configuration and docstrings, as data and as Markdown."""

import json

import pytest

from rlcli.config.load import resolve
from rlcli.config.schema import TaskConfig
from rlcli.config.term_signatures import Vocabulary
from rlcli.registry import find_task
from rlcli.reporting.task_card import Card, Column, Table, card, markdown, task_card

NOISY = [
    "observations.policy.joint_pos_rel.noise={kind: uniform, low: -0.01, high: 0.02}",
    "observations.policy.joint_pos_rel.clip=[-5, 5]",
    "observations.policy.joint_vel_rel.scale=0.25",
    "observations.policy.joint_vel_rel.history=3",
    "observations.policy.joint_vel_rel.delay={steps: [0, 2]}",
    "observations.policy.joint_vel_rel.bias={kind: gaussian, std: 0.1}",
    "observations.policy.joint_vel_rel.modifiers=[{kind: scale, factor: 2.0}]",
]


def built(task, *overrides, layout=None, **settings):
    source = find_task(str(task))
    compiled = json.loads((source.root / layout).read_text()) if layout else None
    return task_card(resolve(source, overrides=overrides, **settings), compiled)


def rows(content, title):
    """Return the rows of a table as dicts by column; an empty list if there is no such table."""
    table = next((table for table in content.tables if table.title == title), None)
    titles = [column.title for column in table.columns] if table else []
    return {row[0]: dict(zip(titles, row, strict=True)) for row in table.rows} if table else {}


def test_observation_table_has_meaning_unit_size_elements():
    terms = rows(built("cartpole", layout="task.layout.json"), "Observations: policy")
    assert terms["joint_vel_rel"] == {
        "Term": "joint_vel_rel",
        "Meaning": "Joint velocities minus their defaults [m/s or rad/s].",
        "Unit": "m/s or rad/s",
        "Size": "2",
        "Elements": "slider_to_cart, cart_to_pole",
    }


def test_observation_table_has_processing_steps():
    terms = rows(built("cartpole", *NOISY), "Observations: policy")
    assert terms["joint_pos_rel"]["Noise"] == "+ uniform [-0.01, 0.02]"
    assert terms["joint_pos_rel"]["Clip"] == "[-5, 5]"
    velocity = terms["joint_vel_rel"]
    assert velocity["Scale"] == "x 0.25"
    assert velocity["History"] == "3 steps"
    assert velocity["Delay"] == "[0, 2] steps"
    assert velocity["Bias"] == "+ normal, mean 0, std 0.1"
    assert velocity["Modifiers"] == "scale factor: 2"


def test_disabled_noise_is_left_out():
    content = built("cartpole", *NOISY, "observations.policy.enable_corruption=false")
    terms = rows(content, "Observations: policy")
    assert not {"Noise", "Bias", "Delay"} & set(terms["joint_vel_rel"])
    assert "Without noise" in next(t for t in content.tables if t.title == "Observations: policy").note


def test_reward_table_has_weight_docstring_parameters():
    content = built("cartpole", "rewards.pole_pos.weight=-2.5", "rewards.pole_pos.target=0.125")
    term = rows(content, "Rewards")["pole_pos"]
    assert term["Weight"] == "-2.5"
    assert (
        term["Value"]
        == "Sum of the squared deviations of joints from `target` [rad^2], positions wrapped to [-pi, pi]."
    )
    assert term["Parameters"] == "`joints` = [cart_to_pole], `target` = 0.125"
    note = next(table for table in content.tables if table.title == "Rewards").note
    assert "0.0166667 s" in note
    unscaled = next(t for t in built("cartpole", "reward_dt_scaling=false").tables if t.title == "Rewards").note
    assert "0.0166667" not in unscaled


def test_removed_term_is_left_out():
    assert "pole_vel" not in rows(built("cartpole", "rewards.pole_vel=null"), "Rewards")


def test_termination_table_distinguishes_truncation():
    terms = rows(built("cartpole"), "Terminations")
    assert terms["time_out"]["What it does"] == "truncates"
    assert terms["cart_out_of_bounds"]["What it does"] == "terminates"
    assert "`bounds` = [-3, 3]" in terms["cart_out_of_bounds"]["Parameters"]


def test_event_table_has_time_and_ranges():
    content = built(
        "cartpole",
        "events.push={func: push_by_setting_velocity, mode: interval, interval_range_s: [2, 4]}",
        "events.mass={func: randomize_body_mass, mode: startup, bodies: pole, range: [0.8, 1.2]}",
    )
    terms = rows(content, "Events and randomisation")
    assert terms["reset_cart"]["When"] == "at every reset"
    assert "`position` = [-1, 1]" in terms["reset_cart"]["Ranges and parameters"]
    assert terms["push"]["When"] == "every 2 to 4 s"
    assert terms["mass"]["When"] == "once, at the start"
    assert "`range` = [0.8, 1.2]" in terms["mass"]["Ranges and parameters"]


def test_actuator_table_has_models():
    drive = "{joints: slider_to_cart, kind: pd, stiffness: 5, damping: 1, effort_limit: 9, delay: [1, 3]}"
    terms = rows(built("cartpole", f"scene.entities.robot.actuators={{drive: {drive}}}"), "Actuators")
    assert terms["drive"]["Kind"] == "pd"
    assert "stiffness: 5, damping: 1, effort_limit: 9" in terms["drive"]["Settings"]
    assert "delay: [1, 3]" in terms["drive"]["Settings"]


def test_empty_tables_and_columns_are_left_out():
    content = built("cartpole")
    titles = [table.title for table in content.tables]
    assert not {"Commands", "Curriculum", "Sensors", "Parameters"} & set(titles)
    assert all(any(row[i] for row in table.rows) for table in content.tables for i in range(len(table.columns)))


def test_direct_task_card_has_parameters_and_docstrings():
    content = built("cartpole-direct", "params.max_effort=250", layout="direct.layout.json")
    assert rows(content, "Parameters")["max_effort"] == {
        "Parameter": "max_effort", "Value": "250", "Meaning": "Force on the cart at action 1 [N].", "Default": "400",
    }  # fmt: skip
    words = rows(content, "Docstrings of the task")
    reward = "Reward an upright pole and slow joints; a failure costs 2."
    assert words["Reward"]["Meaning"] == reward
    assert words["Start of an episode"]["Hook"] == "reset_idx"
    assert rows(content, "Observations: policy")["pole_vel"]["Unit"] == "rad/s"
    assert dict(content.facts)["Observations are clipped to"] == "±5"


def test_inherited_hooks_have_docstrings(tmp_path):
    source = find_task("cartpole-direct")
    for name in ("direct.yaml", "cartpole.xml"):
        (tmp_path / name.replace("direct", "task")).write_text((source.root / name).read_text())
    (tmp_path / "base.py").write_text(
        'raise SystemExit("run")\nfrom rlcli.envs.direct import DirectTask\n\n'
        'class Other(DirectTask):\n    """Not shown."""\n    def reset(self, selection):\n        """From below."""\n'
        '    def is_done(self):\n        """Replaced."""\n'
    )
    (tmp_path / "task.py").write_text(
        'from .base import Other as Base\n\nclass Task(Base):\n    """Balance."""\n'
        '    def is_done(self):\n        """Never."""\n\n    class Params:\n'
        "        reset_dist: float = 1.0\n        max_effort: float = 1.0\n        pole_vel_weight: float = 1.0\n"
    )
    words = rows(built(tmp_path), "Docstrings of the task")
    assert {row["Hook"]: row["Meaning"] for row in words.values()} == {
        "Task": "Balance.", "reset": "From below.", "is_done": "Never."}  # fmt: skip


def test_card_does_not_execute_task_code(tmp_path):
    source = find_task("cartpole")
    (tmp_path / "task.yaml").write_text(source.config.read_text().replace("func: is_alive", "func: mine"))
    (tmp_path / "cartpole.xml").write_text((source.root / "cartpole.xml").read_text())
    (tmp_path / "terms.py").write_text(
        'raise SystemExit("run")\ndef mine(env):\n    """How well\n    it goes [1]. (num_envs,)\n\n    More.\n    """\n'
    )
    assert rows(built(tmp_path), "Rewards")["alive"]["Value"] == "How well it goes [1]."


def test_card_of_bare_configuration_names_unknown_terms():
    task = TaskConfig.model_validate_json(
        json.dumps(
            {
                "sim": {"dt": 0.01}, "decimation": 1, "episode_length_s": 1.0,
                "scene": {"entities": {"robot": {"model": "x.xml"}}},
                "rewards": {"mine": {"func": "of_its_own", "weight": 2.0, "gain": 3.0}},
            }
        )
    )  # fmt: skip
    term = rows(card(task, Vocabulary(), name="x"), "Rewards")["mine"]
    assert (term["Value"], term["Parameters"]) == ("`of_its_own`", "`gain` = 3")


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct", "ant-direct"])
def test_markdown_of_built_in_tasks_keeps_tables(task):
    content = built(task)
    lines = markdown(content, level=2).splitlines()
    assert lines[0] == f"## {task}"
    for table in content.tables:
        start = lines.index(f"### {table.title}".replace("_", r"\_"))
        first = next(i for i in range(start, len(lines)) if lines[i].startswith("| "))
        widths = {line.replace("\\|", "").count("|") for line in lines[first : first + 2 + len(table.rows)]}
        assert widths == {len(table.columns) + 1}


def test_markdown_escapes_text():
    odd = "<script>alert(1)</script> a|b *c* _d_ [e](f) `g|h` # i\nj"
    table = Table("T", "", (Column("A", "code"), Column("B")), ((odd, odd), ("a`b", "`")))
    text = markdown(Card("n", odd, (("key", odd),), (table,)))
    assert "<script" not in text.replace("`<script>", "")
    assert "&lt;script&gt;" in text
    assert r"a\|b \*c\* \_d\_ \[e\](f) `g\|h`" in text
    assert text.count("\n| ") == len([line for line in text.splitlines() if line.startswith("|")])
