"""Pages of the benchmarks: their figures equal the stored results."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
sys.path.insert(0, str(REPOSITORY / "benchmarks"))

import against_envpool  # noqa: E402
import against_mjlab  # noqa: E402
import against_trainers  # noqa: E402
import bench  # noqa: E402
import tables  # noqa: E402

PAGE, README = tables.PAGES


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_generated_parts_match_results(page):
    text = page.read_text()
    assert text == tables.filled(text, bench.texts(tables.results())), "python benchmarks/bench.py --pages"


def test_tables_and_placeholders_match():
    assert sorted(tables.marked(PAGE.read_text())) == sorted(bench.TABLES)
    assert tables.marked(README.read_text()) == ["readme"]


def test_readme_figures_match_pages():
    text, page = README.read_text(), PAGE.read_text()
    begin, end = text.index("<!-- bench: readme -->"), text.index("## Install")
    figures = re.findall(r"\d+\.\d+", re.sub(r"\]\([^)]*\)", "", text[begin:end]))
    assert figures
    assert [figure for figure in figures if figure not in page] == []


def test_replace_part_keeps_indentation():
    text = "# Page\n- a\n  <!-- bench: one -->\n  old\n  <!-- end bench -->\n<!-- bench: two -->\n<!-- end bench -->\n"
    new = tables.filled(text, {"one": "first\n\n| a |"})
    assert new == text.replace("  old\n", "  first\n\n  | a |\n")
    assert tables.filled(new, {"one": "first\n\n| a |"}) == new


def test_save_keeps_other_results(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "RESULTS", tmp_path / "results.json")
    tables.keep("one", {"machine": "M", "ratio": 0.123456789})
    tables.keep("two", {"machine": "M"})
    assert tables.results() == {"one": {"machine": "M", "ratio": 0.12346}, "two": {"machine": "M"}}


TIMES = {"ratio": 9.87, "ratio_min": 9.0, "ratio_max": 11.0}


def test_failed_peer_is_row_with_reason():
    column = {**TIMES, "limit": 2.5, "ours": 2e6, "envpool": 1e5, "steps": 4}
    rows = [
        {"task": "gym-ant", "64": column, "1024": column, "mujoco": TIMES},
        {"task": "gym-hopper", "failed": "the models differ in body_mass"},
    ]
    means = {"64": 9.87, "1024": 9.87, "mujoco": 9.87}
    result = {"machine": "M", "envpool": "EnvPool 1", "rows": rows, "means": means, "limits": means}
    text = against_envpool.markdown(result)
    assert "| `gym-ant` * | **9.87** | 9.00 .. 11.00 | 2.50 | 2 M | 100,000 |" in text
    assert "the models differ in body_mass" in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines}) == 1

    rows = [{"name": "dummy", "num_envs": 8, "steps_per_s": 1e4, "times": {"ppo": TIMES, "sb3-ppo": TIMES}}]
    result = {"machine": "M", "versions": {}, "rows": rows, "scans": {"dummy": {"8": 1e4}}, "memory_mb": {}}
    text = against_trainers.markdown({**result, "failed": {"skrl": "skrl ended: out of memory"}})
    assert "| SB3, `DummyVecEnv` | 8 | 10,000 | **9.9** (9.00 .. 11.00)" in text
    assert "| skrl | failed: skrl ended: out of memory |" in text

    text = against_mjlab.markdown({"machine": "M", "failed": "not installed: no wheel"})
    assert "mjlab: not installed: no wheel" in text


def test_unknown_table_error_lists_valid_names():
    program = [sys.executable, str(REPOSITORY / "benchmarks" / "bench.py"), "envpol"]
    done = subprocess.run(program, capture_output=True, text=True)
    assert done.returncode == 2
    assert "no table envpol; there are env_step, train, mjlab" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", ["env_step", "train", "growth"])
def test_tables_without_peers_can_be_measured(name):
    before = tables.RESULTS.read_text()
    assert bench.run(name, quick=True)
    assert tables.RESULTS.read_text() == before
    json.loads(before)
