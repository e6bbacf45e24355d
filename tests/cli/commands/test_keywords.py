"""The words `latest` and `shipped` of a command line never name a folder of the current folder."""

import shutil

import pytest
from support.written_runs import write_run

KEYWORDS = ("latest", "shipped")


@pytest.mark.parametrize("word", KEYWORDS)
@pytest.mark.parametrize(
    "words",
    [
        ("play", "WORD", "--policy", "zero", "--viewer", "none"),
        ("eval", "WORD", "--policy", "zero"),
        ("train", "WORD"),
        ("validate", "WORD", "--deep"),
        ("check", "WORD"),
        ("show", "WORD"),
        ("export", "WORD"),
        ("diff", "WORD", "cartpole"),
        ("reproduce", "WORD"),
        ("stress", "WORD", "--sweep", "body_mass=1,2"),
        ("eval", "--checkpoint", "WORD"),
        ("export", "--checkpoint", "WORD@best"),
        ("train", "--resume", "WORD"),
        ("report", "WORD"),
        ("autopsy", "WORD"),
    ],
    ids=" ".join,
)
def test_folder_with_the_name_of_a_keyword_is_never_meant(words, word, coin, cli, tmp_path, monkeypatch):
    """Without a run, `latest` is an error, also where a folder of this name has a task, a run or a bundle."""
    here = tmp_path / "here"
    for name in (word, f"{word}@best"):
        shutil.copytree(tmp_path / "coin", here / name)
        (here / name / "terms.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'w')\n")
        (here / name / "manifest.json").write_text('{"format": 1, "bundle": {}}')
    monkeypatch.chdir(here)
    result = cli(*(each.replace("WORD", word) for each in words))
    assert result.code in (2, 4, 5), result.out
    assert "no " in result.err or "needs a task" in result.err
    assert "manifest" not in result.err
    assert not (tmp_path / "executed").exists()


def test_folder_with_the_name_of_a_keyword_is_named_with_a_slash(coin, cli, tmp_path, monkeypatch):
    shutil.copytree(tmp_path / "coin", tmp_path / "here" / "latest")
    monkeypatch.chdir(tmp_path / "here")
    assert "write ./latest for the folder" in cli("validate", "latest").err
    assert cli("validate", "./latest").code == 0


def test_diff_of_latest_compares_the_newest_run(coin, cli, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed in (1, 2):
        write_run(tmp_path / "runs", seed=seed, started=f"2026-01-0{seed}T00:00:00+00:00")
    shutil.copytree(tmp_path / "coin", tmp_path / "latest")
    runs = sorted((tmp_path / "runs" / "cartpole").iterdir())
    assert cli("diff", "latest", runs[1], "--only", "configuration").code == 0
