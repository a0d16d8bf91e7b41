"""The evidential loss against closed forms and against sampling."""

from __future__ import annotations

import pytest
import torch
from torch.distributions import Dirichlet, kl_divergence

from ugat_marl.grounding.uncertainty import (
    annealing,
    concentration,
    divergence_from_uniform,
    evidential_loss,
    expected_probability,
    expected_squared_error,
    misleading,
    uncertainty,
)

RAGGED = torch.tensor([[1, 1, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1]], dtype=torch.bool)


def logits(seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (torch.randn(3, 4, generator=generator) * 3).double()


def test_no_evidence_is_uncertainty_one_and_the_uniform_guess_at_every_size() -> None:
    alpha = concentration(torch.full((3, 4), -1e4), RAGGED)
    assert uncertainty(alpha, RAGGED).tolist() == [1.0, 1.0, 1.0]
    assert expected_probability(alpha)[0].tolist() == [0.5, 0.5, 0.0, 0.0]
    assert divergence_from_uniform(alpha, RAGGED).abs().max() < 1e-6


def test_uncertainty_is_classes_over_total_by_hand() -> None:
    alpha = torch.tensor([[3.0, 1.0, 0.0, 0.0], [5.0, 2.0, 3.0, 0.0], [1.0, 1.0, 1.0, 13.0]])
    assert uncertainty(alpha, RAGGED).tolist() == pytest.approx([2 / 4, 3 / 10, 4 / 16])


def test_divergence_equals_torchs_own_for_every_row_without_its_masked_classes() -> None:
    alpha = concentration(logits(), RAGGED)
    ours = divergence_from_uniform(alpha, RAGGED)
    for row, mask, found in zip(alpha, RAGGED, ours, strict=True):
        own = row[mask]
        expected = kl_divergence(Dirichlet(own), Dirichlet(torch.ones_like(own)))
        assert found.item() == pytest.approx(expected.item(), abs=1e-9)


def test_the_slope_of_the_divergence_is_that_of_finite_differences_and_of_torchs_own() -> None:
    alpha = concentration(logits(), RAGGED).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: divergence_from_uniform(a, RAGGED), (alpha,))
    weights = torch.tensor([1.0, -2.0, 0.5]).double()
    (slope,) = torch.autograd.grad((weights * divergence_from_uniform(alpha, RAGGED)).sum(), alpha)
    for row, k in enumerate((2, 3, 4)):
        own = alpha[row, :k].detach().requires_grad_()
        apart = kl_divergence(Dirichlet(own), Dirichlet(torch.ones(k).double()))
        (expected,) = torch.autograd.grad(weights[row] * apart, own)
        assert torch.allclose(slope[row, :k], expected)
        assert (slope[row, k:] == 0).all()


def test_squared_error_equals_its_mean_over_sampled_probabilities() -> None:
    torch.manual_seed(0)
    alpha = concentration(logits(), RAGGED)
    target = torch.tensor([1, 0, 2])
    ours = expected_squared_error(alpha, target)
    for row, mask, label, found in zip(alpha, RAGGED, target, ours, strict=True):
        p = Dirichlet(row[mask]).sample((200_000,))
        y = torch.nn.functional.one_hot(label, int(mask.sum()))
        assert found.item() == pytest.approx(((y - p) ** 2).sum(-1).mean().item(), abs=5e-3)


def test_masked_classes_change_neither_loss_nor_gradient() -> None:
    target = torch.tensor([1, 0, 2])
    one = logits().requires_grad_()
    two = torch.where(RAGGED, logits(), 77.0).requires_grad_()
    for outputs in (one, two):
        loss = evidential_loss(concentration(outputs, RAGGED), target, RAGGED, 0.7)
        loss.sum().backward()
    assert one.grad is not None and two.grad is not None
    assert torch.equal(one.grad[~RAGGED], torch.zeros_like(one.grad[~RAGGED]))
    assert torch.equal(one.grad, two.grad)


def test_a_masked_row_has_the_loss_of_a_row_that_never_had_the_class() -> None:
    wide = evidential_loss(concentration(logits(), RAGGED), torch.tensor([1, 0, 2]), RAGGED, 1.0)
    full = torch.ones(1, 2, dtype=torch.bool)
    narrow = evidential_loss(
        concentration(logits()[:1, :2], full), torch.tensor([1]), full, kl_weight=1.0
    )
    assert wide[0].item() == pytest.approx(narrow[0].item(), abs=1e-12)


def test_evidence_for_the_truth_is_not_misleading() -> None:
    alpha = torch.tensor([[9.0, 1.0, 1.0], [9.0, 4.0, 1.0]])
    assert misleading(alpha, torch.tensor([0, 0])).tolist() == [[1, 1, 1], [1, 4, 1]]
    mask = torch.ones(2, 3, dtype=torch.bool)
    kl = evidential_loss(alpha, torch.tensor([0, 0]), mask, 1.0) - expected_squared_error(
        alpha, torch.tensor([0, 0])
    )
    assert kl[0].item() == pytest.approx(0.0, abs=1e-6) and kl[1].item() > 0.1


def test_loss_prefers_evidence_for_the_truth() -> None:
    mask = torch.ones(3, 3, dtype=torch.bool)
    alpha = torch.tensor([[20.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 20.0, 1.0]])
    right, none, wrong = evidential_loss(alpha, torch.zeros(3, dtype=torch.long), mask, 1.0)
    assert right < none < wrong


def test_annealing_rises_to_one_and_stays() -> None:
    assert [annealing(epoch) for epoch in (0, 5, 10, 50)] == [0.0, 0.5, 1.0, 1.0]
    assert annealing(0, epochs=0) == 1.0
