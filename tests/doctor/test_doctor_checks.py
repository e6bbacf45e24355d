"""Checks of `rlcli doctor` on planted faults: state, finding and hint."""

import json
import os

import pytest

from rlcli.doctor import compute_and_graphics
from rlcli.doctor.compute_and_graphics import (
    compute_checks,
    gpu_checks,
    graphics_check,
    run_isolated,
    shared_memory_check,
)
from rlcli.doctor.host_and_settings import harmful_variables, machine_checks, memory_check, settings_checks
from rlcli.doctor.installation import installation_checks, missing_requirement, violates_bounds
from rlcli.errors import install_hint, pip_install
from rlcli.machine.memory import memory_limit
from rlcli.settings import settings_file


def by_name(checks):
    return {check.name: check for check in checks}


@pytest.fixture
def package(tmp_path, monkeypatch):
    """package(name, version) adds metadata of a distribution that Python finds before all others."""
    site = tmp_path / "planted"
    site.mkdir()
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])]))

    def plant(name, version, *requirements):
        info = site / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        lines = [f"Requires-Dist: {requirement}" for requirement in requirements]
        (info / "METADATA").write_text(
            "\n".join(["Metadata-Version: 2.1", f"Name: {name}", f"Version: {version}", *lines, ""])
        )
        return site

    return plant


def test_equal_mujoco_packages_are_ok():
    check = by_name(installation_checks())["mujoco packages"]
    assert (check.state, check.hint) == ("ok", None)
    assert set(check.details) == {"mujoco", "mujoco-core", "mujoco-studio"}


def test_other_mujoco_core_version_is_reported(package):
    mine = by_name(installation_checks())["mujoco packages"].details["mujoco"]
    package("mujoco-core", "3.13.0")
    check = by_name(installation_checks())["mujoco packages"]
    assert check.state == "broken"
    assert f"mujoco {mine} needs mujoco-core {mine}, but mujoco-core 3.13.0 is installed" in check.found
    assert "mujoco-core is installed 2 times" in check.found
    assert check.hint == f"pip uninstall -y mujoco mujoco-core mujoco-studio && {pip_install(f'mujoco=={mine}')}"


def test_old_single_mujoco_package_is_reported(package):
    package("mujoco", "3.3.0", "numpy")
    check = by_name(installation_checks())["mujoco packages"]
    assert check.state == "broken"
    assert "mujoco is installed 2 times: 3.3.0 in" in check.found
    assert "mujoco 3.3.0 does not fit" in by_name(installation_checks())["packages"].found


def test_old_and_missing_packages_are_reported(package, monkeypatch):
    package("torch", "1.13.0")
    package("rlcli", "0.1.0", "torch>=2.10", "numpy>=2.0", "no-such-package>=1", 'onnx>=99; extra == "export"')
    check = by_name(installation_checks())["packages"]
    assert check.state == "broken"
    assert "torch 1.13.0 does not fit, >=2.10 is needed" in check.found
    assert "no-such-package is missing" in check.found
    assert "onnx" in check.found
    assert "numpy" not in check.found


def test_states_of_extras(package):
    package(
        "rlcli", "0.1.0", 'numpy>=2; extra == "one"', 'no-such-package; extra == "two"', 'numpy; extra == "three"',
        'no-such-package; extra == "three"', 'rlcli[one]; extra == "all"', 'no-such-package; extra == "dev"',
    )  # fmt: skip
    found = by_name(installation_checks())
    assert {name for name in found if name.startswith("extra ")} == {"extra one", "extra two", "extra three"}
    assert (found["extra one"].state, found["extra one"].hint) == ("ok", None)
    assert (found["extra two"].state, found["extra two"].hint) == ("absent", pip_install("rlcli[two]"))
    assert (found["extra three"].state, found["extra three"].hint) == ("warning", pip_install("rlcli[three]"))
    assert "missing: no-such-package" in found["extra three"].found


@pytest.mark.parametrize(
    ("wanted", "found", "bad"),
    [
        (">=2.10", "2.9.2", True),
        (">=2.10", "2.13.0+cpu", False),
        ("==4.0.0", "4.0", False),
        ("==4.0.*", "4.0.7", False),
        ("==4.0.*", "4.1", True),
        (">=1.0,<2", "2.0", True),
        ("!=1.5", "1.5", True),
        ("", "1", False),
        ("~=1.0", "7", False),
    ],
)
def test_violates_bounds(wanted, found, bad):
    assert violates_bounds(wanted, found) == bad


def test_mujoco_library_and_package_versions_differ():
    answer = {"torch": "2", "cuda": None, "threads": 2, "mujoco": "3.3.0", "mujoco_package": "4.0.0", "cores": [8, 8]}
    check = by_name(compute_checks(answer, ""))["mujoco"]
    assert (check.state, check.hint) == ("broken", compute_and_graphics.REINSTALL)
    assert "4.0.0" in check.found
    assert "3.3.0" in check.found


@pytest.mark.parametrize(
    ("reason", "hint"),
    [
        ("ModuleNotFoundError: No module named 'mujoco._structs'", compute_and_graphics.REINSTALL),
        ("OSError: libtorch_cpu.so: no such file", pip_install("--force-reinstall torch")),
        ("no answer within 30 s", compute_and_graphics.BUSY),
    ],
)
def test_failed_compute_check_has_matching_hint(reason, hint):
    (check,) = compute_checks(None, reason)
    assert (check.state, check.hint) == ("broken", hint)


def test_hint_for_a_missing_requirement_installs_it(package):
    package("rlcli", "0.1.0", "no-such-tensors>=1", "torch>=2", 'no-such-extra; extra == "plot"')
    reason = "ModuleNotFoundError: No module named 'no_such_tensors.nn'"
    assert missing_requirement(f"cannot be imported: {reason} (file.py:3)") == "no-such-tensors"
    (check,) = compute_checks(None, reason)
    assert check.hint == pip_install("no-such-tensors")
    assert by_name(installation_checks())["packages"].found == "no-such-tensors is missing"
    for other in ("torch", "no_such_extra", "foreign_package"):
        assert missing_requirement(f"ModuleNotFoundError: No module named '{other}'") is None


def test_hint_for_torch_names_the_index_of_the_cpu_build():
    assert install_hint("torch").startswith(f"{pip_install('torch')}; on Linux without a GPU, add --index-url https://")
    assert install_hint("safetensors") == pip_install("safetensors")


@pytest.mark.slow
def test_openmp_pinning_is_detected(monkeypatch):
    cores = len(os.sched_getaffinity(0))
    if cores < 2:
        pytest.skip("pinning cannot be seen on one core")
    monkeypatch.setenv("OMP_PROC_BIND", "true")
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    check = by_name(compute_checks(*run_isolated("compute", 120.0)))["pinning"]
    assert (check.state, check.hint) == ("warning", "unset OMP_PROC_BIND")
    assert f"1 of {cores} cores" in check.found


@pytest.mark.slow
def test_crashing_graphics_library_is_isolated(tmp_path, monkeypatch):
    (tmp_path / "OpenGL").mkdir()
    (tmp_path / "OpenGL" / "__init__.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    assert run_isolated("egl", 120.0) == (None, "crashed (SIGSEGV)")


def test_hanging_library_times_out(tmp_path, monkeypatch):
    (tmp_path / "mujoco").mkdir()
    (tmp_path / "mujoco" / "__init__.py").write_text("import time\ntime.sleep(600)\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    assert run_isolated("egl", 2.0) == (None, "no answer within 2 s")


@pytest.mark.parametrize(
    ("chosen", "works", "state", "used"),
    [
        (None, ("egl", "osmesa"), "ok", "egl"),
        (None, ("osmesa",), "ok", "osmesa"),
        (None, (), "warning", None),
        ("osmesa", ("egl", "osmesa"), "ok", "osmesa"),
        ("osmesa", ("egl",), "broken", None),
        ("nonsense", ("egl",), "broken", None),
        ("disable", ("egl",), "ok", None),
    ],
)
def test_graphics_check_states(monkeypatch, chosen, works, state, used):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    if chosen is not None:
        monkeypatch.setenv("MUJOCO_GL", chosen)
    check = graphics_check({name: ({}, "") if name in works else (None, "why") for name in ("egl", "osmesa", "glfw")})
    assert (check.state, check.details["used"]) == (state, used)
    assert check.details["drawn"] == {name: name in works for name in ("egl", "osmesa", "glfw")}
    if state == "broken":
        assert (check.hint, f"MUJOCO_GL={chosen}" in check.found) == ("unset MUJOCO_GL", True)


GPU = {"torch_cuda": "12.8", "torch_error": "", "devices": ["H200"], "driver_cuda": "12.9"}
WARP = {"version": "1.19.0", "devices": ["H200"], "error": ""}


@pytest.mark.parametrize(
    ("change", "state", "said", "hint"),
    [
        ({}, "ok", "H200; driver CUDA 12.9, torch CUDA 12.8", None),
        ({"torch_cuda": None, "devices": []}, "warning", "torch is built for the CPU", "https://pytorch.org"),
        (
            {"torch_cuda": "13.0"},
            "warning",
            "torch is built for CUDA 13.0, the driver supports CUDA 12.9",
            "update the driver",
        ),
        ({"devices": []}, "warning", "torch finds no device", "nvidia-smi"),
        (
            {"torch_error": ": no kernel image"},
            "warning",
            "cannot compute on this GPU: no kernel image",
            "built for this GPU",
        ),
        ({"warp": None}, "warning", "warp-lang is not installed", pip_install("rlcli[gpu]")),
        ({"warp": {**WARP, "devices": []}}, "warning", "Warp 1.19.0 finds no GPU", "warp-lang"),
        ({"warp": {**WARP, "error": "E: x"}}, "warning", "finds no GPU: E: x", "warp-lang"),
    ],
)
def test_gpu_checks_compare_driver_torch_and_warp(monkeypatch, change, state, said, hint):
    monkeypatch.setattr(compute_and_graphics, "version", lambda _: "4.0.0")
    check = gpu_checks(({**GPU, "warp": WARP, **change}, ""))[0]
    assert (check.state, said in check.found) == (state, True), check.found
    assert hint is None or hint in check.hint


def test_gpu_checks_without_driver_and_with_crash():
    assert gpu_checks(None)[0].state == "ok"
    check = gpu_checks((None, "crashed (SIGSEGV)"))[0]
    assert (check.state, "SIGSEGV" in check.found) == ("warning", True)


def test_low_memory_gives_warnings():
    assert memory_check(8 << 30, None).state == "ok"
    assert memory_check(8 << 30, 16 << 30).state == "ok"
    limited = memory_check(8 << 30, 512 << 20)
    assert (limited.state, "container" in limited.hint) == ("warning", True)
    assert memory_check(300 << 20, None).state == "warning"
    assert shared_memory_check(64 << 20).hint == "in a container: docker run --shm-size=8g"
    assert shared_memory_check(8 << 30).state == "ok"


@pytest.mark.parametrize(
    ("own", "files", "limit"),
    [
        ("0::/a/b\n", {"a/memory.max": "2000\n", "a/b/memory.max": "max\n"}, 2000),
        ("4:memory:/x\n3:cpu:/x\n", {"memory/x/memory.limit_in_bytes": "3000\n"}, 3000),
        ("4:memory:/\n", {"memory/memory.limit_in_bytes": "9223372036854771712\n"}, None),
        ("nonsense", {}, None),
    ],
)
def test_memory_limit_is_smallest_of_parent_groups(tmp_path, own, files, limit):
    (tmp_path / "own").write_text(own)
    for name, text in files.items():
        file = tmp_path / "groups" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    assert memory_limit(tmp_path / "groups", tmp_path / "own") == limit


@pytest.mark.parametrize(
    ("given", "bad"),
    [
        ({"OMP_NUM_THREADS": "64"}, {"OMP_NUM_THREADS"}),
        ({"OMP_NUM_THREADS": "4", "MKL_NUM_THREADS": "many"}, set()),
        ({"OMP_THREAD_LIMIT": "1"}, {"OMP_THREAD_LIMIT"}),
        ({"OMP_WAIT_POLICY": "ACTIVE", "KMP_BLOCKTIME": "infinite"}, {"OMP_WAIT_POLICY", "KMP_BLOCKTIME"}),
        ({"LOCAL_WORLD_SIZE": "8"}, {"LOCAL_WORLD_SIZE"}),
        ({"LOCAL_WORLD_SIZE": "1", "DISPLAY": ":0"}, set()),
    ],
)
def test_harmful_variables(given, bad):
    assert set(harmful_variables(given, 4)) == bad


def test_settings_checks_show_file_or_mistakes(monkeypatch, tmp_path):
    file = tmp_path / "settings.yaml"
    monkeypatch.setenv("RLCLI_SETTINGS", str(file))
    file.write_text("viewer: web\n")
    check = by_name(settings_checks())["settings"]
    assert (check.state, check.found) == ("ok", f"{file}: viewer: web")
    file.write_text("viewer: wbe\n")
    check = by_name(settings_checks())["settings"]
    assert check.state == "broken"
    assert f"{file}:1:1: viewer: expected" in check.found
    assert f"edit {settings_file()}" in check.hint
    monkeypatch.setenv("RLCLI_SETTINGS", "none")
    assert by_name(settings_checks())["settings"].state == "ok"
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    assert by_name(settings_checks())["variables"].hint == "unset OMP_WAIT_POLICY"


def test_runs_folder_that_is_file_is_broken(tmp_path):
    (tmp_path / "file").write_text("")
    check = by_name(machine_checks(tmp_path / "file" / "runs"))["runs folder"]
    assert check.state == "broken"
    assert "RLCLI_RUNS_DIR" in check.hint
    assert by_name(machine_checks(tmp_path / "new" / "runs"))["runs folder"].state == "ok"
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_doctor_reports_many_faults_and_exits_with_9(package, cli, tmp_path):
    site = package("mujoco-core", "3.13.0")
    (site / "OpenGL").mkdir()
    (site / "OpenGL" / "__init__.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    (tmp_path / "file").write_text("")
    (tmp_path / "mine.yaml").write_text("viewer: wbe\n")
    faults = {
        "RLCLI_RUNS_DIR": str(tmp_path / "file" / "runs"),
        "RLCLI_SETTINGS": str(tmp_path / "mine.yaml"),
        "MUJOCO_GL": "nonsense",
        "OMP_WAIT_POLICY": "active",
    }
    done = cli("doctor", "--json", "--probe-timeout", "100", **faults)
    assert done.returncode == 9, done.stderr
    assert "Traceback" not in done.stderr
    document = json.loads(done.stdout)
    assert (document["schema"], document["healthy"], document["all_good"]) == (1, False, False)
    found = {check["name"]: check for check in document["checks"]}
    assert {n for n, c in found.items() if c["state"] == "broken"} == {
        "mujoco packages", "runs folder", "settings", "graphics", "task cartpole-camera",
    }  # fmt: skip
    assert found["variables"]["state"] == "warning"
    assert "mujoco-core 3.13.0" in found["mujoco packages"]["found"]
    assert "egl cannot (crashed (SIGSEGV))" in found["graphics"]["found"]
    assert found["graphics"]["hint"] == "unset MUJOCO_GL"
    assert found["mujoco"]["state"] == "ok"
    assert all(check["hint"] for check in found.values() if check["state"] != "ok")
