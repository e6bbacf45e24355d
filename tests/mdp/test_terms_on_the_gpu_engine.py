"""Every term can be captured on a GPU: no host reads, no new tensors of Python numbers, and the same values."""

import contextlib
import copy
import inspect
from types import SimpleNamespace

import pytest
import torch
from support.mdp_table import OBSERVATIONS, REWARDS, ROWS, TERMINATIONS
from support.mdp_worlds import FILES, bound, hand_made, sensors, whole_task
from support.worlds import build, edited, write

from rlcli.mdp import observations, rewards
from rlcli.scene.entity import Entity
from rlcli.testing.host_sync import HostSyncGuard

pytestmark = pytest.mark.warp
torch.set_num_threads(1)


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    return [hand_made(tmp_path_factory.mktemp(engine), f"sim.engine={engine}") for engine in ("batch", "warp")]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0].__name__)
def test_captured_term_matches_cpu_engine(both, row):
    term, kwargs, _ = row
    values = []
    for env in both:
        params = bound(env, kwargs, sensors())
        call = term(env, **params) if inspect.isclass(term) else lambda env=env, params=params: term(env, **params)
        first = call().clone()
        env.sim.stamp += 1  # without a memory of the first call
        with HostSyncGuard() if env.engine.asynchronous else contextlib.nullcontext():
            again = call()
        assert torch.equal(first, again) or term is rewards.ActionAccL2
        values.append(first.float())
    torch.testing.assert_close(*values, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0].__name__)
def test_term_is_bit_identical_for_any_num_envs(both, row):
    term, kwargs, _ = row
    env = both[0]
    params = bound(env, kwargs, sensors())
    value = (term(env, **params)() if inspect.isclass(term) else term(env, **params)).clone()
    again = []
    for count in (1, 2, 37):  # the same arithmetic on repeated rows
        repeated = _Repeated(env, count)
        params = bound(repeated, kwargs, {name: repeated.of(part) for name, part in sensors().items()})
        again.append((term(repeated, **params)() if inspect.isclass(term) else term(repeated, **params)).clone())
        assert len(again[-1]) == 3 * count
        assert (again[-1].view(count, *value.shape) == value).all()


class _Repeated:
    """Environment whose rows are those of another environment, repeated."""

    def __init__(self, env, count):
        self.count, self.num_envs = count, env.num_envs * count
        self.config, self.device, self.step_dt = env.config, env.device, env.step_dt
        self.max_episode_length = env.max_episode_length
        self.origins, self.episode_length_buf = self._rows(env.origins), self._rows(env.episode_length_buf)
        manager = env.termination_manager
        self.termination_manager = SimpleNamespace(
            terminated=self._rows(manager.terminated), time_outs=self._rows(manager.time_outs),
            fired={name: self._rows(fired) for name, fired in manager.fired.items()},
        )  # fmt: skip
        self.action_manager = SimpleNamespace(
            action=self._rows(env.action_manager.action), prev_action=self._rows(env.action_manager.prev_action)
        )
        engine = SimpleNamespace(
            model=env.engine.model, num_envs=self.num_envs, device=env.device,
            field=lambda name: self._rows(env.engine.field(name)),
            expanded=lambda name: None if env.engine.expanded(name) is None else self._rows(env.engine.expanded(name)),
        )  # fmt: skip
        self.sim = SimpleNamespace(
            engine=engine, qpos=self._rows(env.sim.qpos), qvel=self._rows(env.sim.qvel), stamp=0,
            derived_field=lambda name: self._rows(env.sim.derived_field(name)),
            derived_columns=lambda name, columns: self._rows(env.sim.derived_columns(name, columns)),
            once_per_goal=lambda key, command, compute: compute(),
        )  # fmt: skip
        self.entities = {name: Entity(name, e.config, engine, self.sim) for name, e in env.entities.items()}

    def _rows(self, values):
        return values.repeat(self.count, *[1] * (values.dim() - 1))

    def of(self, part):
        new = copy.copy(part)
        for name, values in vars(part).items():
            if torch.is_tensor(values):
                setattr(new, name, self._rows(values))
        return new


def test_detector_finds_uncapturable_operations():
    values = torch.arange(4.0)
    readings = [
        lambda: values[values > 1],
        lambda: float(values.sum()),
        lambda: (values > 1).nonzero(),
        lambda: values + torch.tensor([1.0, 2.0, 3.0, 4.0]),
    ]
    for reading in readings:
        with pytest.raises(AssertionError), HostSyncGuard():
            reading()


FORCES = """
decimation: 2
episode_length_s: 0.05
sim: {dt: 0.005, engine: warp}
scene: {num_envs: 3, entities: {robot: {model: box.xml}}}
actions: {push: {func: joint_effort}}
observations: {policy: {wrench: {func: body_incoming_wrench}}}
rewards: {acc: {func: body_lin_acc_l2, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
"""
BOX = """<mujoco><worldbody><body name="b" pos="0 0 0.1"><freejoint/><geom size="0.1" mass="1"/>
<body name="arm"><joint name="j" axis="0 1 0"/><geom size="0.01" pos="0 0 0.3" mass="0.1"/></body></body></worldbody>
</mujoco>"""


def test_steps_with_body_force_terms_are_captured(tmp_path):
    env = build(write(tmp_path / "box", edited(FORCES), box_xml=BOX))
    env.reset()
    action = torch.ones(3, 1)
    env.step(action)
    with HostSyncGuard():
        results = [env.step(action) for _ in range(7)]
    assert all(r.reward.isfinite().all() for r in results)
    assert results[-1].obs["policy"].abs().max() > 0.1
    assert observations.body_incoming_wrench.reads_body_forces


def test_task_with_every_term_is_captured(tmp_path):
    rows = {"observations": OBSERVATIONS, "rewards": REWARDS, "terminations": TERMINATIONS}
    folder = write(tmp_path / "all", whole_task(rows, engine="warp"), **FILES)
    env = build(folder, 3, "episode_length_s=0.1", "sim.dt=0.01", "decimation=2")
    env.reset()
    action = 0.3 * torch.ones(3, 4)
    env.step(action)
    with HostSyncGuard():
        results = [env.step(action) for _ in range(12)]
    env.check()
    assert sum(int(r.episodes.mask.sum()) for r in results) >= 6
    assert all(r.reward.isfinite().all() and r.obs["policy"].isfinite().all() for r in results)


def test_task_with_every_term_is_independent_of_num_envs(tmp_path):
    rows = {"observations": OBSERVATIONS, "rewards": REWARDS, "terminations": []}
    folder = write(tmp_path / "all", whole_task(rows), **FILES)
    few, many = build(folder, 2, "episode_length_s=0.1"), build(folder, 19, "episode_length_s=0.1")
    first = [env.reset()["policy"] for env in (few, many)]
    assert torch.equal(first[0], first[1][:2])
    for step in range(12):
        action = torch.full((19, 4), 0.3 * (-1) ** step)
        left, right = few.step(action[:2]), many.step(action)
        assert torch.equal(left.obs["policy"], right.obs["policy"][:2])
        assert torch.equal(left.reward, right.reward[:2])
