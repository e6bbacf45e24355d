"""Tests of the Adam optimiser that does not import torch's compiler."""

import pytest
import torch

from rlcli.rl.optimizers import Adam, load_optimizer, optimizer_tensors


def train(kind, steps, **settings):
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(5, 7), torch.nn.Tanh(), torch.nn.Linear(7, 2))
    inputs = torch.randn(16, 5)
    optimizer = kind(network.parameters(), lr=1e-2, **settings)
    for _ in range(steps):
        optimizer.zero_grad()
        network(inputs).square().mean().backward()
        optimizer.step()
    return network, optimizer


def test_adam_matches_torch_bit_for_bit():
    for settings in ({}, {"fused": True, "eps": 1e-5}, {"weight_decay": 0.1}):
        (own, _), (theirs, _) = (train(kind, 6, **settings) for kind in (Adam, torch.optim.Adam))
        for mine, other in zip(own.parameters(), theirs.parameters(), strict=True):
            assert torch.equal(mine, other)


def test_step_builds_no_autograd_graph():
    network, _ = train(Adam, 2)
    assert all(parameter.is_leaf and parameter.grad_fn is None for parameter in network.parameters())


def test_step_calls_hooks():
    _, optimizer = train(Adam, 1)
    seen = []
    optimizer.register_step_pre_hook(lambda *_: seen.append("before"))
    optimizer.register_step_post_hook(lambda *_: seen.append("after"))
    optimizer.step()
    assert seen == ["before", "after"]


def test_state_of_more_parameters_is_refused():
    saved = optimizer_tensors(train(Adam, 1)[1], "o.")
    network = torch.nn.Linear(5, 7)
    with pytest.raises(ValueError, match=r"entry for parameter 2 \(counted from 0\).* only 2 parameters"):
        load_optimizer(Adam(network.parameters()), saved, "o.")


def test_state_can_be_exchanged_with_torch_adam():
    _, own = train(Adam, 3)
    _, theirs = train(torch.optim.Adam, 1)
    saved = optimizer_tensors(own, "o.")
    load_optimizer(theirs, saved, "o.")
    back = optimizer_tensors(theirs, "o.")
    assert saved.keys() == back.keys()
    assert all(torch.equal(saved[name], back[name]) for name in saved)
