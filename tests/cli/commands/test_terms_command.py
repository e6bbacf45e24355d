"""`rlcli terms`: list terms, describe one, and include a task's own terms."""

import pytest

pytestmark = pytest.mark.usefixtures("empty_folder")


def test_terms_lists_one_line_per_term_with_types_and_defaults(cli):
    done = cli("terms", "track_lin_vel_xy_exp")
    assert done.code == 0
    lines = cli("terms", "track_lin_vel").out.splitlines()
    assert lines[0] == "rewards:"
    assert "  track_lin_vel_xy_exp(entity: entity name = robot, command: command name, std: number)" in lines


def test_terms_describes_exact_name_with_units_and_example(cli):
    out = cli("terms", "randomize_body_mass").out
    assert "[kg]" in out
    assert "inertias are scaled by the same factor" in out
    assert "example: events: {randomize_body_mass: {func: randomize_body_mass, mode: reset" in out


def test_terms_of_task_include_own_terms(cli, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "task.yaml").write_text("scene: {}\n")
    (folder / "terms.py").write_text(
        'def calmness(env, *, speed: float = 2.0):\n    """Calmness of the robot. (num_envs,)"""\n'
    )
    assert "calmness" not in cli("terms").out
    assert "own:\n  calmness(speed: number = 2.0)" in cli("terms", "calm", "--task", str(folder)).out


def test_terms_with_a_star_must_match_the_whole_name(cli):
    names = [term["name"] for term in cli("terms", "root_lin_*_W", "--json").json["terms"]]
    assert names == ["root_lin_vel_w"]
    assert cli("terms", "lin_*_w", "--json").json["terms"] == []


def test_terms_json_has_every_key(cli):
    (term,) = cli("terms", "joint_vel_l1", "--json").json["terms"]
    assert [key["name"] for key in term["keys"]] == ["entity", "joints"]
    assert term["section"] == "rewards"


def test_terms_suggests_near_names(cli):
    done = cli("terms", "joint_vel_l11")
    assert done.code == 0
    assert "did you mean 'joint_vel_l1'" in done.err
    assert "only with --task: rlcli terms joint_vel_l11 --task TASK" in done.err
    assert "--task" not in cli("terms", "joint_vel_l11", "--task", "cartpole").err


def test_keys_of_every_term_of_a_section_are_found_and_named(cli):
    out = cli("terms", "delay").out
    for section in ("actions", "observations"):
        assert f"key of every term in {section}:" in out
    assert "{steps, seconds, redraw} or null" in out
    described = cli("terms", "joint_vel_rel").out
    assert "keys of every term in observations: modifiers, noise, bias, clip, scale, delay, history" in described
    assert "no term" not in cli("terms", "delay").err
    assert "did you mean 'delay'" in cli("terms", "dely").err
