"""Signatures of terms, read from source text without running it."""

import subprocess
import sys

import pytest
from pydantic import ValidationError
from support.small_task import TASK
from support.worlds import PENDULUM_TASK, build, edited, pendulum

from rlcli.config.load import resolve
from rlcli.config.term_signatures import (
    SECTIONS,
    Vocabulary,
    builtin_terms,
    params_model,
    read_params,
    read_terms,
    signature_of,
    snake_case,
)
from rlcli.errors import ConfigError
from rlcli.mdp.randomization.joints import RandomizeJointDamping

OWN = TASK.replace(
    "near: {func: joint_pos_target_l2, weight: -1.0, joints: [slider], target: 0.0}", "near: {func: own, weight: 1.0}"
)


@pytest.fixture
def model(tmp_path):
    """model("a: int = 3") -> the model of a reward term with these keyword-only parameters."""

    def make(parameters):
        file = tmp_path / "terms.py"
        file.write_text(f"def own(env, *, {parameters}):\n    pass\n")
        return params_model(read_terms(file)["own"], "rewards")

    return make


def accepts(model, value):
    try:
        model.model_validate({"func": "own", "weight": 1.0, "x": value})
    except ValidationError:
        return False
    return True


@pytest.mark.parametrize(
    ("annotation", "good", "bad"),
    [
        ("float", [1, 1.5, "1/3"], ["a", True, None]),
        ("int", [1], [1.5, "1", True]),
        ("bool", [True], [1, "true"]),
        ("str", ["a"], [1, None]),
        ("Literal['a', 2]", ["a", 2], ["b", 3]),
        ("typing.Literal['a']", ["a"], ["b"]),
        ("list[int]", [[], [1, 2]], [[1.5], 1]),
        ("tuple[float, int]", [(1.5, 2)], [(1.5,), (1, 2, 3), ("a", 1)]),
        ("tuple[int, ...]", [(), (1, 2, 3)], [("a",)]),
        ("float | None", [1.0, None], ["a"]),
        ("'float | None'", [1.0, None], ["a"]),
        ("Range", [(0, 1)], [(1, 0), (1,)]),
        ("task.Range", [(0, 1)], [(1, 0)]),
        ("list[tuple[str, float]]", [[("a", 1.0)]], [[("a",)]]),
    ],
)
def test_supported_annotations(model, annotation, good, bad):
    made = model(f"x: {annotation}")
    assert [accepts(made, value) for value in good] == [True] * len(good)
    assert [accepts(made, value) for value in bad] == [False] * len(bad)


@pytest.mark.parametrize("alias", ["Joints", "Bodies", "Sites", "Sensors", "Actuators", "'Joints'", "Joints | None"])
def test_selectors_accept_names_or_lists(model, alias):
    made = model(f'entity: Entity = "robot", x: {alias} = ".*"')
    assert accepts(made, "a.*")
    assert accepts(made, ["a", "b"])
    assert not accepts(made, [1])
    assert not accepts(made, [])
    assert accepts(made, None) == alias.endswith("None")


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ("x: dict", "YAML cannot express the annotation 'dict'; use float"),
        ("x: Tensor", "annotation 'Tensor'"),
        ("x: list", "annotation 'list'"),
        ("x: list[dict]", "annotation 'dict'"),
        ("x: Optional[float]", "X | None"),
        ("x: Callable[[int], int]", "annotation 'Callable"),
        ("x", "parameter 'x': every parameter needs an annotation"),
        ("x: 'float['", "annotation 'float[' is not valid Python"),
        ("x: float = math.pi", "the default 'math.pi' is not a literal"),
        ("x: Joints", "add a parameter 'entity: Entity'"),
        ("weight: float", "every term of rewards has a key of this name"),
        ("_x: float", "underscore"),
    ],
)
def test_unsupported_signatures_are_refused_with_hint(problems_of, parameters, said):
    (message,) = problems_of(OWN, files={"terms": f"def own(env, *, {parameters}): ...\n"})
    assert "terms.py:1:1: own: " in message
    assert said in message


def test_positional_parameters_are_refused(problems_of):
    (message,) = problems_of(OWN, files={"terms": "def own(env, x: float): ...\n"})
    assert "the parameter 'x' must be keyword-only: put it after a '*'" in message


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["copy", "json", "schema", "model_config_", "model_x", "dict"])
def test_parameter_may_have_name_of_pydantic_method(task, name):
    source = task(OWN.replace("func: own,", f"func: own, {name}: 2.0,"), terms=f"def own(env, *, {name}: float): ...")
    assert resolve(source).task.rewards["near"].params == {name: 2.0}


def test_defaults_and_required_parameters(model):
    made = model("a: int, b: float = -1.5, c: tuple[int, ...] = (1, 2), d: str | None = None")
    term = made.model_validate({"func": "own", "weight": 1.0, "a": 3})
    assert (term.a, term.b, term.c, term.d) == (3, -1.5, (1, 2), None)
    with pytest.raises(ValidationError, match="a\n  Field required"):
        made.model_validate({"func": "own", "weight": 1.0})


def test_read_terms_skips_private_names(tmp_path):
    file = tmp_path / "terms.py"
    file.write_text(
        "def a(env): 'First line.\\nmore'\n"
        "def _hidden(env): ...\n"
        "def helper(x): ...\n"
        "async def later(env): ...\n"
        "class HTTPGoal2D:\n  def __init__(self, env, *, x: int = 1): 'Aim.'\n"
        "class Plain: ...\n"
        "class _Base:\n  def __init__(self, env): ...\n"
        "class Env:\n  def __init__(self, other): ...\n"
    )
    terms = read_terms(file)
    assert list(terms) == ["a", "http_goal2_d"]
    assert terms["a"].summary == "First line."
    goal = terms["http_goal2_d"]
    assert (goal.attribute, goal.is_class, goal.summary) == ("HTTPGoal2D", True, "Aim.")


def test_snake_case():
    assert [snake_case(n) for n in ("JointEffort", "A", "HTTPServer", "Pose")] == [
        "joint_effort",
        "a",
        "http_server",
        "pose",
    ]


def test_every_built_in_term_fits_its_section():
    for section in SECTIONS:
        terms = builtin_terms(section)
        assert terms
        for signature in terms.values():
            assert "func" in params_model(signature, section).model_fields
            assert signature.summary


def test_own_terms_override_built_in_terms(task):
    source = task(
        TASK.replace("is_alive, weight: 1.0", "is_alive, weight: 1.0, extra: 2"),
        terms="def is_alive(env, *, extra: int): ...",
    )
    assert resolve(source).task.rewards["alive"].params == {"extra": 2}
    assert Vocabulary.of(source.term_files).find("rewards", "is_alive").file.name == "terms.py"


@pytest.mark.parametrize(
    ("source", "place", "said"),
    [
        (b"x = 1\ndef own(env:\n", "2", "was never closed"),
        (b"\x00", "1", "null byte"),
        (b"x = '\xff'\n", "1", "codec can't decode|not a valid|utf-8|invalid"),
        (b"x = " + b"-" * 200_000 + b"1", "1", ""),
    ],
)
def test_invalid_terms_file_is_reported_with_position(task, source, place, said):
    import re

    folder = task(terms="")
    (folder.root / "terms.py").write_bytes(source)
    with pytest.raises(ConfigError) as caught:
        resolve(folder)
    message = str(caught.value)
    assert f"terms.py:{place}:" in message
    assert "not valid Python" in message
    assert re.search(said, message)


def test_term_files_are_not_executed(task):
    source = task(
        OWN.replace("func: own,", "func: own, x: 1,"), terms="raise SystemExit\ndef own(env, *, x: int): ...\n"
    )
    program = (
        "import sys; from pathlib import Path; from rlcli.config.load import resolve\n"
        "from rlcli.registry import folder_task\n"
        f"print(resolve(folder_task(Path({str(source.root)!r}))).task.rewards['near'].params)\n"
        "print(sorted({'torch', 'mujoco', 'numpy', 'stable_baselines3'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "{'x': 1}\n[]\n"), done.stderr


DIRECT = TASK[: TASK.index("actions:")] + "params: {gain: 2.0}\n" + TASK[TASK.index("play:") :]
CLASS = """
raise SystemExit
class Task(DirectTask):
    class Params(StrictModel):
        gain: float = Field(1.0, gt=0, le=5, description="Gain [1].")
        mode: Literal["a", "b"] = "a"
        limits: tuple[float, float] | None = None
        count: int
"""


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ("{gain: 2.0}", "params: missing key 'count'"),
        ("{gian: 2.0, count: 1}", "params.gian: unknown key 'gian'; did you mean 'gain'?"),
        ("{gain: 0, count: 1}", "params.gain: expected a number > 0, found 0"),
        ("{gain: 6, count: 1}", "params.gain: expected a number <= 5, found 6"),
        ("{mode: c, count: 1}", "params.mode: expected 'a' or 'b', found 'c'"),
        ("{count: 1.5}", "params.count: expected a whole number, found 1.5"),
        ("{limits: [1], count: 1}", "params.limits: expected a list of 2 values, found [1]"),
        ("3", "params: expected a mapping, found 3"),
    ],
)
def test_direct_params_are_checked_from_source(problems_of, params, said):
    (message,) = problems_of(DIRECT.replace("{gain: 2.0}", params), files={"task": CLASS})
    assert "task.yaml:9:" in message
    assert said in message


def test_direct_params_have_defaults(task):
    source = task(DIRECT.replace("{gain: 2.0}", "{gain: 1/2, count: 4}"), task=CLASS)
    assert resolve(source).task.params == {"gain": 0.5, "mode": "a", "limits": None, "count": 4}
    assert read_params(source.task_file, "Task").model_fields["gain"].description == "Gain [1]."
    assert read_params(source.task_file, "Other") is None


HEIR = """
from .common import Hovering as Base
class Child(Base):
    class Params(Base.Params):
        gain: float = 3.0
        own: int = 1
class Plain(Child): ...
class Unresolved(Missing):
    class Params(Missing.Params):
        own: int = 2
class Round(Round):
    class Params(Round.Params):
        own: int = 4
"""


def test_params_are_inherited_across_files(tmp_path):
    (tmp_path / "common.py").write_text(
        "class Hovering:\n    class Params(StrictModel):\n        gain: float = 1.0\n        height: float = 2.0\n"
    )
    file = tmp_path / "task.py"
    file.write_text(HEIR)
    for name in ("Child", "Plain"):
        assert read_params(file, name)().model_dump() == {"gain": 3.0, "height": 2.0, "own": 1}
    assert read_params(file, "Base")().model_dump() == {"gain": 1.0, "height": 2.0}
    assert read_params(file, "Unresolved")().model_dump() == {"own": 2}
    assert read_params(file, "Round")().model_dump() == {"own": 4}


def test_circular_inheritance_across_files_terminates(tmp_path):
    for name, other in (("a", "b"), ("b", "a")):
        bases = ", ".join(f"T{i}.Params" for i in range(40))
        imports = ", ".join(f"T{i}" for i in range(40))
        body = "".join(f"class T{i}(T{(i + 1) % 40}.Q, {bases}): ...\n" for i in range(40, 80))
        (tmp_path / f"{name}.py").write_text(f"from .{other} import {imports}\n{body}class Task(T40): ...\n")
    assert read_params(tmp_path / "a.py", "Task") is None


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (CLASS.replace("count: int", "count: dict"), "line 8: 'count': YAML cannot express the annotation 'dict'"),
        (CLASS.replace("count: int", "count: int = COUNT"), "line 8: 'count': the default 'COUNT' is not a literal"),
        (CLASS + "   )", "not valid Python"),
        ("class Task: ...", "has no Params"),
    ],
)
def test_unreadable_params_are_reported_at_source(problems_of, source, said):
    (message,) = problems_of(DIRECT, files={"task": source})
    assert said in message


def test_direct_task_refuses_manager_terms(problems_of):
    text = DIRECT.replace("{gain: 2.0}", "{count: 1}") + "rewards: {alive: {func: is_alive, weight: 1.0}}\n"
    (message,) = problems_of(text, files={"task": CLASS})
    assert "rewards: a direct task has no rewards terms; its class implements them" in message


def test_unknown_success_term_names_its_section(tmp_path):
    task = edited(PENDULUM_TASK, success={"near": {"func": "joint_eror", "at_most": 0.1}})
    with pytest.raises(ConfigError, match="no success term 'joint_eror'; did you mean 'joint_error'"):
        build(pendulum(tmp_path, task))


def test_class_inherits_parameters_in_same_file(tmp_path):
    file = tmp_path / "terms.py"
    file.write_text(
        "class _Base:\n    def __init__(self, env, *, gain: float = 2.0): ...\n"
        "class Louder(_Base):\n    'Louder.'\nclass Loudest(Louder):\n    'Loudest.'\n"
        "class Circle(Circle):\n    'No base that it could inherit from.'\n"
    )
    terms = read_terms(file)
    assert sorted(terms) == ["louder", "loudest"]
    assert [(t.summary, t.parameters[0].name, t.parameters[0].default) for t in terms.values()] == [
        ("Louder.", "gain", 2.0),
        ("Loudest.", "gain", 2.0),
    ]


DATACLASSES = """
from dataclasses import KW_ONLY, dataclass, field
from typing import ClassVar

@dataclass
class _Near:
    env: object
    _: KW_ONLY
    entity: Entity = "robot"
    gain: float = 1.0
    memory: ClassVar[int] = 3
    drawn: list[float] = field(init=False)

@dataclass(kw_only=True)
class Nearer(_Near):
    "Nearer."
    axes: list[int] = field(default_factory=lambda: [2])
    gain: float = 2.0

class Nearest(Nearer):
    "Nearest."
    offset: float = 0.0

@dataclass
class Positional:
    env: object
    gain: float
"""


def test_dataclass_fields_are_parameters(tmp_path):
    file = tmp_path / "terms.py"
    file.write_text(DATACLASSES)
    terms = read_terms(file)
    assert sorted(terms) == ["nearer", "nearest", "positional"]
    for name in ("nearer", "nearest"):
        assert [(p.name, p.default) for p in terms[name].parameters] == [
            ("entity", "robot"),
            ("gain", 2.0),
            ("axes", [2]),
        ]
    assert terms["positional"].error == "the parameter 'gain' must be keyword-only: put it after a '*'"


def test_class_inherits_parameters_from_rlcli_mdp(tmp_path):
    file = tmp_path / "terms.py"
    file.write_text(
        "from rlcli.mdp.actions import JointEffort\nfrom rlcli.mdp.randomization import RandomizeBodyMass as Mass\n"
        "from rlcli.envs.direct import DirectTask\n"
        "class Louder(JointEffort):\n    'Louder.'\nclass Heavier(Mass):\n    'Heavier.'\nclass Own(DirectTask): ...\n"
    )
    terms = read_terms(file)
    assert sorted(terms) == ["heavier", "louder"]
    assert terms["louder"].parameters == builtin_terms("actions")["joint_effort"].parameters
    assert terms["heavier"].parameters == builtin_terms("events")["randomize_body_mass"].parameters


def test_class_object_has_inherited_parameters():
    own, built_in = signature_of(RandomizeJointDamping, "damping"), builtin_terms("events")["randomize_joint_damping"]
    assert own.parameters == built_in.parameters
