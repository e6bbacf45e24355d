"""Run drawn cases of a grammar one after another, and count their exit codes and the bad ones."""

import shutil
import time


def run_cases(run, first, count, folder=None):
    """Run `run(seed)` -> (exit code, what is wrong or "") for `count` seeds; print each bad case and the counts.

    `folder` is made empty before each case. Returns the number of bad cases.
    """
    codes, bad, slowest = {}, 0, 0.0
    for seed in range(first, first + count):
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        begin = time.process_time()
        code, wrong = run(seed)
        slowest = max(slowest, time.process_time() - begin)
        codes[str(code)] = codes.get(str(code), 0) + 1
        bad += bool(wrong)
        if wrong:
            print(f"seed {seed}: {wrong}", flush=True)
    ends = ", ".join(f"exit {code}: {number}" for code, number in sorted(codes.items()))
    print(f"{count} cases from seed {first}: {ends}; {bad} bad; slowest {slowest:.1f} s of processor time", flush=True)
    return bad
