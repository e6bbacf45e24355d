"""Files of Stable-Baselines3 and RSL-RL with other content than a policy are refused, and nothing is executed."""

import base64
import collections
import io
import json
import os
import pickle
import stat
import struct
import zipfile
from pathlib import Path

import pytest
import torch
from stable_baselines3 import PPO
from support.checkpoint_damage import Bomb
from support.fault_sizes import amount, chosen
from support.foreign_checkpoints import (
    Still,
    close,
    observations,
    old_rsl_rl_checkpoint,
    randomized,
    read,
    refused,
    refused_by_command,
    sb3_file,
)

from rlcli.cli.app import main
from rlcli.errors import CheckpointError
from rlcli.runs.untrusted_weights import read_tensors
from rlcli.training.import_policy import read_rsl_rl, read_sb3

pytestmark = pytest.mark.usefixtures("nothing_executed")


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """An SB3 model and its file."""
    model = PPO("MlpPolicy", Still(), device="cpu", policy_kwargs={"net_arch": [8]}, seed=0)
    randomized(model.policy)
    file = tmp_path_factory.mktemp("good") / "model.zip"
    model.save(file)
    return model, file


def zipped(members, name="model.zip", like=None):
    """Write a zip file with these members, after the other members of `like`."""
    with zipfile.ZipFile(name, "w") as archive:
        if like is not None:
            with zipfile.ZipFile(like) as other:
                for member in other.infolist():
                    if member.filename not in members:
                        archive.writestr(member.filename, other.read(member))
        for member, data in members.items():
            archive.writestr(member, data)
    return Path(name)


def saved_by_torch(value, **settings):
    file = io.BytesIO()
    torch.save(value, file, **settings)
    return file.getvalue()


def described(description, name="archive/data.pkl"):
    """Write a torch file with this description of its tensors."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, description)
        archive.writestr("archive/version", "3\n")
        archive.writestr("archive/byteorder", "little")
        archive.writestr("archive/data/0", bytes(64))
    return file.getvalue()


FIELDS = ("policy_class", "observation_space", "action_space", "lr_schedule", "clip_range", "rollout_buffer_class")


@pytest.mark.parametrize("field", chosen(FIELDS, 2))
def test_pickle_in_an_sb3_field_is_not_opened(field, good):
    model, file = good
    data = json.loads(zipfile.ZipFile(file).read("data"))
    bomb = base64.b64encode(pickle.dumps(Bomb())).decode()
    data[field] = {":type:": "<class 'function'>", ":serialized:": bomb}
    policy = read("sb3", zipped({"data": json.dumps(data)}, "bad.zip", like=file))
    close(policy, torch.from_numpy(model.predict(observations().numpy(), deterministic=True)[0]))


@pytest.mark.parametrize(
    "member", chosen(["data", "policy.optimizer.pth", "pytorch_variables.pth", "system_info.txt", "more"], 2)
)
@pytest.mark.parametrize("kind", ["pickle", "torch"])
def test_pickle_in_another_sb3_member_is_not_opened(member, kind, good):
    _, file = good
    bomb = pickle.dumps(Bomb()) if kind == "pickle" else saved_by_torch({"a": Bomb()})
    foreign = read_sb3(zipped({member: bomb}, "bad.zip", like=file))
    assert foreign.spec["hidden"] == [8]


def bombs():
    whole = {"actor.0.weight": torch.zeros(1, 4), "actor.0.bias": torch.zeros(1), "std": torch.ones(1)}
    for protocol in (0, 1, 2, 3, 4, 5):
        yield f"pickle of protocol {protocol}", pickle.dumps(Bomb(), protocol)
        yield f"description of protocol {protocol}", described(pickle.dumps(Bomb(), protocol))
        yield f"weights of protocol {protocol}", described(pickle.dumps({"model_state_dict": {"a": Bomb()}}, protocol))
    for key in ("model_state_dict", "optimizer_state_dict", "infos", "iter", "obs_norm_state_dict", "more"):
        yield f"torch's, in {key}", saved_by_torch({"model_state_dict": whole, key: Bomb()})
        yield (
            f"torch's older form, in {key}",
            saved_by_torch({"model_state_dict": whole, key: Bomb()}, _use_new_zipfile_serialization=False),
        )
    for name in ("posix system", "builtins eval", "torch.hub load", "torch FloatTensor", "torch load", "os system",
                 "builtins bytearray", "numpy._core.multiarray _reconstruct", "torch._utils _rebuild_from_type_v2",
                 "torch.jit load", "rlcli.cli.app main", "collections Counter", "torch Tensor"):  # fmt: skip
        module, _, attribute = name.partition(" ")
        yield f"names {name}", described(f"c{module}\n{attribute}\n(S'touch executed'\ntR.".encode())
    yield "instance", described(b"(S'touch executed'\nios\nsystem\n.")
    yield "object", described(b"(cos\nsystem\nS'touch executed'\no.")
    yield "an extension", described(b"\x80\x02\x82\x01.")
    yield "two descriptions", _two_descriptions(pickle.dumps(Bomb()))


def _two_descriptions(bomb):
    file = io.BytesIO(described(b"\x80\x02}."))
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("other/data.pkl", bomb)
    return file.getvalue()


BOMBS = dict(bombs())


@pytest.mark.parametrize("form", ["sb3", "rsl-rl"])
def test_import_command_refuses_with_one_error(form, good, capfd):
    Path("model.pt").write_bytes(BOMBS["torch's, in infos"])
    _, file = good
    bad = "model.pt" if form == "rsl-rl" else zipped({"policy.pth": BOMBS["names os system"]}, "bad.zip", like=file)
    assert "system'" in refused_by_command(capfd, form, bad)
    assert "no file" in refused_by_command(capfd, form, "nowhere.pt")


@pytest.mark.parametrize("form", ["sb3", "rsl-rl"])
@pytest.mark.parametrize("name", chosen(BOMBS, 9))
def test_pickle_in_place_of_tensors_is_not_loaded(name, form, good):
    if form == "rsl-rl":
        Path("model.pt").write_bytes(BOMBS[name])
        output = refused(form, "model.pt")
        assert "model.pt" in output
    else:
        _, file = good
        output = refused(form, zipped({"policy.pth": BOMBS[name]}, "bad.zip", like=file))
        assert "policy.pth" in output


class LooksLikeAState(collections.OrderedDict):
    """Custom class in a checkpoint."""


def test_custom_class_in_a_checkpoint_is_named():
    torch.save(LooksLikeAState(a=torch.zeros(1)), "model.pt")
    assert "LooksLikeAState" in refused("rsl-rl", "model.pt")


@pytest.mark.parametrize(
    "member", ["../policy.pth", "/etc/x", "a/../../x", "..", "C:/x", "\\\\host\\x", "a\\..\\..\\x", "//x"]
)
def test_zip_member_outside_the_archive_is_refused(member, good):
    _, file = good
    assert "leads out" in refused("sb3", zipped({member: b"x"}, "bad.zip", like=file))
    assert not Path("../policy.pth").exists()


def test_unusual_zip_members_are_refused(good):
    _, file = good
    for kind, output in (
        ("link", "is a link"),
        ("twice", "it appears twice"),
        ("encrypted", "encrypted"),
        ("lzma", "its compression is not supported"),
    ):
        bad = zipped({}, "bad.zip", like=file)
        with zipfile.ZipFile(bad, "a") as archive:
            if kind == "link":
                member = zipfile.ZipInfo("link")
                member.create_system, member.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
                archive.writestr(member, "/etc/passwd")
            elif kind == "twice":
                with pytest.warns(UserWarning, match="Duplicate"):
                    archive.writestr("policy.pth", pickle.dumps(Bomb()))
            elif kind == "lzma":
                archive.writestr("more", "x" * 100, zipfile.ZIP_LZMA)
        if kind == "encrypted":
            data = bytearray(bad.read_bytes())
            data[data.rfind(b"PK\x01\x02") + 8] |= 1
            bad.write_bytes(data)
        assert output in refused("sb3", bad), kind


def test_zip_bomb_is_not_unpacked(good):
    _, file = good
    for member in ("policy.pth", "more"):
        bad = zipped({}, "bad.zip", like=file)
        with zipfile.ZipFile(file) as good, zipfile.ZipFile(bad, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in good.namelist():
                if name != member:
                    archive.writestr(name, good.read(name), zipfile.ZIP_STORED)
            archive.writestr(member, bytes(20 * 2**20))
        assert "more than 100 times larger" in refused("sb3", bad)


def test_zip_members_of_gigabytes_are_not_unpacked(good):
    _, file = good
    data = bytearray(file.read_bytes())
    at = data.rfind(b"PK\x01\x02")
    struct.pack_into("<II", data, at + 20, 2**31, 2**32 - 2)  # packed and unpacked size of the last member
    Path("bad.zip").write_bytes(data)
    assert "bad.zip" in refused("sb3", "bad.zip")


def tensor_larger_than_its_data(name):
    """Return tensors whose shapes have more numbers than the file holds."""
    one = torch.zeros(1)
    return {
        "a stride of 0": lambda: one.expand(2**40),
        "both strides of 0": lambda: one.expand(2**20, 2**20),
        "a thin matrix": lambda: torch.as_strided(torch.zeros(16), (4, 2**34), (1, 0)),
        "overlapping rows": lambda: torch.as_strided(torch.zeros(1000), (900, 100), (1, 1)),
        "sparse": lambda: torch.sparse_coo_tensor(torch.zeros(1, 1, dtype=torch.int64), torch.ones(1), (2**40,)),
        "complex": lambda: torch.zeros(4, 4, dtype=torch.complex64),
        "on no device": lambda: torch.zeros(2**40, device="meta"),
        "quantized": lambda: torch.quantize_per_tensor(torch.zeros(4, 4), 0.1, 0, torch.qint8),
        "a number": lambda: 3.0,
        "a list": lambda: [1.0, 2.0],
        "nothing": lambda: None,
        "NaN": lambda: torch.full((1, 4), float("nan")),
        "infinity": lambda: torch.full((1, 4), float("inf")),
        "four dimensions": lambda: torch.zeros(1, 4, 1, 1),
        "no rows": lambda: torch.zeros(0, 4),
    }[name]()


@pytest.mark.parametrize("form", ["sb3", "rsl-rl"])
@pytest.mark.parametrize(
    "name",
    chosen(
        [
            "a stride of 0",
            "both strides of 0",
            "a thin matrix",
            "overlapping rows",
            "sparse",
            "complex",
            "on no device",
            "quantized",
            "a number",
            "a list",
            "nothing",
            "NaN",
            "infinity",
            "four dimensions",
            "no rows",
        ],
        5,
    ),
)
@pytest.mark.filterwarnings("ignore")  # of torch, about the oddest of them
def test_tensor_that_is_not_a_plain_matrix_is_refused(name, form):
    if form == "rsl-rl":
        weights = {
            "actor.0.weight": tensor_larger_than_its_data(name),
            "actor.0.bias": torch.zeros(1),
            "std": torch.ones(1),
        }
        torch.save({"model_state_dict": weights}, "model.pt")
        refused(form, "model.pt")
    else:
        model, file = sb3_file(net_arch=[])
        weights = {**model.policy.state_dict(), "action_net.weight": tensor_larger_than_its_data(name)}
        refused(form, zipped({"policy.pth": saved_by_torch(weights)}, "bad.zip", like=file))


def test_repeated_tensor_does_not_fill_the_memory(monkeypatch):
    monkeypatch.setattr("rlcli.training.import_policy.available_memory", lambda: 2**26)
    one = torch.zeros(1000, 1000)
    torch.save({"model_state_dict": {f"actor.{i}.weight": one for i in range(50)}}, "model.pt")
    assert "more than 16,777,216 bytes" in refused("rsl-rl", "model.pt")


@pytest.mark.parametrize(
    ("weights", "output"),
    [
        ({}, "has no actor of RSL-RL"),
        ({"actor.0.weight": torch.zeros(1, 4)}, "use linear layers with a bias"),
        ({"actor.0.weight": torch.zeros(1, 4), "actor.0.bias": torch.zeros(3)}, "use linear layers with a bias"),
        ({"actor.0.weight": torch.zeros(1, 4), "actor.0.bias": torch.zeros(1)}, "depends on the state"),
        ({"actor.1.weight": torch.zeros(1, 4), "actor.1.bias": torch.zeros(1)}, "can be imported, found 1"),
        (
            {"actor.x.weight": torch.zeros(1, 4), "actor.x.bias": torch.zeros(1)},
            "are named x; rename them to actor.0, actor.2, actor.4",
        ),
        ({"actor.00.weight": torch.zeros(1, 4), "actor.0.weight": torch.zeros(1, 4)}, "actor"),
        ({"actor.0.weight": torch.zeros(1, 4), "actor.0.bias": torch.zeros(1), "std": torch.ones(2)}, "log_std"),
        (
            {"actor.0.weight": torch.zeros(8, 4), "actor.0.bias": torch.zeros(8), "actor.2.weight": torch.zeros(1, 9),
             "actor.2.bias": torch.zeros(1), "std": torch.ones(1)},
            "a layer with 8 outputs is followed by a layer with 9 inputs",
        ),
        (
            {"actor.0.weight": torch.zeros(1, 6), "actor.0.bias": torch.zeros(1), "std": torch.ones(1),
             "memory_a.rnn.weight_hh_l0": torch.zeros(18, 6), "memory_a.rnn.weight_ih_l0": torch.zeros(18, 4)},
            "the RNN is no LSTM",
        ),
        (
            {"actor.0.weight": torch.zeros(1, 4), "actor.0.bias": torch.zeros(1), "std": torch.ones(1),
             "actor_obs_normalizer._mean": torch.zeros(1, 4)},
            "normaliser",
        ),
    ],
)  # fmt: skip
def test_weights_without_a_policy_are_refused(weights, output):
    torch.save({"model_state_dict": weights}, "model.pt")
    assert output in refused("rsl-rl", "model.pt")


@pytest.mark.parametrize(
    "content", [b"", b"PK", b"PK\x03\x04", b"text", b"\x80\x04.", bytes(1000), b"PK\x05\x06" + bytes(18)]
)
@pytest.mark.parametrize("form", ["sb3", "rsl-rl"])
def test_file_of_another_format_is_refused(content, form):
    Path("model.zip").write_bytes(content)
    assert "model.zip" in refused(form, "model.zip")


@pytest.mark.parametrize("form", ["sb3", "rsl-rl"])
def test_missing_file_or_folder_is_refused(form):
    Path("folder").mkdir()
    os.mkfifo("pipe")
    for name in ("nowhere.zip", "folder", "pipe", "/dev/zero"):
        assert Path(name).name in refused(form, name)


def test_policy_of_another_algorithm_is_refused(good):
    _, file = good
    for names in ({"q_net.q_net.0.weight": torch.zeros(2, 4)}, {"action_net.weight": torch.zeros(2, 4)}, {}):
        assert "must have a policy of PPO" in refused(
            "sb3", zipped({"policy.pth": saved_by_torch(names)}, "bad.zip", like=file)
        )


@pytest.mark.parametrize("form", ["sb3", "rsl-rl"])
def test_damaged_file_is_refused_or_read_unchanged(form):
    """Truncate and flip bytes: either the checksums of the zip detect it, or the policy is unchanged."""
    if form == "sb3":
        model, file = sb3_file(net_arch=[4])
        reader, want = read_sb3, model.policy.state_dict()["action_net.weight"]
    else:
        old_rsl_rl_checkpoint(None)
        file, reader = Path("model_7.pt"), read_rsl_rl
        want = reader(file).weights["actor.4.weight"]
    data, count = file.read_bytes(), amount(6, 60, 1000)
    refusals = 0
    for number in range(count):
        at = int(len(data) * ((number * 0.6180339887) % 1.0))
        flipped = bytearray(data)
        flipped[at] ^= 1 << (number % 8)
        for kind, damaged in (("cut", data[:at]), ("flipped", bytes(flipped))):
            file.write_bytes(damaged)
            try:
                found = reader(file)
            except CheckpointError:
                refusals += 1
            else:
                assert kind == "flipped"
                last = max(name for name in found.weights if name.startswith("actor.") and name.endswith("weight"))
                assert torch.equal(found.weights[last], want), f"{kind} at {at}"
    assert refusals > count


def test_refusal_of_torch_is_no_advice_to_unpickle(capfd):
    """The opcodes are those of tensors, but torch's unpickler refuses the sequence."""
    Path("model.pt").write_bytes(described(b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n)R."))
    message = refused_by_command(capfd, "rsl-rl", "model.pt")
    assert "is corrupt, or has more than tensors, numbers and text" in message
    assert "weights_only" not in message
    assert "Warning" not in message


@pytest.mark.parametrize("opcode", [b"L%sL\n.", b"I%s\n."])
def test_long_number_in_a_pickle_gives_no_advice_to_change_python(opcode, capfd):
    with zipfile.ZipFile("model.pt", "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + opcode % (b"9" * 5000))
        archive.writestr("archive/version", "3")
    assert main(["import", "rsl-rl", "model.pt", "--task", "cartpole"]) == 5
    message = capfd.readouterr().err
    assert "model.pt is corrupt: a number has more than 4300 digits; save the file again" in message


SHARED = b"N" + b"".join(b"q%ch%c\x86" % (i, i) for i in range(60))
"""A tuple of two references to a tuple of two references ...: its hash takes 2^60 steps."""
STORAGE = b"ctorch\nFloatStorage\n"
COSTLY = {
    "shared tuples as a key": (b"}" + SHARED + b"Ns.", "counted as often as it is referred to"),
    "shared lists": (b"]" + b"".join(b"q%c]h%cah%ca" % (i, i, i) for i in range(60)) + b".", "as often as it is"),
    "nested tuples as a key": (b"}N" + b"\x85" * 1_000_000 + b"Ns.", "deeper than 100 levels"),
    "nested lists": (b"]" * 200 + b"a" * 199 + b".", "deeper than 100 levels"),
    "a list put into lists before they are filled": (b"]q\x00]q\x01h\x00ah\x00h\x01a.", "part of another value"),
    "a list in itself": (b"]q\x00h\x00a.", "part of another value"),
    "a tuple as a key": (b"}N\x85Ns.", "neither text nor a whole number"),
    "a large number as a key": (b"}\x8a\x08" + b"\xff" * 7 + b"\x1fNs.", "neither text nor a whole number"),
    "keys of an OrderedDict's arguments": (
        b"ccollections\nOrderedDict\n]]N\x85aNaa\x85R.",
        "calls a function that does not create",
    ),
    "a storage of a wanted size": (
        STORAGE + b"\x8a\x05\x00\x00\x00\x00\x7f\x85R.",
        "calls a function that does not create",
    ),
    "a storage with tuples as its name": (
        b"(X\x07\x00\x00\x00storage" + STORAGE + b"N\x85\x85NNtQ.",
        "a name that is not text",
    ),
    "attributes from a list": (b"ccollections\nOrderedDict\n)R]b.", "sets attributes"),
}
"""Pickle of plain values that takes very long or much memory to load, or crashes Python -> part of the error."""


@pytest.mark.parametrize("form", ["sb3", "rsl-rl"])
@pytest.mark.parametrize("name", COSTLY)
def test_plain_values_that_are_costly_to_load_are_refused(name, form, good, capfd):
    pickled, expected = COSTLY[name]
    data = described(b"\x80\x02" + pickled)
    Path("model.pt").write_bytes(data)
    file = "model.pt" if form == "rsl-rl" else zipped({"policy.pth": data}, "bad.zip", like=good[1])
    assert expected in refused_by_command(capfd, form, file)


def test_nested_checkpoint_with_optimizer_and_shared_values_is_read():
    """Adam's state has numbers as keys; `betas` is one tuple that two groups share."""
    layers = torch.nn.ModuleList([torch.nn.Linear(4, 1), torch.nn.Linear(1, 1)])
    optimizer = torch.optim.Adam([{"params": list(layer.parameters())} for layer in layers], lr=1e-3)
    sum(layer.weight.sum() + layer.bias.sum() for layer in layers).backward()
    optimizer.step()
    saved = {"model_state_dict": layers.state_dict(), "optimizer_state_dict": optimizer.state_dict(), "infos": None}
    found = read_tensors(saved_by_torch(saved), "model.pt")
    assert found["optimizer_state_dict"]["param_groups"][1]["betas"] == (0.9, 0.999)
    assert set(found["optimizer_state_dict"]["state"]) == {0, 1, 2, 3}
    assert torch.equal(found["model_state_dict"]["0.weight"], layers[0].weight)
