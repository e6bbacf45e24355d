"""Any sequence of steps, partial resets, seeds, saves and restores agrees with plain MuJoCo."""

import copy
import math

import mujoco
import numpy as np
import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from support.fault_sizes import amount

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

N, LENGTH = 4, 9
"""Number of environments, and steps of an episode; a cart pushed in one direction leaves its track sooner."""
WEIGHTS = {"alive": 1.0, "terminating": -2.0, "pole_pos": -1.0, "cart_vel": -0.01, "pole_vel": -0.005}
CART, POLE = 0.5, 1.0
PUSHES = st.lists(st.sampled_from([-4.0, -1.0, -0.3, 0.0, 0.7, 1.0, 4.0]), min_size=N, max_size=N)


def build(threads):
    words = [f"scene.num_envs={N}", f"episode_length_s={LENGTH / 60:.6f}", f"sim.engine_threads={threads}"]
    words.append(f"terminations.cart_out_of_bounds.bounds=[-{CART * 2}, {CART * 2}]")
    return make_env(resolve(find_task("cartpole"), overrides=words), seed=1)


class Cartpole:
    """One cartpole on `mj_step`, with its MDP in plain Python."""

    def __init__(self, model):
        self.model, self.data, self.steps, self.total = model, mujoco.MjData(model), 0, 0.0

    def begin(self, qpos, qvel):
        """Start an episode from a state that the environment has drawn."""
        assert abs(qpos[0]) <= 1.0
        assert np.all(np.abs(qpos[1:]) <= 0.785 + 1e-6)
        assert abs(qvel[0]) <= 0.5 + 1e-6
        assert abs(qvel[1]) <= 0.785 + 1e-6
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        mujoco.mj_forward(self.model, self.data)
        self.steps, self.total = 0, 0.0

    def step(self, push):
        self.data.ctrl[:] = np.float32(push) * np.float32(100.0)
        mujoco.mj_step(self.model, self.data, 2)
        self.steps += 1
        pole = math.remainder(self.data.qpos[1], 2 * math.pi)
        terminated = abs(self.data.qpos[0]) > 2 * CART
        terms = {
            "alive": 1.0 - terminated,
            "terminating": 1.0 * terminated,
            "pole_pos": pole * pole,
            "cart_vel": abs(self.data.qvel[0]),
            "pole_vel": abs(self.data.qvel[1]),
        }
        reward = sum(WEIGHTS[name] * value for name, value in terms.items()) / 60.0
        self.total += reward
        return reward, terminated, self.steps >= LENGTH

    def observation(self):
        return np.concatenate([self.data.qpos, self.data.qvel]).astype(np.float32)


class VecEnvMachine(RuleBasedStateMachine):
    @initialize(seed=st.integers(0, 5))
    def start(self, seed):
        torch.set_num_threads(1)
        self.env, self.saved = build(1), []
        self.references = [Cartpole(self.env.engine.model) for _ in range(N)]
        self.obs = self.env.reset(seed=seed)["policy"]
        self._begin(range(N))

    def _begin(self, ids):
        qpos, qvel = self.env.engine.field("qpos").numpy(), self.env.engine.field("qvel").numpy()
        for i in ids:
            self.references[i].begin(qpos[i], qvel[i])

    @rule(pushes=PUSHES, times=st.integers(1, 6))
    def step(self, pushes, times):
        for _ in range(times):
            self._step(pushes, None)

    @rule(pushes=PUSHES, mask=st.lists(st.booleans(), min_size=N, max_size=N))
    def step_while_some_begin_again(self, pushes, mask):
        self._step(pushes, torch.tensor(mask))

    def _step(self, pushes, mask):
        result = self.env.step(torch.tensor(pushes)[:, None], restart=mask)
        self.obs = result.obs["policy"].clone()
        ended, again = [], []
        for i, reference in enumerate(self.references):
            if mask is not None and mask[i]:
                again.append(i)
                assert (float(result.reward[i]), bool(result.terminated[i]), bool(result.truncated[i])) == (0, 0, 0)
                continue
            reward, terminated, truncated = reference.step(pushes[i])
            assert abs(float(result.reward[i]) - reward) < 1e-5
            assert (bool(result.terminated[i]), bool(result.truncated[i])) == (terminated, truncated)
            if terminated or truncated:
                ended.append(i)
                assert np.array_equal(result.final_obs["policy"][i].numpy(), reference.observation())
                row = result.episodes.ids.tolist().index(i)
                assert int(result.episodes.lengths[row]) == reference.steps
                assert abs(float(result.episodes.returns[row]) - reference.total) < 1e-4
        assert (result.episodes is None) == (not ended)
        assert result.episodes is None or sorted(result.episodes.ids.tolist()) == ended
        self._begin(ended + again)

    @rule()
    def reset_all(self):
        self.obs = self.env.reset()["policy"].clone()
        self._begin(range(N))

    @rule(seed=st.integers(0, 5))
    def seed_again(self, seed):
        first = self.env.reset(seed=seed)["policy"].clone()
        self.obs = self.env.reset(seed=seed)["policy"].clone()
        assert torch.equal(first, self.obs)
        self._begin(range(N))

    @rule()
    def save(self):
        states = [(copy.copy(r.data), r.steps, r.total) for r in self.references]
        self.saved.append((self.env.state_dict(), states, self.obs.clone()))

    @precondition(lambda self: self.saved)
    @rule(which=st.integers(0, 9), elsewhere=st.booleans())
    def go_back(self, which, elsewhere):
        state, references, obs = self.saved[which % len(self.saved)]
        if elsewhere:
            self.env.close()
            self.env = build(2)
        assert torch.equal(self.env.load_state_dict(state)["policy"], obs)
        self.obs = obs
        for reference, (data, steps, total) in zip(self.references, references, strict=True):
            reference.data, reference.steps, reference.total = copy.copy(data), steps, total

    @invariant()
    def observations_agree(self):
        for i, reference in enumerate(self.references):
            assert np.array_equal(self.obs[i].numpy(), reference.observation()), i

    def teardown(self):
        if hasattr(self, "env"):
            self.env.close()


VecEnvMachine.TestCase.settings = settings(
    max_examples=amount(12, 200, 5000),
    stateful_step_count=15,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    database=None,
    derandomize=True,
)
test_any_sequence_agrees_with_plain_mujoco = VecEnvMachine.TestCase
