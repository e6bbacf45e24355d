"""Record of software, sources and hardware in run.json."""

import mujoco
import pytest
from support.worlds import CRITTER, CRITTER_TASK, critter

import rlcli.runs.provenance as environment
from rlcli.config.load import resolve
from rlcli.registry import find_task

CUBE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def task(tmp_path):
    """A task with a custom term, an included file, and a mesh in a separate folder."""
    model = CRITTER.replace("<worldbody>", '<include file="more.xml"/><worldbody>', 1)
    folder = critter(tmp_path, CRITTER_TASK, terms_py='"""Terms."""\n')
    (folder / "critter.xml").write_text(model)
    asset = '<mujoco><compiler meshdir="parts"/><asset><mesh name="cube" file="cube.obj"/></asset></mujoco>'
    (folder / "more.xml").write_text(asset)
    (folder / "parts").mkdir()
    (folder / "parts" / "cube.obj").write_text(CUBE)
    (folder / "notes.txt").write_text("of no consequence")
    return folder


def sources(folder):
    return environment.sources(resolve(find_task(str(folder))))


def test_sources_lists_code_models_and_their_assets(task):
    assert set(sources(task)) == {"rlcli", "terms.py", "critter.xml", "more.xml", "parts/cube.obj"}


@pytest.mark.parametrize("file", ["terms.py", "critter.xml", "more.xml", "parts/cube.obj"])
def test_sources_changes_only_the_hash_of_a_changed_file(task, file):
    before = sources(task)
    with (task / file).open("a") as handle:
        handle.write("\n")
    after = sources(task)
    assert [name for name in before if before[name] != after[name]] == [file]


def test_sources_accepts_missing_files_and_circular_includes(task):
    (task / "more.xml").write_text('<mujoco><include file="more.xml"/><include file="nowhere.xml"/></mujoco>')
    assert set(sources(task)) == {"rlcli", "terms.py", "critter.xml", "more.xml"}


def test_only_kernel_variables_are_recorded(task, monkeypatch):
    monkeypatch.setenv("MKL_CBWR", "AVX2")
    monkeypatch.setenv("A_SECRET", "hunter2")
    record = environment.environment_record(resolve(find_task(str(task))), 2, 1)
    assert record["variables"]["MKL_CBWR"] == "AVX2"
    assert "hunter2" not in str(record)
    assert set(record["variables"]) <= set(environment.VARIABLES)


@pytest.mark.parametrize(
    ("text", "model", "kernels"),
    [
        ("model name\t: A\nflags\t\t: fpu avx2 fma\n\nmodel name\t: B\nflags\t\t: sse4_1\n", "A", "avx2 fma"),
        ("processor\t: 0\nFeatures\t: fp asimd sve\n\n", None, "asimd sve"),
        ("", None, ""),
    ],
)  # fmt: skip
def test_processor_is_read_from_the_first_core(tmp_path, text, model, kernels):
    file = tmp_path / "cpuinfo"
    file.write_text(text)
    record = environment.processor(file)
    assert record["kernels"] == kernels
    assert record["model"] if model is None else record["model"] == model
    assert ("flags" in record) == bool(kernels)


def test_model_digest_ignores_names_and_visual_settings():
    def digest(text):
        return environment.model_digest(mujoco.MjModel.from_xml_string(text))

    assert digest(CRITTER) == digest(CRITTER)
    assert digest(CRITTER) != digest(
        CRITTER.replace('damping="0.2"', 'damping="0.20000000000000001"').replace("3", "4")
    )
    assert digest(CRITTER) != digest(CRITTER.replace("<worldbody>", '<option timestep="0.0021"/><worldbody>', 1))
    assert digest(CRITTER) != digest(CRITTER.replace("<worldbody>", '<option integrator="RK4"/><worldbody>', 1))
    drawn = CRITTER.replace("<worldbody>", '<visual><rgba haze="1 0 0 1"/></visual><worldbody>', 1)
    assert digest(CRITTER) == digest(drawn), "what is only looked at"


def test_differences_compares_common_entries_by_name():
    was = {"rlcli": "1", "versions": {"torch": "2", "mujoco": "4"}, "pid": 1, "libc": "a", "device": "cpu"}
    now = {"rlcli": "1", "versions": {"torch": "3", "mujoco": "4", "more": "1"}, "pid": 2, "device": "cuda"}
    assert environment.differences(was, now) == [
        ("versions.torch", "2", "3"), ("versions.more", None, "1"), ("device", "cpu", "cuda"),
    ]  # fmt: skip
    assert environment.differences({"versions": "torn", "cpu": None}, {"versions": {"torch": "3"}, "cpu": []})


@pytest.mark.parametrize("agent", ["rsl-rl", "sb3-ppo"])
def test_versions_include_requirements_of_the_trainer(agent):
    versions = environment.versions(resolve(find_task("cartpole"), agent=agent))
    assert {"torch", "mujoco", "numpy"} <= set(versions)
    assert ({"rlcli-rsl-rl", "rsl-rl-lib"} <= set(versions)) == (agent == "rsl-rl")
