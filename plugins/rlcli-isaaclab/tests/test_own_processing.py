"""Modifiers, noise and observation classes of a task's own code: values, resets, and one call for each step."""

import pytest
import torch
from test_isaaclab_user_code import rover

from rlcli.envs.make import make_env
from rlcli_isaaclab.runtime import facade_of
from rlcli_isaaclab.utils.buffers import DelayBuffer, call_without_effects

torch.set_num_threads(1)
NOISE = "from isaaclab.utils.noise import NoiseCfg, NoiseModel, NoiseModelCfg, UniformNoiseCfg"
CODE = f"""
from collections import deque
from isaaclab.managers import ManagerTermBase
from isaaclab.utils import modifiers
from isaaclab.utils.buffers import DelayBuffer
{NOISE}

class Counter(modifiers.ModifierBase):
    def __init__(self, cfg, data_dim, device):
        super().__init__(cfg, data_dim, device)
        self.calls, self.all_calls, self.seen = torch.zeros(data_dim, device=device), 0, deque(maxlen=2)

    def reset(self, env_ids=None):
        self.calls[slice(None) if env_ids is None else env_ids] = 0.0

    def __call__(self, data):
        self.calls += self._cfg.increment
        self.all_calls += 1
        self.seen.append(self.calls)
        return data + self.calls

@configclass
class CounterCfg(modifiers.ModifierCfg):
    func: type = Counter
    increment: float = 1.0

class LateFilter(modifiers.DigitalFilter):
    pass

def doubled(data, factor=2.0):
    return factor * data

def shifted(data, cfg):
    return data + cfg.shift

@configclass
class ShiftCfg(NoiseCfg):
    func: object = shifted
    shift: float = 7.0

class Walk(NoiseModel):
    def __init__(self, noise_model_cfg, num_envs, device):
        super().__init__(noise_model_cfg, num_envs, device)
        self.walk = torch.zeros(num_envs, 1, device=device)

    def reset(self, env_ids=None):
        self.walk[env_ids] = torch.zeros(len(env_ids), 1)  # always with ids, as in Isaac Lab

    def __call__(self, data):
        self.walk += 1.0
        return super().__call__(data) + self.walk

@configclass
class WalkCfg(NoiseModelCfg):
    class_type: type = Walk
    noise_cfg: object = UniformNoiseCfg(n_min=0.5, n_max=0.5)

class Steps(ManagerTermBase):
    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.late = DelayBuffer(3, env.num_envs, env.device)
        self.late.set_time_lag(torch.full((env.num_envs,), 2))
        self.count = torch.zeros(env.num_envs, 1, device=env.device)

    def reset(self, env_ids=None):
        self.count[slice(None) if env_ids is None else env_ids] = 0.0
        self.late.reset(env_ids)

    def __call__(self, env):
        self.count += 1.0
        return torch.cat([self.count, self.late.compute(self.count)], dim=1)

def zero(env):
    return torch.zeros(env.num_envs, 1, device=env.device)
"""
VELOCITY = "ObservationTermCfg(func=mdp.base_lin_vel)"


def environment(folder, term, corrupt=True, extra=""):
    group = f"        enable_corruption = {corrupt}\n        velocity = {term}{extra}"
    folder.mkdir(exist_ok=True)
    return make_env(rover(folder / "task", CODE, [(f"        velocity = {VELOCITY}", group)]), seed=0)


def columns(env, steps):
    """Return the observation of every step. (steps + 1, num_envs, columns)"""
    action = torch.full((env.num_envs, env.layout.action_size), 0.5)
    first = env.reset()["policy"].clone()
    return torch.stack([first, *(env.step(action).obs["policy"].clone() for _ in range(steps))])


@pytest.mark.parametrize("func", ["zero", "mdp.base_lin_vel"])
def test_own_modifier_is_called_once_per_step(tmp_path, func):
    env = environment(tmp_path, f"ObservationTermCfg(func={func}, modifiers=[CounterCfg(increment=2.0)])")
    plain = columns(environment(tmp_path / "plain", f"ObservationTermCfg(func={func})"), 120)
    added = columns(env, 120) - plain  # an episode has 50 steps, and its last observation is computed as well
    steps = torch.tensor([1.0 + step % 50 for step in range(121)])
    torch.testing.assert_close(added, 2.0 * steps.view(-1, 1, 1).expand_as(added))


def test_own_modifier_among_others_and_a_clip(tmp_path):
    modifiers = (
        "[modifiers.ModifierCfg(func=modifiers.bias, params={'value': 3.0}),"
        " modifiers.ModifierCfg(func=doubled, params={'factor': 5.0}),"
        " modifiers.ModifierCfg(func=modifiers.clip, params={'bounds': (0.0, 14.0)})]"
    )
    env = environment(tmp_path, f"ObservationTermCfg(func=zero, modifiers={modifiers}, clip=(0.0, 13.5), scale=2.0)")
    assert torch.equal(columns(env, 2), torch.full((3, 4, 1), 27.0))
    assert [m["kind"] for m in env.layout.observations["policy"][0].modifiers] == ["clip"]


def test_own_filter_has_the_values_of_the_built_in_one(tmp_path):
    term = "ObservationTermCfg(func=Steps, modifiers=[{}])"
    weights = "A=[-0.5], B=[0.25, 0.25]"
    own = environment(tmp_path / "own", term.format(f"modifiers.DigitalFilterCfg(func=LateFilter, {weights})"))
    built_in = environment(tmp_path / "built_in", term.format(f"modifiers.DigitalFilterCfg({weights})"))
    torch.testing.assert_close(columns(own, 70), columns(built_in, 70))


@pytest.mark.parametrize("corrupt", [True, False])
def test_own_noise_function(tmp_path, corrupt):
    env = environment(tmp_path, "ObservationTermCfg(func=zero, noise=ShiftCfg(shift=6.0), scale=0.5)", corrupt)
    assert torch.equal(columns(env, 2), torch.full((3, 4, 1), 3.0 if corrupt else 0.0))


def test_own_noise_model_has_its_state(tmp_path):
    env = environment(tmp_path, "ObservationTermCfg(func=zero, noise=WalkCfg())")
    steps = torch.tensor([1.5 + step % 50 for step in range(121)])
    torch.testing.assert_close(columns(env, 120), steps.view(-1, 1, 1).expand(121, 4, 1))


def test_observation_class_is_called_once_per_step(tmp_path):
    values = columns(environment(tmp_path, "ObservationTermCfg(func=Steps)"), 120)
    steps = torch.tensor([1.0 + step % 50 for step in range(121)]).view(-1, 1).expand(121, 4)
    torch.testing.assert_close(values[..., 0], steps)
    torch.testing.assert_close(values[..., 1], (steps - 2.0).clamp(min=1.0))


def test_resumed_environment_goes_on_with_the_state_of_modifiers(tmp_path):
    term = "ObservationTermCfg(func=Steps, modifiers=[CounterCfg()])"
    first, second = (environment(tmp_path / name, term) for name in "ab")
    columns(first, 7)
    second.reset()
    restored = second.load_state_dict(first.state_dict())
    action = torch.zeros(4, first.layout.action_size)
    assert torch.equal(first.step(action).obs["policy"], second.step(action).obs["policy"]), restored


def test_call_without_effects_restores_tensors_buffers_containers_and_random_numbers():
    class Holder:
        def __init__(self):
            self.value, self.buffer, self.items = torch.zeros(2), DelayBuffer(2, 2, "cpu"), [torch.zeros(1)]

        def change(self):
            self.value += torch.rand(2)
            self.buffer.compute(self.value)
            self.items.append(self.value)
            self.items[0] += 1.0
            self.new = 3
            return self.value

    holder = Holder()
    value = holder.value
    generator = torch.get_rng_state()
    call_without_effects([holder], holder.change)
    assert holder.value is value
    assert not value.any()
    assert not hasattr(holder, "new")
    assert [item.tolist() for item in holder.items] == [[0.0]]
    assert holder.buffer._history._values is None
    assert torch.equal(torch.get_rng_state(), generator)


def test_term_reads_the_environment_of_an_own_modifier(tmp_path):
    env = environment(tmp_path, "ObservationTermCfg(func=zero, modifiers=[CounterCfg()])")
    assert facade_of(env).cfg.observations.policy.velocity.modifiers[0].increment == 1.0
