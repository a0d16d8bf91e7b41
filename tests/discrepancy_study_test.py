"""Which detectors a diagnosis compares."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ugat_marl.discrepancy.select import Effort
from ugat_marl.discrepancy.study import effort_for, heard
from ugat_marl.measured.data import Detector, Measured, Passages, Period

NAMES = ("one", "two", "three", "four")
DETECTORS = tuple(Detector(name, f"{name}_0", 1.0, 0.0, "stop") for name in NAMES)
SEEN = Passages(np.array([1.0]), np.array([1.5]), np.array([10.0]), np.array([5.0]))


def measured(*days: tuple[str, ...], silent: Passages | None = None) -> Measured:
    """Two days, on each of which these detectors saw a vehicle; others are as `silent`."""
    periods = tuple(
        Period(
            f"day{number}",
            0.0,
            100.0,
            "fit",
            {},
            {
                name: SEEN if name in saw else silent
                for name in NAMES
                if name in saw or silent is not None
            },  # pyright: ignore[reportArgumentType]
        )
        for number, saw in enumerate(days)
    )
    return Measured(DETECTORS, periods)


def names(found: tuple[Detector, ...]) -> tuple[str, ...]:
    return tuple(item.id for item in found)


@pytest.mark.parametrize("silent", [None, Passages.none()])
def test_of_detectors_of_which_half_are_silent_only_the_others_are_compared(
    silent: Passages | None,
) -> None:
    assert names(heard(measured(("one", "three"), silent=silent))) == ("one", "three")
    assert names(heard(measured(("two",), ("two",), silent=silent))) == ("two",)


def test_a_single_silent_detector_is_compared_like_any_other() -> None:
    assert names(heard(measured(("one", "two", "three")))) == NAMES
    assert names(heard(measured(NAMES))) == NAMES


def test_a_detector_that_saw_something_on_one_day_is_not_silent() -> None:
    assert names(heard(measured(("one", "two"), ("three",)))) == NAMES


def test_where_nobody_saw_anything_all_are_kept() -> None:
    assert names(heard(measured((), (), silent=Passages.none()))) == NAMES


def test_counts_in_intervals_say_nothing_of_silence() -> None:
    counts = pl.DataFrame({"period_id": ["day0"], "detector_id": ["one"], "count": [3]})
    data = Measured(DETECTORS, (Period("day0", 0.0, 100.0, "fit", {}, {}),), counts=counts)
    assert names(heard(data)) == NAMES


def test_larger_networks_are_simulated_for_fewer_days() -> None:
    efforts = [effort_for(count) for count in (1, 4, 5, 8, 9, 64)]
    assert efforts[0] == efforts[1] == Effort()
    assert efforts[2] == efforts[3]
    assert efforts[4] == efforts[5]
    for more, fewer in ((efforts[0], efforts[2]), (efforts[2], efforts[4])):
        for name in ("base", "bank", "fit", "test"):
            assert getattr(fewer, name) <= getattr(more, name)
    assert all(effort.test <= effort.base for effort in efforts)
