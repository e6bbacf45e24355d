"""`--help`: panels, metavars, defaults, and examples that the command line accepts."""

import re
import shlex

import pytest
import typer

from rlcli.cli.app import COMMANDS, PANELS, _with_values, build, main
from rlcli.cli.ui.help_text import OPTION_PANELS, read_docstring

ROOT = typer.main.get_command(build())
IMPORTERS = [("import", name) for name, command in ROOT.commands["import"].commands.items() if not command.hidden]
PATHS = [(), ("import",), *((name,) for name in COMMANDS), *IMPORTERS]
LEAVES = [path for path in PATHS if path not in ((), ("import",))]
WIDTH = 80


def ids(path):
    return "-".join(path) or "rlcli"


def find(path):
    command = ROOT
    for name in path:
        command = command.commands[name]
    return command


def parse(words):
    """Parse a command line as `rlcli` does, without running the command; return the context of the command."""
    name, command, context = "rlcli", ROOT, None
    while True:
        context = command.make_context(name, list(words), parent=context)
        if not hasattr(command, "commands"):
            return context
        name, command, words = command.resolve_command(context, [*context._protected_args, *context.args])


@pytest.fixture
def help_of(in_process, monkeypatch):
    """help_of(path) -> text of `rlcli PATH --help` on 80 columns."""
    monkeypatch.setenv("COLUMNS", str(WIDTH))

    def run(path):
        code, out, err = in_process(*path, "--help")
        assert (code, err) == (0, "")
        return out

    return run


def panels_of(text):
    """Return panel -> its lines."""
    panels = {}
    for line in text.splitlines():
        if re.fullmatch(r"[A-Z][\w ,]*:", line):
            panels[line[:-1]] = []
        elif panels:
            panels[list(panels)[-1]].append(line)
    return panels


@pytest.mark.parametrize("path", PATHS, ids=ids)
def test_help_ends_with_two_examples_that_parse(help_of, path):
    panels = panels_of(help_of(path))
    assert list(panels)[-1] == "Examples"
    lines = [line for line in panels["Examples"] if line]
    assert len(lines) == 4
    for example, explanation in zip(lines[::2], lines[1::2], strict=True):
        assert re.match(r"  \S", example)
        assert re.match(r"      [A-Z].+\.$|      [A-Z].+: rlcli .+$", explanation)
        program, *words = shlex.split(example)
        assert program == "rlcli"
        assert tuple(words[: len(path)]) == path
        parse(_with_values(words))


def test_parse_rejects_unknown_commands_and_options():
    for words in (["nonsense"], ["train", "cartpole", "--nonsense"], ["train", "--num-envs", "x"]):
        with pytest.raises(typer._click.exceptions.UsageError):
            parse(words)


@pytest.mark.parametrize("path", PATHS, ids=ids)
def test_help_fits_80_columns_and_has_plain_metavars(help_of, path):
    text = help_of(path)
    assert max(map(len, text.splitlines())) <= WIDTH
    assert not re.search(r"<[a-z\[]|<=|>=|\d{10}", text)
    for option in (option for option in find(path).params if option.param_type_name == "option" and not option.hidden):
        if not option.is_flag:
            assert re.search(rf"{max(option.opts, key=len)} [A-Z]", text), option.name


@pytest.mark.parametrize("path", LEAVES, ids=ids)
def test_help_shows_all_parameters_and_defaults(help_of, path):
    text = "".join(help_of(path).split())  # lines also break after hyphens
    for parameter in find(path).params:
        if parameter.hidden:
            continue
        assert parameter.help, parameter.name
        assert "".join(parameter.help.partition(" [default:")[0].split()) in text, parameter.name
        if parameter.default is not None and not isinstance(parameter.default, bool):
            assert f"[default:{parameter.default}]" in text, parameter.name
    assert text.count("[default:") == text.count("default:")


def test_root_help_groups_commands_in_order_of_use(help_of):
    panels = panels_of(help_of(()))
    assert list(panels)[: len(PANELS)] == list(PANELS)
    for panel, names in PANELS.items():
        assert [line.split()[0] for line in panels[panel] if re.match(r"  \S", line)] == list(names)


@pytest.mark.parametrize("path", LEAVES, ids=ids)
def test_commands_with_many_options_have_panels(help_of, path):
    panels = panels_of(help_of(path))
    options = [each for each in find(path).params if each.param_type_name == "option" and not each.hidden]
    own = [each.name for each in options if each.name not in ("json", "quiet", "verbose", "debug")]
    used = set(panels) & (set(OPTION_PANELS) - {"Output"})
    assert bool(used) == (len(own) > 8)
    output = [re.search(r"--[a-z]+", line)[0] for line in panels["Output"] if line]
    assert output == ["--json", "--quiet", "--verbose", "--debug", "--help"]


def test_panels_of_train(help_of):
    panels = panels_of(help_of(("train",)))
    wanted = ["Arguments", "Run", "Environment", "Trainer", "Logs and files", "Machine", "Output", "Examples"]
    assert list(panels) == wanted


def test_option_is_in_one_panel_only():
    names = [name for panel in OPTION_PANELS.values() for name in panel]
    known = {option.lstrip("-") for path in LEAVES for each in find(path).params for option in each.opts}
    assert len(names) == len(set(names))
    assert set(names) <= known | {"help"}


def test_read_docstring_splits_text_options_and_examples():
    def command():
        """Do it.

        More text.

        Options:
            one: First
                line. [default: 3]
            two: Second.

        Examples:
            rlcli do it
                Do it.
        """

    text, helps, examples = read_docstring(command)
    assert text == "Do it.\n\nMore text."
    assert helps == {"one": "First line. [default: 3]", "two": "Second."}
    assert examples == "rlcli do it\n    Do it."


def number_options(path, *kinds):
    found = (each for each in find(path).params if each.metavar in (kinds or ("INTEGER", "FLOAT")))
    return [max(each.opts, key=len) for each in found if each.param_type_name == "option"]


def test_commands_have_number_options():
    assert len({(path, option) for path in LEAVES for option in number_options(path)}) > 40


@pytest.mark.parametrize("path", LEAVES, ids=ids)
@pytest.mark.parametrize("number", ["1_0", "0x1", "1e1 ", "٤", "inf", "nan"])
def test_number_options_refuse_what_files_refuse(path, number, capsys):
    for option in number_options(path):
        assert main([*path, f"{option}={number}"]) == 2
        assert re.search("expected a (whole )?number", capsys.readouterr().err)


@pytest.mark.parametrize("path", LEAVES, ids=ids)
def test_number_options_refuse_an_empty_value(path, capsys):
    for option in number_options(path):
        assert main([*path, f"{option}="]) == 2
        assert "there is an empty word after" in capsys.readouterr().err


@pytest.mark.parametrize("path", LEAVES, ids=ids)
def test_whole_numbers_have_no_fraction(path, capsys):
    for option in number_options(path, "INTEGER"):
        assert main([*path, f"{option}=8.0"]) == 2
        assert "expected a whole number, found 8.0" in capsys.readouterr().err
