"""`rlcli plot`: references of runs, contents and path of the figure, and invalid arguments."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from support.written_runs import learning, write_run

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.fixture
def runs(tmp_path):
    """Three seeds of one configuration, and a run of another one."""
    folder = tmp_path / "runs"
    made = [write_run(folder, seed=seed, rows=learning(scale=seed)) for seed in (1, 2, 3)]
    return [*made, write_run(folder, "cartpole-direct", rows=learning())]


def test_single_run_is_drawn_into_its_folder(cli, runs):
    result = cli("plot", runs[0].folder)
    file = runs[0].folder / "plots" / "curves.png"
    assert (result.code, result.out.strip()) == (0, str(file))
    with Image.open(file) as image:
        assert image.width > 1000
        assert len(image.getcolors(1 << 20)) > 10


def test_seeds_of_one_configuration_share_a_curve(cli, runs, tmp_path):
    result = cli("plot", "cartpole", "--json")
    assert result.code == 0
    assert result.json["file"] == "curves.png"
    assert (tmp_path / "curves.png").is_file()
    (curve,) = result.json["curves"]
    assert [run["seed"] for run in curve["runs"]] == [1, 2, 3]
    last = curve["last"]["Train/mean_reward"]
    assert last["value"] == pytest.approx(20.0)
    assert 10.0 <= last["low"] < 20.0 < last["high"] <= 30.0
    assert "interquartile mean" in result.err


@pytest.mark.parametrize(
    ("references", "seeds"),
    [
        (["latest"], [[1]]),
        (["rlcli:cartpole"], [[1, 2, 3]]),
        (["runs/cartpole"], [[1, 2, 3]]),
        (["cartpole", "cartpole-direct"], [[1, 2, 3], [1]]),
        (["NAME0", "FOLDER1"], [[1, 2]]),
        (["FOLDER0", "FOLDER0", "cartpole"], [[1, 2, 3]]),
    ],
)
def test_run_references(cli, runs, references, seeds):
    names = {f"FOLDER{i}": run.folder for i, run in enumerate(runs)} | {
        f"NAME{i}": f"cartpole/{run.folder.name}" for i, run in enumerate(runs)
    }
    result = cli(
        "plot", *(names.get(each, each) for each in references), "-o", "x.svg", "--metrics", "return", "--json"
    )
    assert result.code == 0, result.err
    assert [[run["seed"] for run in curve["runs"]] for curve in result.json["curves"]] == seeds


@pytest.mark.parametrize("kind", ["svg", "pdf", "png"])
def test_figure_bytes_are_reproducible(cli, runs, kind):
    pictures = []
    for name in ("a", "b"):
        assert cli("plot", "cartpole", "-o", f"{name}.{kind}", "--metrics", "return").code == 0
        pictures.append(Path(f"{name}.{kind}").read_bytes())
    assert pictures[0] == pictures[1]
    assert pictures[0][:4] in (b"<?xm", b"%PDF", b"\x89PNG")


def test_figure_ignores_matplotlibrc(cli, runs, tmp_path, environment):
    assert cli("plot", "cartpole", "-o", "a.svg", "--metrics", "return").code == 0
    (tmp_path / "own").write_text("lines.linewidth: 9\nfont.size: 30\nbackend: TkAgg\n")
    os.mkfifo(tmp_path / "matplotlibrc")  # reading it would block
    line = [sys.executable, "-m", "rlcli", "plot", "cartpole", "-o", "b.svg", "-q", "--metrics", "return"]
    env = {**environment, "PYTHONHASHSEED": "5", "MATPLOTLIBRC": str(tmp_path / "own")}
    done = subprocess.run(line, capture_output=True, text=True, env=env, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert Path("a.svg").read_bytes() == Path("b.svg").read_bytes()


def test_figure_has_chosen_metrics_and_axis(cli, runs):
    text = {}
    for axis in ("steps", "iterations", "time"):
        assert cli("plot", runs[0].folder, "-o", "x.svg", "--x", axis, "--metrics", "Loss,rewards").code == 0
        text[axis] = Path("x.svg").read_text()
    assert "<!-- Loss/value -->" in text["steps"]  # matplotlib writes the text of a path as a comment
    assert "<!-- effort -->" in text["steps"]
    assert "<!-- Return -->" not in text["steps"]
    for axis, label in (("steps", "environment steps"), ("iterations", "iterations"), ("time", "training time [s]")):
        assert f"<!-- {label} -->" in text[axis]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["latest", "--metrics", "retrun"], 2, "did you mean 'return'"),
        (["latest", "--metrics", ","], 2, "--metrics names no metric"),
        (["latest", "--x", "step"], 2, "did you mean 'steps'"),
        (["latest", "-o", "x.jpg"], 2, "the name must end in .png or .svg or .pdf"),
        (["latest", "-o", "runs"], 2, "is not a picture"),
        (["latest", "-o", "folder.png"], 2, "is a folder"),
        (["latest", "-o", "nowhere/x.png"], 10, "cannot write nowhere/x.png"),
        (["cartpoel"], 5, "no run 'cartpoel'"),
        (["latest", "--runs-dir", "nowhere"], 5, "/nowhere\nhint: rlcli train"),
        ([], 2, "Missing argument"),
    ],
)
def test_invalid_arguments_are_one_message(cli, runs, arguments, code, message):
    Path("folder.png").mkdir()
    result = cli("plot", *arguments)
    assert (result.code, result.out) == (code, "")
    assert message in result.err
    failed = cli("plot", *arguments, "--json")
    assert failed.json["error"]["exit_code"] == code
    assert [file.name for file in Path().glob("*.png")] == ["folder.png"]


def test_missing_matplotlib_names_pip_command(cli, runs, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None)
    result = cli("plot", "latest")
    assert result.code == 7
    assert '"rlcli[plot]"' in result.err


def test_run_without_metrics_is_skipped_among_others(cli, runs, tmp_path):
    empty = write_run(tmp_path / "runs", seed=9)
    result = cli("plot", empty.folder)
    assert result.code == 5
    assert "has no metrics yet" in result.err
    assert not (empty.folder / "plots").exists()
    result = cli("plot", "cartpole", "--json")
    assert result.code == 0
    assert any("has no metrics yet" in note for note in result.json["notes"])


def test_link_instead_of_plots_folder_is_not_followed(cli, runs, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    (runs[0].folder / "plots").symlink_to(outside)
    result = cli("plot", runs[0].folder)
    assert result.code == 5
    assert list(outside.iterdir()) == []


def test_untrusted_names_are_drawn_as_text(cli, tmp_path):
    odd = "$x^{2</text><script>alert(1)</script>\u202e\x07"
    rows = learning(**{f"Episode_Reward/{odd}": 1.0, "Episode_Reward/_hidden": 2.0, "Episode_Reward/漢字": 3.0})
    run = write_run(tmp_path / "runs", rows=rows, agent="td3")
    result = cli("plot", run.folder, "-o", "x.svg")
    assert result.code == 0, result.err
    text = Path("x.svg").read_text()
    assert "<script" not in text
    assert "_hidden" in text


def test_many_curves_differ_in_line_style(cli, tmp_path):
    run = write_run(tmp_path / "runs", rows=learning(**{f"Episode_Reward/term{i}": float(i) for i in range(12)}))
    assert cli("plot", run.folder, "-o", "x.svg", "--metrics", "rewards").code == 0
    assert "stroke-dasharray" in Path("x.svg").read_text()


def test_folders_of_runs_name_their_runs(cli, tmp_path):
    study = tmp_path / "elsewhere" / "cartpole" / "2026-01-01_10-00-00-calm"
    for number, weight in enumerate((-0.01, -0.5, -0.7)):
        run = write_run(tmp_path / "made", rows=learning(), overrides=(f"rewards.cart_vel.weight={weight}",))
        place = study / "seed-1" if number == 0 else study.with_name(f"2026-01-0{number + 1}_10-00-00")
        place.parent.mkdir(parents=True, exist_ok=True)
        run.folder.rename(place)
    (study / "study.json").write_text("{}")
    every = {"calm", "cart_vel.weight=-0.5", "cart_vel.weight=-0.7"}
    for reference, labels in (("elsewhere", every), ("elsewhere/cartpole", every), (f"cartpole/{study.name}", None)):
        result = cli("plot", reference, "--runs-dir", "elsewhere", "--json", "-o", "x.png")
        assert result.code == 0
        assert {curve["label"] for curve in result.json["curves"]} == (labels or {"cartpole, sb3-ppo"})
    assert cli("plot", study.name, "--runs-dir", "elsewhere", "-o", "x.png").code == 0
