"""Two periods with the same counts, or the same vehicles, are one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from ugat_marl.data.measured import passages
from ugat_marl.data.measured.copies import FEWEST, refuse_copies
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import Period

DAYS = [Period(name, 0.0, 3600.0, "fit", {}, {}) for name in ("mon", "tue", "wed")]


def counted(mon: Sequence[int], tue: Sequence[int]) -> pl.DataFrame:
    """Return counts of one detector on two days, in intervals of a minute."""
    rows = [
        (day, "d", 60.0 * i, n) for day, counts in (("mon", mon), ("tue", tue)) for i, n in
        enumerate(counts)
    ]  # fmt: skip
    return pl.DataFrame(rows, ("period_id", "detector_id", "begin_s", "count"), orient="row")


def check(frame: pl.DataFrame, periods: Sequence[Period] = DAYS) -> None:
    refuse_copies(Path("counts.csv"), frame, periods, ("detector_id", "begin_s"), "count")


COUNTS = np.random.default_rng(3).poisson(4.0, 60).tolist()


def test_equal_counts_are_refused_and_the_periods_named() -> None:
    with pytest.raises(
        MeasuredDataError, match="'mon' and 'tue' share .* all of them are the same"
    ):
        check(counted(COUNTS, COUNTS))


def test_counts_that_differ_once_are_two_days() -> None:
    check(counted(COUNTS, [*COUNTS[:-1], COUNTS[-1] + 1]))


def test_empty_nights_are_alike_and_no_copies() -> None:
    night = [0] * 200 + [1] * (FEWEST - 1)
    check(counted(night, night))
    with pytest.raises(MeasuredDataError):
        check(counted([*night, 2], [*night, 2]))


def test_two_days_of_equally_sparse_traffic_pass() -> None:
    generator = np.random.default_rng(5)
    for _ in range(200):
        check(counted(generator.poisson(0.3, 120).tolist(), generator.poisson(0.3, 120).tolist()))


def test_one_recording_in_periods_that_follow_each_other_is_allowed() -> None:
    early, late = replace(DAYS[0], end_s=1800.0), replace(DAYS[1], begin_s=1800.0)
    check(counted(COUNTS, COUNTS), (early, late))


def discharges(seed: int, tick_s: float) -> Any:
    """Two days of queues that leave under one fixed plan, in stamps of so many seconds."""
    generator = np.random.default_rng(seed)
    rows: list[tuple[int, float, bool]] = []
    for key in range(16):  # eight detectors on two days
        for cycle in range(40):
            green_s = 90.0 * cycle + 45.0 * (key % 2)
            off_s = green_s + 2.0 + abs(generator.normal(0.0, 0.3))
            while off_s < green_s + 35.0:
                on_s = off_s - 10.5 / max(2.0 + 1.2 * (off_s - green_s), 3.0)
                rows += [(key, round(t / tick_s) * tick_s, t == on_s) for t in (on_s, off_s)]
                off_s += max(generator.normal(2.0, 0.35), 1.2)
    rows.sort()
    keys, times, on = (np.array(column) for column in zip(*rows, strict=True))
    nothing = np.full(len(rows), np.nan)
    return passages._Stream(keys, times, on, nothing, nothing)


@pytest.mark.parametrize(("tick_s", "late_s"), [(0.1, 0.0), (1.0, 0.0), (1.0, 0.5)])
def test_queues_under_a_fixed_plan_are_no_copy(tick_s: float, late_s: float) -> None:
    days, stream = DAYS[:2], discharges(1, tick_s)
    stream = replace(stream, time=stream.time + late_s)
    stream.time[0] += 0.1
    passages._refuse_copies(Path("detections.csv"), stream, days, 8)
    first = stream.key < 8
    twice = passages._Stream(
        np.concatenate([stream.key[first], stream.key[first] + 8]),
        *(
            np.tile(column[first], 2)
            for column in (stream.time, stream.is_on, stream.speed, stream.length)
        ),
    )
    with pytest.raises(MeasuredDataError, match="100% of the detections .* are the same"):
        passages._refuse_copies(Path("detections.csv"), twice, days, 8)
