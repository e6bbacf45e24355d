"""`rlcli doctor` on this machine, and with broken plugins and settings."""

import json

import pytest
from support.broken_plugins import BROKEN, FILES, SPEC

from rlcli.machine.control_groups import core_quota
from rlcli.machine.cores import available_cores


def checks(done):
    document = json.loads(done.stdout)
    assert "Traceback" not in done.stderr
    assert document["healthy"] == (done.returncode == 0)
    return {check["name"]: check for check in document["checks"]}


@pytest.mark.slow
def test_sound_installation_is_healthy(plugins, cli):
    plugins("good", SPEC, files=FILES)
    done = cli("doctor", "--json", "--probe-timeout", "100", MUJOCO_GL="", RLCLI_PLUGINS="good, nmae")
    found = checks(done)
    assert done.returncode == 0, done.stdout
    assert {"python", "rlcli", "packages", "cores", "runs folder", "torch", "mujoco", "gpu", "graphics"} <= set(found)
    assert {"task cartpole", "task good-task", "trainer sb3", "trainer ppo"} <= set(found)
    assert found["cores"]["details"]["available"] >= 1
    assert found["packages"]["details"]["versions"]["torch"] in found["torch"]["found"]
    drawn = found["graphics"]["details"]
    assert set(drawn["drawn"]) == {"egl", "osmesa", "glfw"}
    assert drawn["used"] in (None, *(name for name, draws in drawn["drawn"].items() if draws))
    assert found["mujoco packages"]["state"] == "ok"
    assert (found["variables"]["state"], "nmae" in found["variables"]["found"]) == ("warning", True)


@pytest.mark.slow
def test_broken_plugins_are_reported_with_reason(broken_plugins, plugins, cli):
    names = ["crashes", "exits-with-0", "hangs", "leaves-a-process", "points-malformed", "foreign-points-malformed"]
    broken_plugins(*names, "takes-a-built-in-name", "shares-a-name")
    trainer = "from rlcli.trainers import TrainerSpec\nSPEC = TrainerSpec('mine', {'a': 'mine:Gone'}, 'mine:Gone')\n"
    plugins("mine", trainer, entry_points="[rlcli.trainers]\nmine = mine:SPEC\n")
    done = cli("doctor", "--json", "--probe-timeout", "15")
    found = checks(done)
    assert done.returncode == 9
    for name, state in (("crashes", "broken"), ("exits-with-0", "broken"), ("hangs", "warning")):
        row = found[f"task {name}-task"]
        assert (row["state"], BROKEN[name].said in row["found"]) == (state, True)
    assert "slow: did not load within 15 s" in found["task hangs-task"]["found"]
    assert found["task hangs-task"]["hint"].startswith("if the machine is busy: `rlcli doctor --probe-timeout 120`")
    assert found["trainer mine"]["state"] == "broken"
    assert "no attribute 'Gone'" in found["trainer mine"]["found"]
    for name in ("points-malformed", "foreign-points-malformed"):
        assert found[f"metadata of {name.replace('-', '_')}-1.0.dist-info"]["state"] == "broken"
    for name in ("torch", "mujoco", "task good-task", "task leaves-a-process-task", "task shared-task", "trainer sb3"):
        assert found[name]["state"] == "ok", found[name]
    text = cli("doctor", RLCLI_PLUGINS="good")
    assert text.returncode == 9  # the malformed metadata is there all the same
    assert "metadata of points_malformed-1.0.dist-info" in text.stdout


@pytest.mark.slow
def test_bad_runs_folder_and_graphics_are_broken(cli, tmp_path):
    (tmp_path / "file").write_text("")
    done = cli("doctor", "--json", RLCLI_RUNS_DIR=str(tmp_path / "file" / "runs"), MUJOCO_GL="glfw", DISPLAY="")
    found = checks(done)
    assert done.returncode == 9
    assert {name for name, check in found.items() if check["state"] == "broken"} == {"runs folder", "graphics"}
    assert "is not writable" in found["runs folder"]["found"]
    assert not list(tmp_path.rglob("runs"))


@pytest.mark.parametrize(
    ("own", "files", "quota"),
    [
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 1.5),
        ("0::/\n", {"cpu.max": "max 100000\n"}, None),
        ("0::/a/b\n", {"a/cpu.max": "200000 100000\n", "a/b/cpu.max": "max 100000\n", "cpu.max": "x"}, 2.0),
        ("0::/a/b\n", {"a/cpu.max": "200000 100000\n", "a/b/cpu.max": "100000 100000\n"}, 1.0),
        (
            "4:memory:/x\n3:cpu,cpuacct:/x\n",
            {"cpu,cpuacct/x/cpu.cfs_quota_us": "50000\n", "cpu,cpuacct/x/cpu.cfs_period_us": "100000\n"},
            0.5,
        ),
        (
            "3:cpu,cpuacct:/x\n",
            {"cpu,cpuacct/x/cpu.cfs_quota_us": "-1\n", "cpu,cpuacct/x/cpu.cfs_period_us": "100000\n"},
            None,
        ),
        (
            "3:cpuacct,cpu:/x\n",
            {"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"},
            3.0,
        ),
        ("nonsense\n", {}, None),
    ],
)
def test_core_quota_is_smallest_of_parent_groups(tmp_path, own, files, quota):
    (tmp_path / "own").write_text(own)
    for name, text in files.items():
        file = tmp_path / "groups" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    assert core_quota(tmp_path / "groups", tmp_path / "own") == quota


def test_core_quota_without_control_groups(tmp_path):
    assert core_quota(tmp_path / "none", tmp_path / "none") is None


@pytest.mark.parametrize(("granted", "cores"), [("50000", 1), ("100000", 1), ("190000", 1), ("100000000000", None)])
def test_available_cores_round_quota_down(tmp_path, monkeypatch, granted, cores):
    monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    (tmp_path / "own").write_text("0::/\n")
    (tmp_path / "cpu.max").write_text(f"{granted} 100000\n")
    unlimited = available_cores(tmp_path, tmp_path / "none")
    assert available_cores(tmp_path, tmp_path / "own") == (cores or unlimited)


def test_available_cores_are_divided_by_local_world_size(tmp_path, monkeypatch):
    have = available_cores(tmp_path, tmp_path / "none")
    (tmp_path / "own").write_text("0::/\n")
    (tmp_path / "cpu.max").write_text(f"{have}00000 100000\n")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert available_cores(tmp_path, tmp_path / "own") == max(1, have // 2)
