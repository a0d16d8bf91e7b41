"""Networks of every method by hand and alone: masks, members, thinning, and what u may be."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ugat_marl.data import AgentLayout
from ugat_marl.errors import OptionError
from ugat_marl.grounding import UNCERTAINTY_METHODS, FitConfig, InverseConfig, InverseModel, Stack
from ugat_marl.grounding.uncertainty import (
    DropoutNet,
    EnsembleNet,
    EvidentialNet,
    LossArguments,
    Method,
    MethodName,
    NetShape,
    PlainNet,
    divergence,
    divergence_from_even,
    negative_log_likelihood,
    normalised_entropy,
    thinned,
)
from ugat_marl.seeding import torch_generator

LAYOUTS = {"two_0": AgentLayout(3, 2), "three_0": AgentLayout(3, 3, 1)}
STACK = Stack(LAYOUTS)
SHAPE = NetShape((4, 6), (8, 8), 5, STACK.valid_actions[:, None, :])
ALONE = NetShape((4,), (8, 8), 5, STACK.valid_actions[:1, None, :])


def loss_arguments(held_out: bool = False) -> LossArguments:
    """Nothing off the data; 90 and 70 rows."""
    return LossArguments(
        held_out,
        torch_generator(3),
        torch.tensor([90.0, 70.0]),
        1.0,
        0.1,
        0.0,
        lambda count: torch.zeros(2, count, 6),
    )


def test_members_trained_at_once_are_each_trained_for_themselves() -> None:
    together = EnsembleNet(SHAPE, torch_generator(0), members=3)
    inputs = torch.randn(2, 3, 11, 6, generator=torch_generator(1))
    target = torch.randint(2, (2, 3, 11), generator=torch_generator(2))
    loss = together.loss(inputs, target, loss_arguments())
    assert loss.shape == (2, 3, 11)
    loss.sum().backward()
    for m in range(3):
        alone = PlainNet(SHAPE, torch_generator(9))
        parts = dict(together.named_parameters())
        for name, part in alone.named_parameters():
            part.data.copy_(parts[name].detach().view(3, *part.shape)[m])
        own = alone.loss(inputs[:, m], target[:, m], loss_arguments())
        assert torch.allclose(own, loss[:, m], atol=1e-6)
        own.sum().backward()
        for name, part in alone.named_parameters():
            whole = parts[name].grad
            assert whole is not None and part.grad is not None
            assert torch.allclose(whole.view(3, *part.shape)[m], part.grad, atol=1e-4), name


@pytest.mark.parametrize("members", [0, 1, 3])
def test_one_pass_claims_and_errs_as_two_would(members: int) -> None:
    if members:
        net = EnsembleNet(SHAPE, torch_generator(0), members)
    else:
        net = EvidentialNet(SHAPE, torch_generator(0))
    generator, own = torch_generator(1), (2, members) if members > 1 else (2,)
    inputs = torch.randn(*own, 11, 6, generator=generator)
    target = torch.randint(2, (*own, 11), generator=generator)
    off = torch.randn(2, 6, 6, generator=generator)
    asked = dataclasses.replace(
        loss_arguments(), off_data_weight=0.3, invent=lambda count: off[:, :count]
    )
    everyones = off[:, None].expand(-1, members, -1, -1) if members > 1 else off
    claimed = net.certainty(net.outputs(everyones, asked)).mean(-1, keepdim=True)
    expected = net.loss(inputs, target, loss_arguments()) + 0.3 * claimed
    assert claimed.abs().min() > 1e-5
    assert torch.allclose(net.loss(inputs, target, asked), expected, atol=1e-6)


def test_thinning_leaves_out_the_share_it_is_told_to_and_keeps_the_mean() -> None:
    draw = torch.rand(200_000, generator=torch_generator(0))
    for p in (0.1, 0.5, 0.8):
        logit = torch.tensor(p).logit()
        out = thinned(torch.ones(200_000), logit, draw)
        assert float((out < 0.5 / (1 - p)).float().mean()) == pytest.approx(p, abs=0.01)
        assert float(out.mean()) == pytest.approx(1.0, abs=0.05)


def test_the_divergence_of_a_layer_by_hand() -> None:
    weight, logit = torch.tensor([[3.0, 4.0]]), torch.tensor(0.25).logit()
    entropy = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75))
    expected = 0.01**2 / 2 * 25 / 0.75 - 7 * entropy
    assert float(divergence(weight, logit, 7)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("method", UNCERTAINTY_METHODS)
def test_an_intersection_learns_the_same_in_company_as_alone(method: MethodName) -> None:
    """Gradients of an encoder, with more phases and inputs beside it; the head is shared."""
    config = InverseConfig(hidden=(8, 8), embedding=5)
    how = Method(method, members=2, passes=3)
    wide = {"two_0": LAYOUTS["two_0"], "wide_0": AgentLayout(5, 4)}
    both = InverseModel(Stack(wide), config, torch_generator(0), how)
    alone = InverseModel(Stack({"two_0": LAYOUTS["two_0"]}), config, torch_generator(1), how)
    parts, own = dict(both.net.named_parameters()), dict(alone.net.named_parameters())
    for name, part in own.items():
        part.data.copy_(share(parts[name].detach(), part, both.net.members))
    inputs = torch.randn(2, 9, 14, generator=torch_generator(2)) * both.valid_inputs
    target = torch.randint(2, (2, 9), generator=torch_generator(3))
    if method == "ensemble":
        target = target[:, None].expand(-1, 2, -1)
    together = both.net.loss(taking(inputs, method), target, loss_arguments(held_out=True))
    apart = alone.net.loss(
        taking(inputs[:1, :, :8], method), target[:1], loss_arguments(held_out=True)
    )
    assert torch.allclose(together[:1], apart, atol=1e-6)
    together[0].sum().backward()
    apart.sum().backward()
    for name, part in own.items():
        gradient = parts[name].grad
        if part.grad is None:
            continue
        assert gradient is not None
        assert torch.allclose(share(gradient, part, both.net.members), part.grad, atol=1e-5), name


def test_a_narrow_intersection_is_thinned_in_company_as_alone() -> None:
    """Its rates see its own inputs only, and rows of its own; the head's rate sees all rows."""
    wide, narrow = (DropoutNet(shape, torch_generator(0), 2) for shape in (SHAPE, ALONE))
    parts = dict(wide.named_parameters())
    for name, part in narrow.named_parameters():
        part.data.copy_(share(parts[name].detach(), part, 1))
    rows = torch.tensor([90.0, 70.0])
    for net, own in ((wide, rows), (narrow, rows[:1])):
        net._divergence(own).sum().backward()  # pyright: ignore[reportPrivateUsage]
    for name, part in narrow.named_parameters():
        gradient = parts[name].grad
        if not name.endswith("bias") and "head" not in name and name != "slow_logits.3":
            assert gradient is not None and part.grad is not None
            assert torch.allclose(share(gradient, part, 1), part.grad, rtol=1e-5), name
    head, own = parts["slow_logits.3"].grad, narrow.slow_logits[3].grad
    assert head is not None and own is not None
    assert float(head) == pytest.approx(float(own) * 90 * 2 / 160, rel=1e-4)


def taking(inputs: torch.Tensor, method: MethodName) -> torch.Tensor:
    return inputs[:, None].expand(-1, 2, -1, -1) if method == "ensemble" else inputs


def share(whole: torch.Tensor, part: torch.Tensor, members: int) -> torch.Tensor:
    """The first agent's part of a parameter, and its phases of the head."""
    if part.dim() == 3 and len(part) == members:
        rows = whole.view(members, -1, *whole.shape[1:])[:, 0]
        return rows[:, : part.shape[1], : part.shape[2]]
    if part.dim() == 3:
        return whole[:1]
    each = whole.view(members, -1, *whole.shape[1:])
    return each[:, : len(part) // members].reshape(part.shape)


@pytest.mark.parametrize("method", UNCERTAINTY_METHODS)
def test_the_weights_of_a_phase_that_is_missing_change_nothing(method: MethodName) -> None:
    how = Method(method, members=2, passes=3)
    h = InverseModel(STACK, InverseConfig(hidden=(8,), embedding=5), torch_generator(0), how)
    rows = torch.randn(2, 20, 10, generator=torch_generator(1))
    with torch.no_grad():
        before = h.answer(rows)
        h.net.head.weight.view(h.net.members, 3, -1)[:, 2] += 50.0
        after = h.answer(rows)
    assert torch.equal(before.u[0], after.u[0])
    assert torch.equal(before.probability[0], after.probability[0])
    assert not before.probability[0, :, 2].any()
    assert not torch.equal(before.probability[1], after.probability[1])


@given(
    st.sampled_from(UNCERTAINTY_METHODS),
    st.integers(0, 10_000),
    st.floats(-1e4, 1e4),
    st.integers(1, 4),
)
def test_u_is_from_zero_to_one_whatever_comes(
    method: MethodName, seed: int, scale: float, phases: int
) -> None:
    stack = Stack({"one_0": AgentLayout(2, phases), "two_0": AgentLayout(3, 5)})
    config = InverseConfig(hidden=(6,), embedding=4)
    h = InverseModel(stack, config, torch_generator(seed), Method(method, 2, 3))
    with torch.no_grad():
        for part in h.net.head.parameters():
            part.mul_(scale)
        found = h.answer(scale * torch.randn(2, 6, 11, generator=torch_generator(seed, "x")))
    assert (found.u >= 0).all() and (found.u <= 1).all()
    assert torch.allclose(found.probability.sum(-1), torch.ones(2, 6), atol=1e-5)
    assert (found.probability >= 0).all() and not found.probability[0, :, phases:].any()
    assert (found.action[0] < phases).all()


def test_entropy_and_likelihood_by_hand() -> None:
    mask = torch.tensor([[True, True, False], [True, True, True], [True, False, False]])
    p = torch.tensor([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert normalised_entropy(p, mask).tolist() == [1.0, 0.0, 0.0]
    quarter = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75)) / np.log(2)
    p = torch.tensor([0.25, 0.75, 0.0])
    assert float(normalised_entropy(p, mask[0])) == pytest.approx(quarter)
    logits = torch.tensor([[1.0, 1.0, 99.0], [0.0, 0.0, 0.0], [3.0, 9.0, 9.0]])
    expected = [np.log(2), np.log(3), 0.0]
    zeros = torch.zeros(3, dtype=torch.long)
    assert negative_log_likelihood(logits, zeros, mask).tolist() == pytest.approx(expected)
    assert divergence_from_even(logits, mask).tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    logits = torch.tensor([1.0, 3.0, 2.0])
    even = torch.full((3,), 1 / 3)
    expected_kl = torch.nn.functional.kl_div(logits.log_softmax(-1), even, reduction="sum")
    own = divergence_from_even(logits, mask[1])
    assert float(own) == pytest.approx(float(expected_kl), rel=1e-5)


@pytest.mark.parametrize(
    "options", [{"uncertainty": "bayes"}, {"members": 0}, {"passes": 0}, {"members": 10**9}]
)
def test_impossible_methods_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=f"{next(iter(options))}.*allowed"):
        FitConfig(**options)
