"""Common mistakes in a task's YAML, its randomisation and its folder."""

import pytest
import yaml as yaml_module
from reacher import TASK, YAML, arm_folder

from rlcli.config.load import resolve
from rlcli.errors import ConfigError
from rlcli.registry import find_task
from rlcli_oige.task_class import find_class
from rlcli_oige.task_yaml import relative


def problem_of(place, yaml, message):
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(str(arm_folder(place / "arm", yaml=yaml))))
    return next(p for p in caught.value.problems if message in p.message)


@pytest.mark.parametrize(
    ("old", "new", "key", "message", "hint"),
    [
        ("  physx:\n", "  physx: 3\n  other:\n", "sim.physx", "expected a mapping, found 3", None),
        ("  dt: 0.01", "  dt: 0.01\n  substep: 2", "sim.substep", "unknown key 'substep'", "did you mean 'substeps'"),
        ("mjcf:\n", "viewport: {camera_psition: [1, 1, 1]}\nmjcf:\n", "viewport.camera_psition", "unknown key", None),
        ("mjcf:\n  /World/envs/.*/Arm: arm.xml", "mjcf: arm.xml", "mjcf", "expected a mapping from robots", None),
        (
            "  /World/envs/.*/Arm: arm.xml",
            "  Arm: {model: arm.xml, joint: {a: b}}",
            "mjcf.Arm.joint",
            "unknown key 'joint'",
            "did you mean 'joints'",
        ),
        (
            "  /World/envs/.*/Arm: arm.xml",
            "  Arm: {model: arm.xml, joints: [a]}",
            "mjcf.Arm.joints",
            "NAME IN THE TASK",
            None,
        ),
        (
            "  /World/envs/.*/Arm: arm.xml",
            "  Arm: {model: arm.xml, bodies: {a: 1}}",
            "mjcf.Arm.bodies",
            "NAME IN THE TASK",
            None,
        ),
        ("mjcf:\n", "domain_randomization: [1]\nmjcf:\n", "domain_randomization", "expected a mapping", None),
    ],
)
def test_invalid_task_value_error_has_key(tmp_path, old, new, key, message, hint):
    assert YAML.count(old) == 1
    found = problem_of(tmp_path, YAML.replace(old, new), message)
    assert found.path == key
    assert hint is None or hint in (found.hint or "")


GATE = {"operation": "additive", "distribution": "uniform", "distribution_parameters": [0.0, 1.0]}


def without(key):
    return {k: v for k, v in GATE.items() if k != key}


def views(attribute, **gates):
    return {"randomization_params": {"articulation_views": {"arm_view": {attribute: gates}}}}


def noise(gate="on_reset", **entry):
    return {"randomization_params": {"observations": {gate: GATE | entry}}}


BLOCK = "domain_randomization"
NOISE = f"{BLOCK}.randomization_params.observations.on_reset"


@pytest.mark.parametrize(
    ("block", "key", "message", "hint"),
    [
        ({"randomise": True}, f"{BLOCK}.randomise", "unknown key 'randomise'", "did you mean 'randomize'"),
        (
            {"randomization_params": {"observation": {}}},
            f"{BLOCK}.randomization_params.observation",
            "unknown key 'observation'",
            "did you mean 'observations'",
        ),
        (
            {"randomization_params": {"simulation": {"wind": {"on_reset": GATE}}}},
            f"{BLOCK}.randomization_params.simulation.wind",
            "'wind' cannot be randomised",
            "only gravity can",
        ),
        (
            views("body_mass", on_reset=GATE),
            f"{BLOCK}.randomization_params.articulation_views.arm_view.body_mass",
            "'body_mass' cannot be randomised",
            "did you mean 'body_masses'",
        ),
        (noise("on_rest"), f"{BLOCK}.randomization_params.observations.on_rest", "unknown key 'on_rest'", "on_reset"),
        (
            noise("on_startup"),
            f"{BLOCK}.randomization_params.observations.on_startup",
            "observations cannot be randomised on_startup",
            "on_reset or on_interval",
        ),
        ({"randomization_params": {"observations": {"on_reset": 3}}}, NOISE, "expected a mapping", None),
        (noise(oparation="direct"), f"{NOISE}.oparation", "unknown key 'oparation'", "did you mean 'operation'"),
        (
            {"randomization_params": {"observations": {"on_reset": without("distribution")}}},
            NOISE,
            "missing keys: distribution",
            None,
        ),
        (
            noise("on_interval"),
            f"{BLOCK}.randomization_params.observations.on_interval",
            "missing keys: frequency_interval",
            None,
        ),
        (noise(operation="add"), f"{NOISE}.operation", "unknown operation 'add'", "additive"),
        (
            noise(distribution="normall"),
            f"{NOISE}.distribution",
            "unknown distribution 'normall'",
            "did you mean 'normal'",
        ),
        (noise(schedule="cubic"), f"{NOISE}.schedule", "unknown schedule 'cubic'", "constant"),
        (noise(operation="direct"), f"{NOISE}.operation", "expected additive or scaling for noise", None),
        (noise(distribution_parameters=[1.0]), f"{NOISE}.distribution_parameters", "expected [a, b] or", None),
        (
            noise(distribution_parameters=[[1.0], [1.0, 2.0]]),
            f"{NOISE}.distribution_parameters",
            "expected [a, b]",
            None,
        ),
        (noise(distribution_parameters=[["a"], ["b"]]), f"{NOISE}.distribution_parameters", "expected numbers", None),
        (noise(distribution_parameters=[2.0, 1.0]), f"{NOISE}.distribution_parameters", "lower bound is above", None),
        (
            noise(distribution="loguniform", distribution_parameters=[0.0, 1.0]),
            f"{NOISE}.distribution_parameters",
            "needs bounds above 0",
            None,
        ),
        (
            noise(distribution="gaussian", distribution_parameters=[0.0, -1.0]),
            f"{NOISE}.distribution_parameters",
            "a standard deviation is negative",
            None,
        ),
        (noise(frequency_interval="often"), f"{NOISE}.frequency_interval", "expected a whole number", None),
        (noise(frequency_interval=0), f"{NOISE}.frequency_interval", "expected a whole number", None),
        (noise(schedule="linear", schedule_steps=[1]), f"{NOISE}.schedule_steps", "expected a whole number", None),
    ],
)
def test_invalid_randomization_error_has_key(tmp_path, block, key, message, hint):
    found = problem_of(tmp_path, YAML + yaml_module.safe_dump({BLOCK: block}), message)
    assert found.path == key
    assert hint is None or hint in (found.hint or "")


def test_randomization_without_counterpart_is_noted_as_ignored(tmp_path):
    block = views("scale", on_startup=GATE)
    folder = arm_folder(tmp_path / "arm", yaml=YAML + yaml_module.safe_dump({BLOCK: block}))
    notes = {note.key: note.status for note in resolve(find_task(str(folder))).notes}
    assert notes[f"{BLOCK}.randomization_params.articulation_views.arm_view.scale.on_startup"] == "ignored"


@pytest.mark.parametrize(
    ("env", "steps"),
    [
        ("  episodeLength: 20\n", 20),
        ("  learn: {episodeLength_s: 0.6}\n", 30),
        ("  episodeLength_s: 0.8\n", 40),
        ("", 1000),
    ],
)
def test_every_spelling_of_episode_length_is_read(tmp_path, env, steps):
    yaml = YAML.replace("  maxEpisodeLength: 12\n", env)
    task = resolve(find_task(str(arm_folder(tmp_path / "arm", yaml=yaml)))).task
    assert task.max_episode_length == steps


def test_defaults_of_timestep_ground_and_light(tmp_path):
    yaml = YAML.replace("  dt: 0.01\n", "").replace("  add_ground_plane: False\n", "")
    task = resolve(find_task(str(arm_folder(tmp_path / "arm", yaml=yaml)))).task
    assert task.sim.dt == pytest.approx(1 / 60)
    assert task.scene.ground.friction == 1.0
    assert set(task.scene.lights.model_dump(exclude_none=True)) == {"dome", "distant"}


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"arm.py": "class ArmTask(RLTask): pass"}, "ArmTask"),
        ({"arm.py": "class ArmLocomotionTask(RLTask): pass"}, "ArmLocomotionTask"),
        ({"arm.py": "class Arm(RLTask): pass"}, "Arm"),
        ({"arm.py": "class ArmReachTask(base.RLTask): pass", "b.py": "class BallTask(RLTask): pass"}, "ArmReachTask"),
        ({"any.py": "class Only(RLTask): pass", "broken.py": "class ("}, "Only"),
        ({"any.py": "class Base(RLTask): pass\nclass Reach(BaseTask): pass\nclass BaseTask(Base): pass"}, "Reach"),
        ({"task.py": "class Mine(RLTask): pass", "arm.py": "class ArmTask(RLTask): pass"}, "Mine"),
        ({"arm.py": "class ArmTask(RLTask): pass", "warp/arm.py": "class ArmTask(RLTask): pass"}, "ArmTask"),
    ],
)
def test_find_class_chooses_matching_class(tmp_path, files, expected):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    file, name = find_class(tmp_path, "Arm")
    assert name == expected
    assert file.parent == tmp_path


def test_ambiguous_classes_are_listed(tmp_path):
    (tmp_path / "a.py").write_text("class ReachTask(RLTask): pass\nclass PushTask(RLTask): pass\n")
    with pytest.raises(
        LookupError,
        match=r"several task classes in any Python file .*: ReachTask, PushTask; rename the right one to 'ArmTask'",
    ):
        find_class(tmp_path, "Arm")


def test_computed_episode_length_is_not_read_from_source(tmp_path):
    yaml = YAML.replace("  maxEpisodeLength: 12\n", "")
    computed = TASK.replace('self._task_cfg["env"]["maxEpisodeLength"]', "10 * 3")
    task = resolve(find_task(str(arm_folder(tmp_path / "arm", yaml=yaml, task=computed)))).task
    assert task.max_episode_length == 1000


@pytest.mark.parametrize(
    ("path", "below"),
    [
        ("/World/envs/.*/Ant", "Ant"),
        ("Ant", "Ant"),
        ("/World/envs/env_0/Ant/torso", "Ant/torso"),
        ("/World/Ant", "World/Ant"),
    ],
)
def test_prim_path_is_made_relative_to_env(path, below):
    assert relative(path) == below
