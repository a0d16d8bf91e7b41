"""Numbers as texts: no sign of zero, and no 1.00 for what is not the best."""

from __future__ import annotations

import math

import pytest

from ugat_marl.experiments import Interval
from ugat_marl.reporting.formats import (
    mean_text,
    number,
    number_text,
    percent_text,
    share,
    share_text,
    signed_text,
)
from ugat_marl.reporting.service_tables import delay_text


@pytest.mark.parametrize(
    ("value", "texts"),
    [
        (-0.001, ("-0.00", "−0.00", "−0 %")),
        (-0.0, ("-0.00", "−0.00", "−0 %")),
    ],
)
def test_what_rounds_to_zero_has_no_sign(value: float, texts: tuple[str, ...]) -> None:
    shown = (number_text(value), share_text(value), percent_text(value), share(value))
    assert not set(shown) & set(texts)
    assert shown == ("0.00", "0.00", "0 %", "0 %")
    assert number(-0.0) == "0"
    assert signed_text(value) == signed_text(-value) == "0.00"


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.0, "1.00"), (0.996, "0.996"), (0.9996, "0.9996"), (0.99999, "0.9999"), (0.25, "0.25"),
     (-3.39, "−3.39"), (1.004, "1.00"), (math.nan, "–")],
)  # fmt: skip
def test_only_the_best_share_is_one(value: float, text: str) -> None:
    assert share_text(value) == text


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (Interval(7.0, 6.5, 7.5), "7.0 (6.5–7.5)"),
        (Interval(0.0, -2.0, 2.0), "0.00 (-2.0 to 2.0)"),
        (Interval(7.0, 7.0, 7.0), "7.0"),
        (Interval(7.0, math.nan, math.nan), "7.0"),
    ],
)
def test_a_mean_has_its_interval_if_there_is_one(interval: Interval, text: str) -> None:
    assert mean_text(interval) == text


def test_changes_keep_their_sign() -> None:
    assert [percent_text(x) for x in (0.25, -0.25, 0.001)] == ["+25 %", "−25 %", "0 %"]
    assert [signed_text(x) for x in (0.25, -0.25, 250.0)] == ["+0.25", "-0.25", "+250"]


@pytest.mark.parametrize(
    ("delay_s", "text"),
    [
        (10.0, "10.0 A"),
        (10.04, "10.04 B"),
        (55.04, "55.04 E"),
        (38.2, "38.2 D"),
        (10.004, "10.004 B"),
    ],
)
def test_a_delay_is_shown_on_the_side_of_its_level(delay_s: float, text: str) -> None:
    assert delay_text(delay_s) == text
