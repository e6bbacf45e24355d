"""Import of policies of Stable-Baselines3 and RSL-RL: equal actions, and refusal of files with other content."""

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

import gymnasium as gym
import numpy as np
import pytest
import safetensors.numpy
import torch
from rsl_rl.modules import EmpiricalNormalization
from rsl_rl.runners import OnPolicyRunner
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from support.fault_sizes import amount, chosen
from tensordict import TensorDict

from rlcli.adapters.rsl_rl import RslRlVecEnv
from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import CheckpointError
from rlcli.registry import find_task
from rlcli.rl.policy import load_policy
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.runs.untrusted_weights import read_tensors
from rlcli.training.import_policy import read_rsl_rl, read_sb3

ALGORITHMS = {"ppo": PPO, "a2c": A2C, "sac": SAC, "td3": TD3}
OBSERVATIONS = 4
ROWS = 1000


class Still(gym.Env):
    """Environment with cartpole's spaces and without dynamics."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (OBSERVATIONS,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(OBSERVATIONS, dtype=np.float32), {}

    def step(self, action):
        return np.zeros(OBSERVATIONS, dtype=np.float32), 0.0, False, False, {}


class Bomb:
    def __reduce__(self):
        return (os.system, ("touch executed",))


@pytest.fixture(autouse=True)
def _place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield
    torch.set_num_threads(threads)
    assert not Path("executed").exists(), "something was executed"


def randomized(module):
    """Randomise all weights, as after a training: no bias is 0."""
    with torch.no_grad():
        for value in module.parameters():
            value.add_(0.2 * torch.randn_like(value))
    return module


def sb3_file(name="ppo", **policy):
    model = ALGORITHMS[name]("MlpPolicy", Still(), device="cpu", policy_kwargs=policy, seed=0)
    randomized(model.policy)
    model.save("model.zip")
    return model, Path("model.zip")


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """An SB3 model and its file."""
    model = PPO("MlpPolicy", Still(), device="cpu", policy_kwargs={"net_arch": [8]}, seed=0)
    randomized(model.policy)
    file = tmp_path_factory.mktemp("good") / "model.zip"
    model.save(file)
    return model, file


def observations():
    return torch.randn(ROWS, OBSERVATIONS, generator=torch.Generator().manual_seed(1)) * 2.0


def imported(form, file, *words):
    """Import through the command line, and return the new run's policy."""
    assert main(["import", form, str(file), "--task", "cartpole", "--runs-dir", "runs", *words]) == 0
    (run,) = Path("runs/cartpole").iterdir()
    return open_checkpoint(run / "checkpoints" / "000000000000").policy()


def read(form, file, **settings):
    """Return the policy of a file."""
    foreign = (read_sb3 if form == "sb3" else read_rsl_rl)(Path(file), **settings)
    return load_policy(foreign.spec, foreign.weights)


def refused_by_command(capfd, *words, code=5):
    """Return the text of the only error, after a check that no run is left."""
    capfd.readouterr()
    assert main(["import", *map(str, words), "--task", "cartpole", "--runs-dir", "runs"]) == code
    out, err = capfd.readouterr()
    assert out == ""
    assert "Traceback" not in err
    errors = [line for line in err.splitlines() if line.startswith("error:") and not line.startswith("error:   ")]
    assert len(errors) == 1, err
    assert not list(Path("runs").glob("*/*/run.json"))
    return err


def refused(form, file):
    """Return the error for a file."""
    with pytest.raises(CheckpointError) as caught:
        (read_sb3 if form == "sb3" else read_rsl_rl)(Path(file))
    assert Path(file).name in caught.value.message
    assert len(caught.value.message) < 1000
    return caught.value.message


def close(policy, expected, obs=None):
    found = policy(observations() if obs is None else obs)
    assert found.shape == expected.shape
    assert float((found - expected).abs().max()) <= 1e-6


# --- accepted files ---


@pytest.mark.parametrize(("name", "hidden"), chosen([(n, h) for h in ([32, 16, 8], [8], []) for n in ALGORITHMS], 4))
def test_sb3_policy_gives_the_same_actions(name, hidden):
    if not hidden and name == "sac":
        hidden = [1]
    model, file = sb3_file(name, net_arch=hidden)
    policy = read("sb3", file)
    expected, _ = model.predict(observations().numpy(), deterministic=True)
    close(policy, torch.from_numpy(expected))


@pytest.mark.parametrize(("activation", "module"), [("elu", torch.nn.ELU), ("silu", torch.nn.SiLU)])
def test_sb3_activation_option(activation, module):
    model, file = sb3_file(net_arch=[16], activation_fn=module)
    expected, _ = model.predict(observations().numpy(), deterministic=True)
    close(read("sb3", file, activation=activation), torch.from_numpy(expected))
    assert float((read("sb3", file)(observations()) - torch.from_numpy(expected)).abs().max()) > 1e-3


def test_sb3_standard_deviation_is_imported():
    model, file = sb3_file()
    assert torch.equal(read("sb3", file).log_std, model.policy.log_std.detach())


def test_vec_normalize_is_imported_from_safetensors(capfd):
    model, file = sb3_file(net_arch=[16])
    venv = VecNormalize(DummyVecEnv([Still]))
    for _ in range(5):
        venv.obs_rms.update(np.random.default_rng(0).normal(3.0, 2.0, (100, OBSERVATIONS)))
    venv.save("vecnormalize.pkl")
    output = refused_by_command(capfd, "sb3", file, "--normalizer", "vecnormalize.pkl")
    assert "is a pickle" in output
    assert "safetensors.numpy.save_file" in output
    assert "is a pickle" in refused_by_command(capfd, "sb3", "vecnormalize.pkl")
    safetensors.numpy.save_file({"mean": venv.obs_rms.mean, "var": venv.obs_rms.var}, "normalizer.safetensors")
    policy = imported("sb3", file, "--normalizer", "normalizer.safetensors")
    seen = venv.normalize_obs(observations().numpy() + 3.0)
    expected, _ = model.predict(seen, deterministic=True)
    close(policy, torch.from_numpy(expected), observations() + 3.0)


def runner_of(**actor):
    env = make_env(resolve(find_task("cartpole"), overrides=["scene.num_envs=4"]), seed=3)
    settings = {
        "num_steps_per_env": 8,
        "save_interval": 50,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": {
            "class_name": "MLPModel",
            "hidden_dims": [32, 16],
            "activation": "elu",
            "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.7},
            **actor,
        },
        "critic": {"class_name": "MLPModel", "hidden_dims": [8]},
        "algorithm": {"class_name": "PPO"},
    }
    return OnPolicyRunner(RslRlVecEnv(env), settings, device="cpu")


@pytest.mark.parametrize(
    ("normalized", "std"), chosen([(True, "scalar"), (False, "log"), (True, "log"), (False, "scalar")], 2)
)
def test_rsl_rl_policy_gives_the_same_actions(normalized, std, capfd):
    distribution = {"class_name": "GaussianDistribution", "init_std": 0.7, "std_type": std}
    runner = runner_of(obs_normalization=normalized, distribution_cfg=distribution)
    runner.learn(2)
    runner.save("model_2.pt")
    policy = imported("rsl-rl", "model_2.pt") if normalized else read("rsl-rl", "model_2.pt")
    act = runner.get_inference_policy()
    with torch.no_grad():
        close(policy, act(TensorDict({"policy": observations()}, batch_size=[ROWS])))
        assert torch.allclose(
            policy.log_std.exp(),
            act.distribution.std_param if std == "scalar" else act.distribution.log_std_param.exp(),
        )


def test_rsl_rl_recurrent_policy_gives_the_same_actions(capfd):
    runner = runner_of(class_name="RNNModel", rnn_type="lstm", rnn_hidden_dim=6, rnn_num_layers=2)
    runner.save("model_0.pt")
    policy = read("rsl-rl", "model_0.pt")
    act, memory = runner.get_inference_policy(), None
    act.reset()
    with torch.no_grad():
        for step in range(20):
            obs = torch.randn(50, OBSERVATIONS, generator=torch.Generator().manual_seed(step))
            expected = act(TensorDict({"policy": obs}, batch_size=[50]))
            found, memory = policy.step(obs, memory)
            assert float((found - expected).abs().max()) <= 1e-6


def old_rsl_rl_checkpoint(normalizer, **more):
    """Return a checkpoint in the format of RSL-RL 2 and 3, and its network."""
    network = randomized(
        torch.nn.Sequential(
            torch.nn.Linear(OBSERVATIONS, 16),
            torch.nn.ELU(),
            torch.nn.Linear(16, 8),
            torch.nn.ELU(),
            torch.nn.Linear(8, 1),
        )
    )
    stats = EmpiricalNormalization(OBSERVATIONS)
    for _ in range(3):
        stats.update(observations() * 3.0 + 1.0)
    weights = {f"actor.{name}": value for name, value in network.state_dict().items()}
    weights |= {
        "critic.0.weight": torch.randn(1, OBSERVATIONS),
        "critic.0.bias": torch.zeros(1),
        "std": torch.tensor([0.3]),
    }
    saved = {
        "model_state_dict": weights,
        "optimizer_state_dict": {"state": {}, "param_groups": []},
        "iter": 7,
        "infos": None,
    }
    if normalizer == "2":
        saved |= {"obs_norm_state_dict": stats.state_dict(), "privileged_obs_norm_state_dict": stats.state_dict()}
    elif normalizer == "3":
        weights |= {f"actor_obs_normalizer.{name}": value for name, value in stats.state_dict().items()}
    torch.save({**saved, **more}, "model_7.pt")
    stats.eval()
    return lambda obs: network(obs if normalizer is None else stats(obs))


@pytest.mark.parametrize("normalizer", [None, "2", "3"])
def test_older_rsl_rl_checkpoints_are_read(normalizer):
    act = old_rsl_rl_checkpoint(normalizer)
    policy = read("rsl-rl", "model_7.pt")
    with torch.no_grad():
        close(policy, act(observations()))
    assert torch.allclose(policy.log_std.exp(), torch.tensor([0.3]))


@pytest.mark.slow
def test_imported_policy_can_be_evaluated_exported_and_resumed(capfd):
    _, file = sb3_file(net_arch=[32, 32], activation_fn=torch.nn.ELU)
    policy = imported("sb3", file, "--activation", "elu", "--agent", "sb3-ppo")
    (run,) = Path("runs/cartpole").iterdir()
    assert main(["eval", "--checkpoint", str(run), "--episodes", "2", "--num-envs", "2"]) == 0
    assert main(["export", "--checkpoint", str(run), "--format", "onnx", "--output", "policy.onnx"]) == 0
    words = ["scene.num_envs=8", "--logger", "none", "--max-iterations", "1", "--runs-dir", "trained", "-q"]
    network = "agent.policy={hidden: [32, 32], activation: elu}"
    assert main(["train", "cartpole", "--agent", "sb3-ppo", network, *words, "--init-from", str(run)]) == 0
    (trained,) = Path("trained/cartpole").iterdir()
    begun = open_checkpoint(trained / "checkpoints" / "000000000000").policy()
    assert all(torch.equal(value, policy.state_dict()[name]) for name, value in begun.state_dict().items())
    capfd.readouterr()
    assert main(["train", "--resume", str(run), "--max-iterations", "2"]) == 5
    assert "--init-from" in capfd.readouterr().err


@pytest.mark.parametrize(("form", "size"), [("sb3", "action_size"), ("rsl-rl", "observation_size")])
def test_policy_of_another_shape_is_refused_with_a_table(form, size, capfd):
    if form == "sb3":
        Still.action_space = gym.spaces.Box(-1.0, 1.0, (3,))
        try:
            _, file = sb3_file()
        finally:
            Still.action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    else:
        weights = {"actor.0.weight": torch.randn(1, 9), "actor.0.bias": torch.zeros(1), "std": torch.ones(1)}
        torch.save({"model_state_dict": weights}, "model_7.pt")
        file = "model_7.pt"
    output = refused_by_command(capfd, form, file)
    assert f"error:   {size}" in output
    assert "of cartpole" in output


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--activation", "tahn"], "did you mean 'tanh'"),
        (["--action-bound", "-1"], "--action-bound"),
        (["--action-bound", "nan"], "--action-bound"),
    ],
)
def test_invalid_import_option_is_a_usage_error(words, named, capfd):
    assert named in refused_by_command(capfd, "sb3", "model.zip", *words, code=2)


# --- refused files ---


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
        ({}, "must have an actor"),
        ({"actor.0.weight": torch.zeros(1, 4)}, "use linear layers with a bias"),
        ({"actor.0.weight": torch.zeros(1, 4), "actor.0.bias": torch.zeros(3)}, "use linear layers with a bias"),
        ({"actor.0.weight": torch.zeros(1, 4), "actor.0.bias": torch.zeros(1)}, "depends on the state"),
        ({"actor.1.weight": torch.zeros(1, 4), "actor.1.bias": torch.zeros(1)}, "can be imported, found 1"),
        ({"actor.x.weight": torch.zeros(1, 4), "actor.x.bias": torch.zeros(1)}, "are named x; name them 0, 2, 4"),
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
    "a list put into lists before they are filled": (b"]q\x00]q\x01h\x00ah\x00h\x01a.", "part of another"),
    "a list in itself": (b"]q\x00h\x00a.", "part of another"),
    "a tuple as a key": (b"}N\x85Ns.", "neither text nor a whole number"),
    "a large number as a key": (b"}\x8a\x08" + b"\xff" * 7 + b"\x1fNs.", "neither text nor a whole number"),
    "keys of an OrderedDict's arguments": (b"ccollections\nOrderedDict\n]]N\x85aNaa\x85R.", "calls something"),
    "a storage of a wanted size": (STORAGE + b"\x8a\x05\x00\x00\x00\x00\x7f\x85R.", "calls something"),
    "a storage with tuples as its name": (b"(X\x07\x00\x00\x00storage" + STORAGE + b"N\x85\x85NNtQ.", "else than text"),
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
