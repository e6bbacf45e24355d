"""Invalid YAML: each mistake is reported with file, line, column and exit code 3, for any bytes."""

import copy
import json
import random
import time
from typing import Annotated, Any, get_args

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError
from support import yaml_grammar
from support.fault_sizes import amount, chosen, seeds

from rlcli.cli.app import main
from rlcli.config import strict_yaml
from rlcli.config.dump import to_yaml
from rlcli.config.load import resolve
from rlcli.config.schema import TaskConfig
from rlcli.config.strict_yaml import Document, YamlError
from rlcli.errors import ConfigError, DependencyError
from rlcli.registry import TASKS, TRAINERS, catalog, find_entry, find_task, folder_task, load_entry, load_object

GOOD = find_task("cartpole").config.read_text(encoding="utf-8")
BUILT_IN = [
    find_task(entry.qualified).config.read_bytes() for entry in catalog(TASKS)[0] if entry.distribution == "rlcli"
]

# --- named mistakes: text after a valid task, and the position of the mistake (line 0: the whole file) ---

NAMED = {
    "a key twice": ("x: {}\nx: {}\n", 2, 1),
    "a key twice in braces": ("x: {a: 1, a: 2}\n", 1, 11),
    "a Python object": ("x: !!python/object/apply:os.system [touch canary]\n", 1, 4),
    "a Python name": ("x: !!python/name:os.system\n", 1, 4),
    "a Python module": ("x: !!python/module:os\n", 1, 4),
    "a tag of YAML's own": ("x: !!float '3'\n", 1, 4),
    "a tag of one's own": ("x: !mine {a: 1}\n", 1, 4),
    "a binary": ("x: !!binary aGk=\n", 1, 4),
    "a set": ("x: !!set {a, b}\n", 1, 4),
    "an anchor": ("x: &a 1\n", 1, 4),
    "an alias": ("x: 1\ny: *a\n", 2, 4),
    "an alias bomb": ("a: &a [x, x]\n" + "".join(f"{n}: &{n} [*a, *a]\n" for n in "bcdefghi"), 1, 4),
    "a merge key": ("x:\n  <<: {a: 1}\n", 2, 3),
    "a word for true": ("x: yes\n", 1, 4),
    "a word for false": ("x: [off]\n", 1, 5),
    "an octal number": ("x: 010\n", 1, 4),
    "no number": ("x: .nan\n", 1, 4),
    "an endless number": ("x: -.inf\n", 1, 4),
    "a number out of range": ("x: 1e999\n", 1, 4),
    "a second document": ("---\nx: 1\n", 1, 1),
    "a number as key": ("1: 2\n", 1, 1),
    "a list as key": ("? [a]\n: 1\n", 1, 3),
    "a tab": ("x:\n\t- 1\n", 2, 1),
    "a bracket that stays open": ("x: [1, 2\n", 2, 1),
    "a null byte": ("x: \0\n", 1, 4),
    "forty levels": ("x: " + "[" * 40 + "]" * 40 + "\n", 1, 35),
    "a hundred thousand levels": ("x: " + "[" * 100_000 + "\n", 1, 35),
    "a hundred thousand keys": ("".join(f"k{n}:\n" for n in range(30_000)), None, 1),
    "a long value": ("x: " + "a" * 20_000 + "\n", 1, 4),
    "not UTF-8": (b"x: \xff\n", 1, 4),
    "half a megabyte": ("# " + "x" * 500_000 + "\n", 0, 0),
}


@pytest.mark.parametrize("name", chosen(list(NAMED), 12))
def test_invalid_yaml_is_refused_with_line_and_column(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, line, column = NAMED[name]
    file = tmp_path / "task.yaml"
    file.write_bytes(GOOD.encode() + (text if isinstance(text, bytes) else text.encode()))
    assert main(["validate", "task.yaml", "--json"]) == 3
    (problem,) = json.loads(capsys.readouterr().out)["error"]["problems"]
    before = GOOD.count("\n")
    if line == 0:
        assert problem["where"] == "task.yaml"
    elif line is None:
        assert problem["where"].startswith("task.yaml:")
        assert "more than 20000 items" in problem["message"]
    else:
        assert problem["where"] == f"task.yaml:{before + line}:{column}"
    assert not (tmp_path / "canary").exists()


# --- three mistakes for each field of the schema: wrong type, out of range, unknown sibling ---

WRONG = [{"zz": 1}, [[]], "no such thing", True, 3]
OUT_OF_RANGE = [-1, 0, -1.5, 10**12, 1e12, -1e12]


def models(annotation):
    """Return the model that an annotation stands for, if it stands for one."""
    found = [
        kind for kind in (annotation, *get_args(annotation)) if isinstance(kind, type) and issubclass(kind, BaseModel)
    ]
    return found if len(found) == 1 else []


def fields(model, path=()):
    for name, info in model.model_fields.items():
        if name in ("agents", "play", "agent"):
            continue
        yield (*path, name), info
        for inner in models(info.annotation) if len(path) < 3 else []:
            yield from fields(inner, (*path, name))


def refuses(info, value):
    kind: Any = Annotated[info.annotation, *info.metadata] if info.metadata else info.annotation
    try:
        TypeAdapter(kind).validate_json(json.dumps(value), strict=True)
    except ValidationError:
        return True
    return False


def changed(data, path, value):
    data = copy.deepcopy(data)
    target = data
    for step in path[:-1]:
        if not isinstance(target.get(step), dict):
            target[step] = {}
        target = target[step]
    target[path[-1]] = value
    return data


def mistakes(model, at=()):
    """Yield (path, value) for every field: another type, a value out of range, and an unknown key beside it."""
    for path, info in fields(model):
        wrong = next((value for value in WRONG if refuses(info, value)), None)
        if wrong is not None:
            yield (*at, *path), wrong
        far = next((value for value in OUT_OF_RANGE if refuses(info, value)), None)
        if far is not None:
            yield (*at, *path), far
        yield (*at, *path[:-1], f"{path[-1]}_"), 1


def all_mistakes():
    yield from mistakes(TaskConfig)
    for trainer, algorithm, agent in (("sb3", "ppo", "sb3-ppo"), ("sb3", "sac", "sac"), ("ppo", "ppo", "ppo")):
        spec = load_entry(find_entry(TRAINERS, trainer, what="trainer"), object)
        for path, value in mistakes(load_object(spec.algorithms[algorithm])):
            if path[0] not in ("trainer", "algorithm", "task"):
                yield ("agents", agent, *path), (trainer, algorithm, value)


MISTAKES = list(all_mistakes())
assert len(MISTAKES) + len(NAMED) >= 277, len(MISTAKES)


@pytest.mark.parametrize("number", chosen(range(len(MISTAKES)), 40))
def test_invalid_value_of_any_field_is_reported_at_its_position(number, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, value = MISTAKES[number]
    data = strict_yaml.load(GOOD).data
    del data["play"]  # patches would mend some mistakes
    for agent in data["agents"].values():
        agent.pop("task", None)
    if path[0] == "agents":
        trainer, algorithm, value = value
        agent = {"trainer": trainer, "algorithm": algorithm, "max_iterations": 1}
        data["agents"] = {"default": path[1], path[1]: data["agents"].get(path[1], agent)}
    data = changed(data, path, value)
    folder = tmp_path / "task"
    folder.mkdir()
    text = to_yaml(data)
    (folder / "task.yaml").write_text(text, encoding="utf-8")
    marks = strict_yaml.load(text).marks
    with pytest.raises(ConfigError) as caught:
        resolve(folder_task(folder))
    assert caught.value.exit_code == 3
    places = [problem.where for problem in caught.value.problems]
    wanted = ["task/task.yaml:{}:{}".format(*mark) for known, mark in marks.items() if known[: len(path)] == path]
    assert any(place in wanted for place in places), (path, value, caught.value.message)


# --- random bytes ---

PIECES = [
    b"&a ", b"*a", b"!!python/name:os.system ", b"{", b"[", b"]", b"}", b"---\n", b": ", b"\t", b"\xc3", b"? ",
    b"<<: ", b"- ", b"|\n", b">\n", b"'", b'"', b"\\", b"%YAML 1.1\n", b"...\n", b"\r", b"\x85", b"\xe2\x80\xa8",
    b"1e999", b".nan", b"0o17", b"yes", b"~", b"#", b"\0", b"\x7f", b"\xed\xa0\x80", b"\xef\xbb\xbf", b"null: ",
    b"[" * 40, b"{a: " * 40,
]  # fmt: skip


def mutant(draw):
    data = bytearray(draw.choice(BUILT_IN))
    at = draw.randrange(len(data))
    del data[at + draw.randint(20, 1500) :]  # what stands before a mistake is read; what follows it is not
    del data[: draw.randrange(at + 1) if draw.random() < 0.5 else 0]
    for _ in range(draw.randint(1, 4)):
        at, kind = draw.randrange(len(data) + 1), draw.randrange(4)
        if kind == 0:
            data[at : at + 1] = bytes([draw.randrange(256)])
        elif kind == 1:
            data[at:at] = draw.choice(PIECES)
        elif kind == 2:
            del data[at : at + draw.randint(1, 8)]
        else:
            other = draw.randrange(len(data) + 1)
            data[at:at] = data[other : other + draw.randint(1, 40)]
    return bytes(data)


BATCH = 2000


@pytest.mark.parametrize("seed", seeds(1, 10, 500))
def test_random_bytes_give_a_mapping_or_a_syntax_error(seed):
    draw, read = random.Random(seed), 0
    for _ in range(BATCH):
        data = mutant(draw)
        try:
            document = strict_yaml.load(data)
        except YamlError as error:
            assert error.message  # noqa: PT017
            continue
        assert type(document) is Document
        assert type(document.data) is dict
        read += 1
    assert 0 < read < BATCH


def test_thousands_of_mistakes_are_listed_in_part_and_in_little_time(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "task.yaml").write_text(GOOD + "".join(f"key_{n}: 1\n" for n in range(9000)))
    begin = time.process_time()
    assert main(["validate", "./task"]) == 3
    assert time.process_time() - begin < 4
    printed = capsys.readouterr().err
    assert "more than 50 mistakes" in printed
    assert len(printed) < 30_000


@pytest.mark.parametrize(
    "model", ["é" * 300, "cartpole:" + "x" * 300, "package:rlcli/" + "x" * 300, "a | " + "x" * 300]
)
def test_model_with_a_name_too_long_for_the_system_is_a_mistake_of_its_line(model, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "task.yaml").write_text(GOOD.replace("model: cartpole.xml", f"model: {model}"), "utf-8")
    assert main(["validate", "./task"]) in (3, 4)
    err = capsys.readouterr().err
    assert err.startswith("error: task/task.yaml:"), err
    assert "File name too long" in err


@pytest.mark.parametrize("model", ["\\0", "a\\0b.xml", "cartpole:a\\0b.xml", "package:rlcli/\\0"])
def test_null_character_in_a_models_name_is_a_mistake_of_its_line(model, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "task.yaml").write_text(GOOD.replace("model: cartpole.xml", f'model: "{model}"'))
    assert main(["validate", "./task"]) == 3
    err = capsys.readouterr().err
    assert err.startswith("error: task/task.yaml:"), err
    assert "embedded null byte" in err


NUM_ENVS = ["0", "-1", "-0", "1_000", "4.0", "04", "1e12", "1e3", "1.5", "1e-5", "nan", ".nan", ".inf", "true", "null",
            "", "[]", "{}", "abc", "0x10", "\u0661\u0662", "\uff11\uff12", "16777217", "1000000000000", "9" * 5000,
            "'4'", "!!int 4", "4,5", "~", "-" * 10]  # fmt: skip


@pytest.mark.parametrize("value", NUM_ENVS)
def test_hostile_number_of_environments_is_refused(value, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["validate", "cartpole", f"scene.num_envs={value}"]) == 3
    assert main(["eval", "cartpole", "--policy", "zero", "--num-envs", value]) in (2, 3)
    assert "num" in capsys.readouterr().err


@pytest.mark.parametrize("first", seeds(1, 20, 400))
def test_task_files_and_overrides_of_the_grammar_end_with_a_message(first, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    count = amount(15, 50)
    assert yaml_grammar.run_all(first * count, count, tmp_path) == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", seeds(2, 20, 200))
def test_task_file_of_the_grammar_is_refused_by_the_command(seed, child, tmp_path):
    text, words = yaml_grammar.case(seed, yaml_grammar.documents())
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "task.yaml").write_text(text, encoding="utf-8", errors="surrogatepass")
    ended = child(tmp_path, "validate", "./task", *(word for word in words if "\ud800" not in word)).ended()
    assert not yaml_grammar.complaint(ended.code, ended.err, 0.0, [text, *words])


@pytest.mark.parametrize("seed", seeds(1, 5, 50))
def test_mutated_task_gives_a_configuration_or_problems(seed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "task"
    folder.mkdir()
    (folder / "task.yaml").touch()
    source, draw = folder_task(folder), random.Random(1000 + seed)
    refused = 0
    for _ in range(50):
        data = bytearray(BUILT_IN[seed % len(BUILT_IN)])
        for _ in range(draw.randint(1, 3)):
            at = draw.randrange(len(data))
            data[at : at + draw.randint(0, 3)] = draw.choice([bytes([draw.randrange(32, 127)]), b"", b"9", b"x", b" "])
        (folder / "task.yaml").write_bytes(data)
        try:
            resolve(source)
        except ConfigError as error:
            assert all(p.where.startswith("task/task.yaml") for p in error.problems), error.problems  # noqa: PT017
            refused += 1
        except DependencyError:
            refused += 1
    assert refused
