"""Code that names the device `cuda` on a machine without a GPU."""

import pytest
import torch

from rlcli.machine.device_names import on_cpu

CALLS = {
    "factory": lambda x: torch.zeros(3, device="cuda"),
    "number of the device": lambda x: torch.rand(3, device="cuda:0"),
    "device object": lambda x: torch.ones(3, device=torch.device("cuda")),
    "of data": lambda x: torch.tensor([1.0], device="cuda"),
    "like": lambda x: torch.zeros_like(x, device="cuda"),
    "to": lambda x: x.to("cuda"),
    "to with type": lambda x: x.to(device="cuda", dtype=torch.float64),
    "cuda": lambda x: x.cuda(),
    "module": lambda x: torch.nn.Linear(3, 3).to("cuda")(x),
    "module cuda": lambda x: torch.nn.Linear(3, 3).cuda()(x),
}


@pytest.mark.parametrize("name", CALLS)
def test_cuda_is_the_cpu(name):
    assert on_cpu(CALLS[name])(torch.ones(3)).device.type == "cpu"


def test_other_devices_stay():
    assert on_cpu(lambda: torch.zeros(3, device="meta"))().device.type == "meta"


def test_context_ends_after_an_error():
    def fail():
        raise ValueError("x")

    with pytest.raises(ValueError, match="x"):
        on_cpu(fail)()
    if not torch.cuda.is_available():
        with pytest.raises((AssertionError, RuntimeError)):
            torch.zeros(3, device="cuda")
