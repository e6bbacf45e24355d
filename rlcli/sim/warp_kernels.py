"""Warp kernels of the GPU engine: counter-based random numbers, the check for divergence, resets by mask.

Each kernel replaces about ten kernel launches of torch: in a CUDA graph, the number of launches determines the time.
"""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_ERROR  # keep Warp's messages out of the standard output of commands
wp.init()
# without code for gradients, which are not needed, kernels compile in half the time
wp.set_module_options({"enable_backward": False})

# constants of SplitMix64, as in `rlcli.random`
_GOLDEN = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
_MIX1 = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
_MIX2 = wp.constant(wp.uint64(0x94D049BB133111EB))
_TO_UNIT = wp.constant(wp.float32(2.0**-24))
_TOO_LARGE = wp.constant(wp.float32(1e10))  # mjMAXVAL
CAUSES = ("qpos not finite", "qpos out of bounds", "qvel not finite", "qvel out of bounds")
"""Causes of a divergence; `check_bounds` refers to them by index."""

_Rows = wp.array2d(dtype=float)
_Counters = wp.array(dtype=wp.int64)


@wp.func
def mix(x: wp.uint64) -> wp.uint64:
    """Return the output of SplitMix64's finaliser, as `rlcli.random.mix` does."""
    x = x ^ (x >> wp.uint64(30))
    x = x * _MIX1
    x = x ^ (x >> wp.uint64(27))
    x = x * _MIX2
    return x ^ (x >> wp.uint64(31))


@wp.func
def unit(start: wp.uint64, counter: wp.int64, stream: wp.uint64, env: int, index: int) -> float:
    """Return number `index` of a random stream, in [0, 1), with the same bits as `rlcli.random.uniform`."""
    key = mix(mix(wp.uint64(env) * _GOLDEN + start) + wp.uint64(counter) * _GOLDEN)
    word = mix(key + wp.uint64(index + 1) * _GOLDEN + stream)
    return wp.float32(word >> wp.uint64(40)) * _TO_UNIT


@wp.kernel
def draw_uniform(
    start: wp.uint64,
    counters: _Counters,
    stream: wp.uint64,
    index: int,
    num_streams: int,
    low: float,
    span: float,
    out: _Rows,
):
    """Draw uniform numbers in [low, low + span). out (num_envs, count)"""
    env, column = wp.tid()
    out[env, column] = unit(start, counters[env], stream, env % num_streams, index + column) * span + low


@wp.kernel
def draw_normal(start: wp.uint64, counters: _Counters, stream: wp.uint64, index: int, num_streams: int, out: _Rows):
    """Draw standard normal numbers with the Box-Muller transform. out (num_envs, count)"""
    env, column = wp.tid()
    count = out.shape[1]
    u = unit(start, counters[env], stream, env % num_streams, index + column)
    v = unit(start, counters[env], stream, env % num_streams, index + count + column)
    out[env, column] = wp.sqrt(-2.0 * wp.log(1.0 - u)) * wp.cos(2.0 * wp.pi * v)


@wp.kernel
def check_bounds(
    qpos: _Rows,
    qvel: _Rows,
    warmstart: _Rows,
    ctrl: _Rows,
    act: _Rows,
    overflow: wp.array(dtype=wp.int32),
    max_velocity: wp.float32,
    last_qpos: _Rows,
    last_qvel: _Rows,
    diverged: wp.array(dtype=wp.bool),
    counts: _Counters,
    first: wp.array(dtype=wp.int32),
    overflowed: wp.array(dtype=wp.int32),
):
    """Find worlds whose state is not finite, beyond MuJoCo's limit or too fast, and restore their last good state.

    Results: `diverged` marks these worlds. `counts` has the number of divergences by index of `CAUSES`. `first` has
    the first divergence since the start: 1 + index of the world, index of the cause, and column of the bad value.
    `overflowed` gets the bits of exceeded capacities, except those of diverged worlds.
    """
    world = wp.tid()
    bad = wp.int32(0)  # 0 or index in CAUSES + 1; wp.int32, because Warp treats a plain number as a constant
    column = wp.int32(0)
    for i in range(qvel.shape[1]):
        x = qvel[world, i]
        if not wp.isfinite(x):
            bad = wp.int32(3)
            column = i
        elif wp.abs(x) > max_velocity:
            bad = wp.int32(4)
            column = i
    for i in range(qpos.shape[1]):
        x = qpos[world, i]
        if bad != 1 and not wp.isfinite(x):
            bad = wp.int32(1)
            column = i
        elif bad != 1 and wp.abs(x) > _TOO_LARGE:
            bad = wp.int32(2)
            column = i
    diverged[world] = bad != 0
    if bad != 0:
        wp.atomic_add(counts, bad - 1, wp.int64(1))
        if wp.atomic_cas(first, 0, wp.int32(0), world + 1) == 0:
            first[1] = bad - 1
            first[2] = column
        overflow[world] = 0
        for i in range(qpos.shape[1]):
            qpos[world, i] = last_qpos[world, i]
        for i in range(qvel.shape[1]):
            qvel[world, i] = last_qvel[world, i]
            warmstart[world, i] = 0.0
        for i in range(ctrl.shape[1]):
            ctrl[world, i] = 0.0
        for i in range(act.shape[1]):
            act[world, i] = 0.0
    else:
        if overflow[world] != 0:
            overflowed[world] = overflowed[world] | overflow[world]
            overflow[world] = 0
        for i in range(qpos.shape[1]):
            last_qpos[world, i] = qpos[world, i]
        for i in range(qvel.shape[1]):
            last_qvel[world, i] = qvel[world, i]


@wp.kernel
def restore_diverged(diverged: wp.array(dtype=wp.bool), now: _Rows, last: _Rows):
    """Restore the rows of diverged worlds in `now` from `last`; save the rows of the other worlds to `last`."""
    world, column = wp.tid()
    if diverged[world]:
        now[world, column] = last[world, column]
    else:
        last[world, column] = now[world, column]


@wp.kernel
def save_rows(mask: wp.array(dtype=wp.bool), now: _Rows, last: _Rows):
    """Copy the masked rows of `now` to `last`, the values that `restore_diverged` restores."""
    world, column = wp.tid()
    if mask[world]:
        last[world, column] = now[world, column]


@wp.kernel
def reset_worlds(
    mask: wp.array(dtype=wp.bool),
    default_qpos: wp.array(dtype=float),
    default_qvel: wp.array(dtype=float),
    qpos: _Rows,
    qvel: _Rows,
    warmstart: _Rows,
    ctrl: _Rows,
    act: _Rows,
    time: wp.array(dtype=float),
):
    """Set the worlds where `mask` is true to the default state."""
    world = wp.tid()
    if mask[world]:
        time[world] = 0.0
        for i in range(qpos.shape[1]):
            qpos[world, i] = default_qpos[i]
        for i in range(qvel.shape[1]):
            qvel[world, i] = default_qvel[i]
            warmstart[world, i] = 0.0
        for i in range(ctrl.shape[1]):
            ctrl[world, i] = 0.0
        for i in range(act.shape[1]):
            act[world, i] = 0.0


@wp.kernel
def flag_nonfinite(values: _Rows, flag: wp.array(dtype=wp.int32), index: int):
    """Set `flag[index]` to 1 if a value is not finite."""
    row, column = wp.tid()
    if not wp.isfinite(values[row, column]):
        flag[index] = 1
