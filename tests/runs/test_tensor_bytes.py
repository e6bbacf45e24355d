"""Tensors as bytes: the content, and too little memory."""

import subprocess
import sys

import safetensors.torch
import torch

from rlcli.runs.tensor_bytes import tensor_bytes

LIMITED = """
import resource, torch
from rlcli.runs.tensor_bytes import tensor_bytes
tensors = {"a": torch.zeros(16 << 20)}
size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + (80 << 20), resource.RLIM_INFINITY))
try:
    tensor_bytes(tensors)
except MemoryError:
    print("too little memory")
"""


def test_bytes_hold_the_tensors_and_metadata(tmp_path):
    tensors = {"a": torch.arange(3.0), "b": torch.tensor([[True]]), "empty": torch.zeros(0, 2)}
    content = tensor_bytes(tensors, {"rlcli": "x"})
    read = safetensors.torch.load(content)
    assert read.keys() == tensors.keys()
    assert all(torch.equal(read[name], tensors[name]) for name in tensors)
    file = tmp_path / "file"
    file.write_bytes(content)
    with safetensors.safe_open(file, "pt") as opened:
        assert opened.metadata() == {"rlcli": "x"}


def test_too_little_memory_is_an_error_and_no_abort():
    done = subprocess.run([sys.executable, "-c", LIMITED], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "too little memory\n"), done.stderr
