"""Wider products: as precise as before, and nothing left behind."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from ugat_marl.grounding import networks
from ugat_marl.grounding.networks import MANY, full_width
from ugat_marl.seeding import torch_generator

SETTING: Any = getattr(torch.backends.mkldnn, "matmul", None)
settable = pytest.mark.skipif(SETTING is None, reason="this torch has no such setting")


def error() -> float:
    """Largest error of products of 128 numbers each."""
    generator = torch_generator(1)
    one, two = (torch.randn(MANY, 64, 128, generator=generator) for _ in range(2))
    exact = torch.bmm(one.double(), two.double().transpose(1, 2))
    return float((torch.bmm(one, two.transpose(1, 2)) - exact).abs().max())


def test_products_are_as_precise_as_float32() -> None:
    with full_width(MANY):
        assert error() < 1e-4  # bfloat16 is off by 0.1


@settable
def test_the_setting_is_put_back_even_after_an_error() -> None:
    before = SETTING.fp32_precision
    with pytest.raises(ZeroDivisionError), full_width(MANY):
        raise ZeroDivisionError
    assert SETTING.fp32_precision == before


@settable
def test_few_networks_and_choices_of_the_user_are_left_alone() -> None:
    before = SETTING.fp32_precision
    with full_width(MANY - 1):
        assert SETTING.fp32_precision == before
    SETTING.fp32_precision = "ieee"
    try:
        with full_width(MANY):
            assert SETTING.fp32_precision == "ieee"
    finally:
        SETTING.fp32_precision = before


@settable
def test_a_processor_that_would_round_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    product, before = torch.bmm, SETTING.fp32_precision

    def rounding(one: torch.Tensor, two: torch.Tensor) -> torch.Tensor:
        return product(one.bfloat16().float(), two)

    monkeypatch.setattr(torch, "bmm", rounding)
    networks._is_exact.cache_clear()
    try:
        with full_width(MANY):
            assert SETTING.fp32_precision == before
    finally:
        networks._is_exact.cache_clear()


def test_members_get_the_same_rows_or_each_its_own() -> None:
    shared = torch.arange(2 * 3 * 4).view(2, 3, 4)
    assert torch.equal(networks.member_rows(shared, 5), shared.repeat(5, 1, 1))
    own = torch.arange(2 * 5 * 3 * 4).view(2, 5, 3, 4)
    rows = networks.member_rows(own, 5)
    assert torch.equal(rows, torch.stack([own[a, m] for m in range(5) for a in range(2)]))
