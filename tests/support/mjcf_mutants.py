"""Mutants of the built-in models, read and compiled in child processes with limits."""

import os
import random
import signal
import sys
import warnings
from pathlib import Path

from rlcli.scene.untrusted_mjcf import read_mjcf

SEEDS = [Path(__file__).parents[2] / place for place in (
    "tasks/rlcli_tasks/ant/ant.xml", "tasks/rlcli_tasks/cartpole/cartpole.xml",
    "plugins/rlcli-oige/rlcli_oige/models/humanoid.xml",
)]  # fmt: skip
WORDS = [
    b"nan", b"inf", b"-1", b"0", b"1e400", b"1e30", b"1000000000", b"99999999999999999999", b'"', b"<", b">", b"/>",
    b"<replicate count='100000'>", b"</replicate>", b"<include file='/etc/passwd'/>", b"\0", b"\xff", b"&amp;",
    b"<!--", b"-->", b"<![CDATA[", b"<body>", b"</body>", b"<joint type='free'/>", b"<geom size='0 0 0'/>", b" ",
    b"<flexcomp name='f' type='grid' count='9 9 9' spacing='.1 .1 .1'/>", b"<option timestep='nan'/>",
]  # fmt: skip
BATCH = 40


def mutant(draw):
    data = bytearray(draw.choice(SEEDS).read_bytes())
    for _ in range(draw.randint(1, 6)):
        at, kind = draw.randrange(len(data)), draw.randrange(5)
        if kind == 0:
            data[at] = draw.randrange(256)
        elif kind == 1:
            data[at:at] = draw.choice(WORDS)
        elif kind == 2:
            del data[at : at + draw.randint(1, 40)]
        elif kind == 3:
            other = draw.randrange(len(data))
            data[at:at] = data[other : other + draw.randint(1, 200)]
        else:
            digits = [i for i in range(at, min(at + 300, len(data))) if 48 <= data[i] < 58]
            if digits:
                data[digits[0] : digits[0] + 1] = draw.choice(WORDS[:8])
    return bytes(data)


def try_mutants(seed, folder):
    """Read and compile mutants in a child process; return 0 if each was accepted or refused with a message."""
    import resource

    signal.alarm(600)
    resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    draw, taken = random.Random(seed), 0
    file = folder / "model.xml"
    for _ in range(BATCH):
        data = mutant(draw)
        file.write_bytes(data)
        try:
            read_mjcf(file, [folder]).compile()
            taken += 1
        except ValueError:
            pass  # an error message of rlcli or of MuJoCo's compiler
    return 0 if taken < BATCH else 3


def main(first, count, folder):
    """Run one child per seed, forked from a process without threads; report the last message about its mutants."""
    for seed in range(first, first + count):
        child = os.fork()
        if child == 0:
            code = 1
            try:
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, 2)
                code = try_mutants(seed, folder)
            finally:
                os._exit(code)
        _, status = os.waitpid(child, 0)
        if status:
            ended = signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)
            print(f"seed {seed} ended with {ended}:", (folder / "model.xml").read_bytes())
            return 1
        print(f"seed {seed}: taken or refused", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])))
