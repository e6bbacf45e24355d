"""Reading of checkpoints, and a specific error for each kind of damage."""

import json
import shutil

import pytest
import safetensors.torch
import torch
from support.saved_states import SPEC, rehash, state_of

from rlcli.config.load import resolve
from rlcli.errors import CheckpointError, ConfigError
from rlcli.registry import find_task
from rlcli.rl.policy import blank_policy
from rlcli.rl.trainer import Rows
from rlcli.runs import checkpoint_reader
from rlcli.training.checkpoint_writer import CheckpointWriter, KeepRule

DIGEST = "0" * 64


def rows(total):
    return Rows(
        max(0, total - 10), total, lambda a, b: {"x": torch.arange(a, b).float()[:, None], "y": torch.ones(b - a)}
    )


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Two checkpoints with a log of rows in files of 6, 12 and 18."""
    folder = tmp_path_factory.mktemp("run") / "checkpoints"
    folder.mkdir()
    saver = CheckpointWriter(folder, KeepRule(), {"seed": 7})
    for iteration in (1, 2, 3):
        state = state_of()
        state.values |= {"env_steps": 100 * iteration, "learning_rate": 3e-4}
        state.values["statistics.episodes"] = {"recent": [[5, 1.0, 0.5, 1.0]], "total": 3}
        state.tensors["trainer"]["observations"] = torch.zeros(2, 3)
        state.logs["replay"] = rows(6 * iteration)
        saver.save(state, iteration, 100 * iteration)
    saver.wait()
    return folder


@pytest.fixture
def folder(good, tmp_path):
    shutil.copytree(good, tmp_path / "checkpoints")
    return tmp_path / "checkpoints" / f"{300:012d}"


def test_valid_checkpoint_is_read_completely(folder):
    opened = checkpoint_reader.open_checkpoint(folder)
    assert (opened.step, opened.iteration, opened.manifest["seed"]) == (300, 3, 7)
    state = opened.state()
    assert set(state.tensors) == {"policy", "trainer", "env", "rng"}
    log = state.logs["replay"]
    assert (log.first, log.stop) == (8, 18)
    for start, stop in ((8, 18), (8, 9), (11, 13), (12, 18), (17, 18)):
        assert log.read(start, stop)["x"].flatten().tolist() == [float(r) for r in range(start, stop)]
    assert [(s.start, s.stop) for s in opened.shards()["replay"]] == [(6, 12), (12, 18)]
    opened.verify(whole=True)


def test_tensors_refuses_a_part_above_its_limit(folder):
    opened = checkpoint_reader.open_checkpoint(folder)
    size = (folder / "env.safetensors").stat().st_size
    assert set(opened.tensors("env", size)) == {"x"}
    with pytest.raises(CheckpointError, match=r"env\.safetensors is too large"):
        opened.tensors("env", size - 1)
    with pytest.raises(CheckpointError, match=r"has no own\.safetensors"):
        opened.tensors("own")


def test_tensors_refuses_a_part_larger_than_memory(folder, monkeypatch):
    monkeypatch.setattr(checkpoint_reader, "available_memory", lambda: 90)
    with pytest.raises(CheckpointError, match=r"env\.safetensors is too large: .* at most 30 are read"):
        checkpoint_reader.open_checkpoint(folder).tensors("env")


def test_numbered_part_has_the_limit_of_its_kind(folder, monkeypatch):
    shutil.copy(folder / "env.safetensors", folder / "env.1.safetensors")
    edit_manifest(lambda m: m["files"].update({"env.1.safetensors": m["files"]["env.safetensors"]}))(folder)
    monkeypatch.setitem(checkpoint_reader._LIMITS, "env", 20)
    for part in ("env", "env.1"):
        with pytest.raises(CheckpointError, match=rf"{part}\.safetensors is too large: .* at most 20 are read"):
            checkpoint_reader.open_checkpoint(folder).tensors(part)


def edit_manifest(change):
    def damage(folder):
        document = json.loads((folder / "manifest.json").read_text())
        change(document)
        (folder / "manifest.json").write_text(json.dumps(document))

    return damage


def entry(**changes):
    return edit_manifest(lambda m: m["files"]["env.safetensors"].update(changes))


def log(**changes):
    return edit_manifest(lambda m: m["logs"]["replay"].update(changes))


def shard(number=0, **changes):
    return edit_manifest(lambda m: m["logs"]["replay"]["shards"][number].update(changes))


def values(**changes):
    def damage(folder):
        document = json.loads((folder / "state.json").read_text())
        (folder / "state.json").write_text(json.dumps(document | changes))
        rehash(folder, "state.json")

    return damage


def tensor(part, name, value):
    def damage(folder):
        file = folder / f"{part}.safetensors"
        tensors = safetensors.torch.load(file.read_bytes())
        file.write_bytes(safetensors.torch.save(tensors | {name: value}))
        rehash(folder, file.name)

    return damage


def content(data):
    def damage(folder):
        (folder / "env.safetensors").write_bytes(data)
        rehash(folder, "env.safetensors")

    return damage


def header(text):
    return content(len(text).to_bytes(8, "little") + text)


def listed(name):
    return edit_manifest(lambda m: m["files"].update({name: {"size": 1, "sha256": DIGEST}}))


def extra_files(total):
    def change(document):
        for number in range(total - len(document["files"])):
            document["files"][f"more{number}.json"] = {"size": 1, "sha256": DIGEST}

    return edit_manifest(change)


def statistics(**changes):
    return values(**{"statistics.episodes": {"recent": [[5, 1.0, 0.5, 1.0]], "total": 3} | changes})


MANIFEST = "manifest.json is corrupt: "
ENTRY = f'{MANIFEST}files."env.safetensors".'
LOG = f"{MANIFEST}logs.replay"
STATE = "state.json is corrupt: "
STATISTICS = f"{STATE}statistics.episodes."
HEADER = "env.safetensors is corrupt: x"
SHAPE = f"{HEADER}.shape"


@pytest.mark.parametrize(
    ("damage", "output"),
    [
        (edit_manifest(lambda m: m.pop("files")), MANIFEST + "missing key 'files'"),
        (edit_manifest(lambda m: m["files"].update(x=3)), MANIFEST + "files.x: expected"),
        (entry(size=-1), ENTRY + "size: expected a whole number >= 0, found -1"),
        (entry(size=True), ENTRY + "size: expected a whole number, found true"),
        (entry(size=2**62), ENTRY + "size: expected a whole number < "),
        (entry(sha256=5), ENTRY + "sha256: expected text, found 5"),
        (entry(sha256="0" * 65), ENTRY + "sha256: expected text of at most 64 characters"),
        (listed("../x.json"), "../x.json\": expected text like"),
        (listed("X.json"), 'files."X.json": expected text like'),
        (edit_manifest(lambda m: m.update(format=2)), "has checkpoint format 2; this rlcli reads 1"),
        (edit_manifest(lambda m: m.update(format=True)), "has checkpoint format True"),
        (edit_manifest(lambda m: m.pop("format")), "has checkpoint format None"),
        (edit_manifest(lambda m: m.pop("step")), MANIFEST + "missing key 'step'"),
        (edit_manifest(lambda m: m.update(step=-1)), MANIFEST + "step: expected a whole number >= 0, found -1"),
        (edit_manifest(lambda m: m.update(step=2**62)), MANIFEST + "step: expected a whole number < "),
        (edit_manifest(lambda m: m.update(step=200)), "has step 200, but its folder is named 000000000300"),
        (edit_manifest(lambda m: m["files"].pop("rng.safetensors")), "has no rng.safetensors"),
        (edit_manifest(lambda m: m["files"].pop("state.json")), "has no state.json"),
        (edit_manifest(lambda m: m.update(logs=[])), MANIFEST + "logs: expected a mapping, found []"),
        (edit_manifest(lambda m: m.update(logs={"../x": m["logs"]["replay"]})), "../x\": expected text like"),
        (edit_manifest(lambda m: m.update(logs={"replay": []})), LOG + ": expected a mapping, found []"),
        (log(first=-1), LOG + ".first: expected a whole number >= 0, found -1"),
        (log(first=19), LOG + ": the manifest is damaged: first (19) is above stop (18); use an older"),
        (log(stop="18"), LOG + ".stop: expected a whole number, found '18'"),
        (log(shards={}), LOG + ".shards: expected a list, found a mapping"),
        (log(shards=[3]), LOG + ".shards.0: expected a mapping, found 3"),
        (shard(start=12), LOG + ".shards.0: the manifest is damaged: start (12) is not below stop (12); use an older"),
        (shard(size=-1), LOG + ".shards.0.size: expected a whole number >= 0, found -1"),
        (shard(sha256="0" * 63), LOG + ".shards.0.sha256: expected text of at least 64 characters"),
        (shard(sha256=64), LOG + ".shards.0.sha256: expected text, found 64"),
        (shard(more=1), LOG + ".shards.0.more: unknown key 'more'"),
        (edit_manifest(lambda m: m["logs"]["replay"]["shards"][0].pop("size")), LOG + ".shards.0: missing key 'size'"),
        (edit_manifest(lambda m: m["logs"]["replay"]["shards"].pop(0)), "rows of 'replay' are missing"),
        (edit_manifest(lambda m: m["logs"]["replay"]["shards"].pop(1)), "rows of 'replay' are missing"),
        (edit_manifest(lambda m: m["logs"]["replay"]["shards"].reverse()), "rows of 'replay' are missing"),
        (log(first=5), "rows of 'replay' are missing"),
        (log(stop=17), "rows of 'replay' are missing"),
        (shard(size=2**60), "'replay' needs"),
        (shard(sha256=DIGEST), "is corrupt: its hash differs from the hash in the manifest"),
        (lambda f: shutil.rmtree(f.parent / "logs"), "000000000006-000000000012.safetensors is missing"),
        (values(iteration=-1), STATE + "iteration: expected a whole number >= 0, found -1"),
        (values(updates=1.5), STATE + "updates: expected a whole number, found 1.5"),
        (values(processes="x" * 100), f"processes: expected a whole number, found '{'x' * 56}..."),
        (values(rnd_updates=None), "rnd_updates: expected a whole number, found null"),
        (values(env_steps=299), "its step is 299, but manifest.json has step 300"),
        (values(learning_rate=-1e-9), "learning_rate: expected a number >= 0, found -1e-09"),
        (values(learning_rate=1e6), "learning_rate: expected a number < 1e+06, found 1000000.0"),
        (values(learning_rate=True), "learning_rate: expected a number, found true"),
        (values(learning_rate="fast"), "learning_rate: expected a number, found 'fast'"),
        (values(policy=[]), STATE + "policy: expected a mapping, found []"),
        (values(policy={}), "state.json and policy.json have different policies"),
        (statistics(recent=3), STATISTICS + "recent: expected a list, found 3"),
        (statistics(recent=[3]), STATISTICS + "recent.0: expected a list, found 3"),
        (statistics(recent=[[5, 1.0, 0.5]]), STATISTICS + "recent.0: expected"),
        (statistics(recent=[[5, 1.0, 0.5, "x"]]), STATISTICS + "recent.0.3: expected a number, found 'x'"),
        (statistics(recent=[[0, 1.0, 0.5, 1.0]]), STATISTICS + "recent.0.0: expected a number > 0, found 0"),
        (statistics(total=-1), STATISTICS + "total: expected a whole number >= 0, found -1"),
        (statistics(more=1), STATISTICS + "more: unknown key 'more'"),
        (values(**{"statistics.x": []}), "statistics.x: expected a mapping, found []"),
        (values(**{"statistics.x": 3}), "statistics.x: expected a mapping, found 3"),
        (extra_files(4097), MANIFEST + "files: expected at most 4096 items"),
        (tensor("trainer", "observations", torch.zeros(2, 4)), "'observations' has wrong shape (2, 4)"),
        (tensor("trainer", "observations", torch.zeros(6)), "'observations' has wrong shape (6,)"),
        (tensor("trainer", "critic.w", torch.tensor([1.0, float("nan")])), "'critic.w' is not finite"),
        (tensor("trainer", "a.normalizer.var", torch.tensor([1.0, -1.0])), "'a.normalizer.var' is negative"),
        (tensor("trainer", "normalizer.count", torch.tensor(-1)), "'normalizer.count' is negative"),
        (header(b'{"x": {"dtype": "F32", "shape": 3, "data_offsets": [0, 0]}}'), SHAPE + ": expected a list"),
        (header(b'{"x": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 0]}}'), SHAPE + ".0: expected a whole"),
        (header(b'{"x": {"dtype": "F32", "shape": [1.0], "data_offsets": [0, 0]}}'), SHAPE + ".0: expected a whole"),
        (header(b'{"x": 3}'), HEADER + ": expected a mapping, found 3"),
        (header(b'{"x": {"dtype": "F32", "shape": [%s], "data_offsets": [0, 4]}}' % b",".join([b"1"] * 17)), SHAPE),
        (header(b'{"x": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}}'), "env.safetensors is corrupt: "),
        (header(b'{"__metadata__": {}, "__metadata__": {}}'), "appears twice"),
        (content(b""), "is corrupt: not a safetensors file"),
        (content(b"\x02" + bytes(6)), "is corrupt: not a safetensors file"),
        (content(b"\x03" + bytes(7) + b"{}"), "is corrupt: not a safetensors file"),
    ],
)  # fmt: skip
def test_corrupt_checkpoint_is_refused_with_the_reason(folder, damage, output):
    damage(folder)
    with pytest.raises(CheckpointError) as caught:
        checkpoint_reader.open_checkpoint(folder).verify(whole=True)
    assert output in caught.value.message
    assert str(folder.parent) in caught.value.message


@pytest.mark.parametrize(
    "damage",
    [
        values(learning_rate=0),
        values(learning_rate=999_999.0),
        values(iteration=0, updates=0),
        statistics(recent=[], total=0),
        log(first=18),
        log(first=6),
        tensor("trainer", "normalizer.var", torch.zeros(3)),
        tensor("trainer", "normalizer.count", torch.tensor(0)),
        tensor("trainer", "masks", torch.tensor([-1, 2])),
        tensor("trainer", "bias", torch.tensor([-1.0])),
        tensor("env", "x", torch.tensor([float("nan")])),
        entry(note="whatever"),
        extra_files(4096),
    ],
)
def test_unusual_but_valid_checkpoint_is_read(folder, damage):
    damage(folder)
    checkpoint_reader.open_checkpoint(folder).verify(whole=True)


def test_log_files_with_different_columns_are_refused(folder):
    file = folder.parent / "logs/replay" / f"{12:012d}-{18:012d}.safetensors"
    data = safetensors.torch.save({"x": torch.zeros(6, 1)})
    file.write_bytes(data)
    shard(1, size=len(data), sha256=checkpoint_reader.sha256(data))(folder)
    opened = checkpoint_reader.open_checkpoint(folder).state().logs["replay"]
    assert set(opened.read(13, 15)) == {"x"}
    with pytest.raises(CheckpointError, match="the parts of 'replay' have different columns"):
        opened.read(10, 14)


def test_log_file_with_other_rows_than_its_name_is_refused(folder):
    file = folder.parent / "logs/replay" / f"{12:012d}-{18:012d}.safetensors"
    data = safetensors.torch.save({"x": torch.zeros(6, 1), "y": torch.zeros(5)})
    file.write_bytes(data)
    shard(1, size=len(data), sha256=checkpoint_reader.sha256(data))(folder)
    with pytest.raises(CheckpointError, match=f"{file.name} is corrupt: rows of 'y' are missing"):
        checkpoint_reader.open_checkpoint(folder).verify(whole=True)


@pytest.mark.parametrize("iteration", [None, "3", -1, True, 1.0])
def test_checkpoint_without_an_iteration_cannot_be_resumed(folder, iteration):
    edit_manifest(lambda m: m.update(iteration=iteration))(folder)
    with pytest.raises(CheckpointError, match=r"manifest\.json is corrupt: iteration: expected a whole number"):
        checkpoint_reader.open_checkpoint(folder).iteration  # noqa: B018


def test_verify_checks_only_the_policy_unless_whole(folder):
    (folder / "env.safetensors").write_bytes(b"gone")
    opened = checkpoint_reader.open_checkpoint(folder)
    opened.verify(whole=False)
    with pytest.raises(CheckpointError, match=r"env\.safetensors"):
        opened.verify(whole=True)
    (folder / "policy.safetensors").write_bytes(b"gone")
    with pytest.raises(CheckpointError, match=r"policy\.safetensors"):
        opened.verify(whole=False)


@pytest.mark.parametrize("what", ["nothing", "file", "empty"])
def test_open_checkpoint_refuses_other_folders(tmp_path, what):
    place = tmp_path / "place"
    if what == "file":
        place.touch()
    elif what == "empty":
        place.mkdir()
    with pytest.raises(CheckpointError, match=r"place is not a checkpoint: it has no manifest\.json"):
        checkpoint_reader.open_checkpoint(place)


def test_checkpoint_in_a_renamed_folder_may_have_any_step(folder):
    for name in ("best", "300", "12345678901", "²" * 12):
        copy = folder.with_name(name)
        shutil.copytree(folder, copy)
        assert checkpoint_reader.open_checkpoint(copy).step == 300


def test_steps_ignores_links(folder):
    folder.with_name(f"{400:012d}").symlink_to(folder)
    assert checkpoint_reader.steps(folder.parent) == [100, 200, 300]
    aside = folder.parent.with_name("aside")
    folder.parent.rename(aside)
    folder.parent.symlink_to(aside)
    assert checkpoint_reader.steps(folder.parent) == []


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("action_bound", 1e308), ("normalize_clip", 1e300), ("log_std_range", [-1e308, 1e308]),
        ("hidden", [10**9, 10**9]), ("hidden", [8] * 101), ("observation_size", 2**40), ("memory", [0]),
    ],
)  # fmt: skip
def test_numbers_of_a_policy_fit_single_precision(key, value):
    with pytest.raises(
        CheckpointError, match=rf"policy\.json is not valid: {key}.*; export the policy again, or use another"
    ):
        blank_policy({**SPEC, key: value})


@pytest.mark.parametrize(
    ("trainer", "change", "said"),
    [
        ("sb3", "policy.hidden=[64, 1000000000]", "number <= "), ("ppo", "actor.hidden=[1000000000]", "number <= "),
        ("ppo", "rnn={hidden: 1000000000}", "number <= "), ("ppo", "rnn={layers: 1000}", "number <= "),
        ("sb3", "action_bound=1e308", "out of range; allowed: 1e-38 to 1e+38"),
        ("ppo", "action_bound=1e308", "out of range; allowed: 1e-38 to 1e+38"),
    ],
)  # fmt: skip
def test_settings_of_an_agent_fit_the_limits_of_a_policy(tmp_path, trainer, change, said):
    (tmp_path / "agent.yaml").write_text(f"agents: {{x: {{trainer: {trainer}, algorithm: ppo, max_iterations: 1}}}}\n")
    with pytest.raises(ConfigError) as caught:
        resolve(find_task("cartpole"), agent="x", config_file=tmp_path / "agent.yaml", overrides=[f"agent.{change}"])
    (problem,) = caught.value.problems
    assert said in problem.message, problem
