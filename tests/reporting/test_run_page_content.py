"""`rlcli report`: content of the page, messages for missing parts, and escaping of untrusted text."""

import base64
import html
import json
import os
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from support.written_runs import learning, write_run

from rlcli.cli.app import main

pytestmark = pytest.mark.usefixtures("empty_folder")

MP4 = b"\x00\x00\x00\x18ftypisom" + bytes(100)
ATTACK = "<script>document.title='run'</script><img src=x onerror=alert(1)>\"'&{{7*7}}"


class Reader(HTMLParser):
    """Parser of the tags, the attributes and the text of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.words = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def read(file):
    return Reader(Path(file).read_text(encoding="utf-8"))


def origin_of(text, key):
    """Return the origin of a value on a page."""
    row = rf"<code>{re.escape(key)}</code></td><td><code>[^<]*</code></td><td class=\"origin\">([^<]*)</td>"
    return html.unescape(re.search(row, text)[1])


def require_harmless(page):
    """Check that a page has no scripts and no external resources."""
    assert not {"script", "iframe", "object", "embed", "link", "base", "form", "foreignobject"} & set(page.tags)
    assert not [name for name, _ in page.attributes if name.startswith("on")]
    places = [value for name, value in page.attributes if name in ("src", "href", "xlink:href", "srcset", "data")]
    assert all(place.startswith(("#", "data:video/mp4;base64,")) for place in places)
    assert not [value for name, value in page.attributes if name == "style" and re.search(r"url\((?!#)|@import", value)]


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """Run of a task with short episodes, trained once."""
    runs = tmp_path_factory.mktemp("trained")
    words = ["scene.num_envs=4", "episode_length_s=0.5", "agent.n_steps=32", "agent.num_minibatches=2"]
    train = ["train", "cartpole", *words, "--max-iterations", "2", "--logger", "none", "-q", "--runs-dir", str(runs)]
    assert main(train) == 0
    (run,) = runs.glob("cartpole/*")
    return run


@pytest.fixture
def trained(template, tmp_path):
    return Path(shutil.copytree(template, tmp_path / "runs" / "cartpole" / template.name))


def test_report_has_all_sections(cli, tmp_path):
    run = write_run(tmp_path / "runs", rows=learning(), overrides=["rewards.alive.weight=1.5"], cpu={"model": "A chip"})
    result = cli("report", "latest", "--json")
    assert result.code == 0
    assert Path(result.json["file"]) == Path("runs/cartpole") / run.folder.name / "report.html"
    page = read(result.json["file"])
    require_harmless(page)
    for words in (
        "cartpole", "Balance a pole on a cart", "1,000 steps in 10 iterations",
        "Sum of the squared deviations of joints from",
        "rewards.alive.weight", "override 'rewards.alive.weight=1.5'", "A chip", "rlcli train cartpole --seed 1",
        "rlcli reproduce", "mujoco",
    ):  # fmt: skip
        assert words in page.text, words
    assert page.tags.count("svg") == 5
    assert result.json["charts"] == ["Return", "Success", "Episode length", "Reward terms", "Why episodes ended"]
    assert result.json["missing"] == {
        "evaluation": "There is no evaluation: the run has no complete checkpoint.",
        "video": "There is no video: the run has no complete checkpoint.",
    }


def test_page_starts_with_content_security_policy(cli, tmp_path):
    write_run(tmp_path / "runs", rows=learning())
    text = Path(cli("report", "latest").out.strip()).read_text()
    head = text[: text.index("<title>")]
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', head)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.replace("&#39;", "'").split(";"))
    assert rules["default-src"] == "'none'"
    assert set(rules) == {"default-src", "style-src", "img-src", "media-src", "base-uri", "form-action"}
    assert {rules["img-src"], rules["media-src"]} == {"data:"}


def test_settings_have_origins(cli, tmp_path):
    runs = tmp_path / "runs"
    write_run(runs, rows=learning(), overrides=["rewards.alive.weight=1.5"])
    text = Path(cli("report", "latest").out.strip()).read_text()

    def origin(key):
        return origin_of(text, key)

    assert origin("rewards.alive.weight") == "override 'rewards.alive.weight=1.5'"
    assert re.fullmatch(r"task\.yaml:\d+:\d+", origin("episode_length_s"))
    assert re.fullmatch(r"agent: task\.yaml:\d+:\d+", origin("scene.num_envs"))
    assert origin("sim.gravity") == "default"


def test_origin_of_changed_value_is_run_file(cli, tmp_path):
    run = write_run(tmp_path / "runs", rows=learning())
    text = run.config.read_text()
    run.config.write_text(text.replace("episode_length_s: 5.0", "episode_length_s: 7.0"))
    line = text[: text.index("episode_length_s")].count("\n") + 1
    page = Path(cli("report", "latest").out.strip()).read_text()
    assert origin_of(page, "episode_length_s") == f"config.yaml:{line}:1 (the installed task differs)"


def test_direct_task_page_has_parameters_and_docstrings(cli, tmp_path):
    write_run(tmp_path / "runs", "cartpole-direct", rows=learning())
    page = read(cli("report", "latest").out.strip())
    assert "Reward an upright pole and slow joints; a failure costs 2" in page.text
    assert "Force on the cart at action 1 [N]." in page.text


def test_untrusted_text_is_escaped(cli, tmp_path):
    rows = learning(**{f"Episode_Reward/{ATTACK}": 1.0, f"Episode_Termination/{ATTACK}": 0.5})
    run = write_run(tmp_path / "runs", rows=rows)
    run.update(
        state=ATTACK,
        versions={ATTACK: ATTACK, "list": [ATTACK]},
        given={"sim.dt": ATTACK},
        cpu={"model": ATTACK},
        platform=f"{ATTACK}\u202e\x00",
        command=["rlcli", ATTACK, {"a": ATTACK}],
        sources={ATTACK: ATTACK},
        device=ATTACK,
        init_from=ATTACK,
        resumed=[ATTACK],
        started=ATTACK,
    )
    run.config.write_text(
        run.config.read_text().replace(
            "summary: Balance a pole on a cart (manager-based, Isaac Lab's parameters).",
            f"summary: {json.dumps(ATTACK)}",
        )
    )
    folder = run.folder.rename(run.folder.with_name("a<b onclick=x>'\""))
    result = cli("report", folder)
    assert result.code == 0, result.err
    text = (folder / "report.html").read_text()
    page = Reader(text)
    require_harmless(page)
    assert page.text.count("<script>document.title='run'</script>") > 5
    assert "{{7*7}}" in page.text
    assert not re.search("[\x00-\x08\u202e]", text)


def test_untrusted_task_code_is_not_executed(cli, tmp_path, coin):
    canary = tmp_path / "canary"
    Path("coin/task.py").write_text(f"open({str(canary)!r}, 'w')\n")
    run = write_run(tmp_path / "runs", rows=learning())
    run.update(task={"name": "coin", "distribution": None, "version": None, "folder": str(tmp_path / "coin")})
    result = cli("report", run.folder)
    assert result.code == 0, result.err
    page = read(run.folder / "report.html")
    assert "Sum of the squared deviations of joints from" in page.text  # rlcli's own terms are described
    assert not canary.exists()


@pytest.mark.parametrize("config", ["a: [", "rewards: 7", "x: !!python/object/apply:os.system [ls]", ""])
def test_invalid_configuration_is_reported_on_page(cli, tmp_path, config):
    run = write_run(tmp_path / "runs", rows=learning(), config=config)
    result = cli("report", run.folder)
    assert result.code == 0, result.err
    assert "cannot be described" in read(run.folder / "report.html").text
    assert "cannot be described" in result.err


def test_run_without_metrics_has_page(cli, tmp_path):
    run = write_run(tmp_path / "runs")
    assert cli("report", run.folder).code == 0
    assert "has no metrics yet" in read(run.folder / "report.html").text


def test_page_without_matplotlib_names_pip_command(cli, tmp_path, monkeypatch):
    from importlib import util

    find = util.find_spec
    monkeypatch.setattr(util, "find_spec", lambda name, *rest: None if name == "matplotlib" else find(name, *rest))
    run = write_run(tmp_path / "runs", rows=learning())
    assert cli("report", run.folder).code == 0
    page = read(run.folder / "report.html")
    assert '"rlcli[plot]"' in page.text
    assert "svg" not in page.tags
    assert "Sum of the squared deviations of joints from" in page.text


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["latest", "-o", "x.pdf"], 2, "the name must end in .html"),
        (["latest", "-o", "nowhere/x.html"], 10, "there is no folder"),
        (["nothing"], 5, "no run 'nothing'"),
        (["latest@best"], 5, "no complete checkpoint"),
        ([], 2, "Missing argument"),
    ],
)
def test_invalid_arguments_are_rejected(cli, tmp_path, arguments, code, message):
    run = write_run(tmp_path / "runs", rows=learning())
    result = cli("report", *arguments)
    assert (result.code, result.out) == (code, "")
    assert message in result.err
    assert cli("report", *arguments, "--json").json["error"]["exit_code"] == code
    assert not (run.folder / "report.html").exists()


@pytest.mark.parametrize("name", ["report.html", "videos"])
def test_symlink_in_untrusted_run_is_not_followed(cli, tmp_path, name):
    run = write_run(tmp_path / "runs", rows=learning())
    outside = tmp_path / "outside"
    outside.write_text("mine")
    (run.folder / name).symlink_to(outside)
    assert cli("report", run.folder, "--no-eval", "--no-video").code == 5
    assert outside.read_text() == "mine"


def test_evaluation_is_made_once_and_stored(cli, trained):
    result = cli("report", trained, "--no-video", "--json")
    assert (result.code, result.json["evaluation"], result.json["video"]) == (0, "made", None)
    page = read(trained / "report.html")
    assert "200 episodes of the deterministic policy" in page.text
    assert re.search(r"Success [\d.]+ % [\d.]+ to [\d.]+ %", page.text)
    assert "Video" not in page.text
    (kept,) = (trained / "evaluations").iterdir()
    document = json.loads(kept.read_text())
    assert document["episodes"] == 200
    again = cli("report", trained, "--no-video", "--json")
    assert again.json["evaluation"] == "stored"
    kept.write_text("{}")
    broken = cli("report", trained, "--no-video", "--json")
    assert broken.code == 0
    assert "is corrupt" in broken.json["missing"]["evaluation"]


def test_report_of_given_checkpoint_and_single_episode(cli, trained):
    assert cli("eval", "--checkpoint", f"{trained}@step:0", "--episodes", 1, "-q").code == 0
    result = cli("report", f"{trained}@step:0", "--no-video", "-o", "page.html", "--json")
    assert (result.code, result.json["evaluation"]) == (0, "stored")
    page = read("page.html")
    assert "Checkpoint step 0" in page.text
    assert "1 episode of the deterministic policy" in page.text
    assert "unknown" in page.text
    newest = cli("report", trained, "--no-video", "--no-eval", "--json")
    assert newest.json["evaluation"] is None
    assert newest.json["checkpoint"] != result.json["checkpoint"]


def test_no_eval_and_no_video_flags(cli, trained):
    result = cli("report", trained, "--no-eval", "--no-video", "-o", "page.html", "--json")
    assert (result.code, result.json["evaluation"], result.json["video"]) == (0, None, None)
    assert not (trained / "evaluations").exists()
    assert not (trained / "videos").exists()
    assert not (trained / "report.html").exists()
    assert "rlcli eval --checkpoint" in read("page.html").text


def test_page_contains_checkpoint_video(cli, trained):
    step = sorted((trained / "checkpoints").glob("0*"))[-1].name
    (trained / "videos").mkdir()
    (trained / "videos" / f"{step}.mp4").write_bytes(MP4)
    result = cli("report", trained, "--no-eval", "--json")
    assert result.json["video"] == "stored"
    page = read(trained / "report.html")
    require_harmless(page)
    assert ("src", f"data:video/mp4;base64,{base64.b64encode(MP4).decode()}") in page.attributes


@pytest.mark.parametrize("kind", ["text", "link", "large", "pipe"])
def test_invalid_video_is_not_in_page(cli, trained, tmp_path, kind, monkeypatch):
    step = sorted((trained / "checkpoints").glob("0*"))[-1].name
    (trained / "videos").mkdir()
    file = trained / "videos" / f"{step}.mp4"
    if kind == "text":
        file.write_text("<script>alert(1)</script>")
    elif kind == "link":
        (tmp_path / "secret").write_bytes(MP4)
        file.symlink_to(tmp_path / "secret")
    elif kind == "pipe":
        os.mkfifo(file)
    else:
        with file.open("wb") as handle:
            handle.write(MP4)
            handle.truncate(25 << 20)
    result = cli("report", trained, "--no-eval", "--json", "-o", "page.html")
    assert result.code == 0, result.err
    assert result.json["video"] is None
    assert "There is no video" in result.json["missing"]["video"]
    assert "video" not in read("page.html").tags


def test_page_without_renderer_reports_missing_video(cli, trained, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    result = cli("report", trained, "--json")
    assert result.code == 0, result.err
    assert "rendering is disabled by MUJOCO_GL=disable" in result.json["missing"]["video"]
    assert result.json["evaluation"] == "made"
    (trained / "videos").mkdir(exist_ok=True)
    (trained / "videos" / "000000000000.mp4").write_bytes(MP4)
    assert cli("report", trained, "--json").json["video"] == "older"
    assert "The newest checkpoint has no video" in read(trained / "report.html").text
