"""Model and instruction sets of this machine's processor, by which math libraries choose their kernels."""

import contextlib
import hashlib
import platform
import re
from pathlib import Path


def processor(info: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """Return the processor's `model`, its vector instruction sets (`kernels`) and a hash of all its `flags`.

    Math libraries choose their kernels by the instruction sets, so results may differ in the last bits between two
    processors.
    """
    entries: dict[str, str] = {}
    with contextlib.suppress(OSError), info.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            key, colon, value = line.partition(":")
            if not colon:
                break  # an empty line: the block of the first core ends here
            entries[key.strip()] = value.strip()
    model = entries.get("model name") or platform.processor() or platform.machine()
    flags = sorted((entries.get("flags") or entries.get("Features") or "").split())
    kernels = [flag for flag in flags if re.match(r"avx|fma|sse4|amx|sve|asimd|neon|f16c", flag)]
    record = {"model": model, "kernels": " ".join(kernels)}
    return record | ({"flags": hashlib.sha256(" ".join(flags).encode()).hexdigest()} if flags else {})


def has_onednn() -> bool:
    """Return whether torch can use oneDNN, a library with fast CPU kernels."""
    import torch

    return bool(torch.backends.mkldnn.is_available())  # type: ignore[no-untyped-call]  # torch has no type here
