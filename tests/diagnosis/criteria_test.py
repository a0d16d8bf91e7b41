"""The usual criteria against counts by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike

from ugat_marl.diagnosis import Tally
from ugat_marl.diagnosis.features import BIN_FEATURES, FEATURES, INDEX
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.verify import Criteria, fhwa, geh, hourly, representative

THRESHOLDS = Thresholds()

STOP = BIN_FEATURES.index("count_stop")


def day(*quarters: ArrayLike, known: bool = True) -> Tally:
    """A day of one detector per argument, counted in quarters of an hour."""
    counts = np.repeat(np.array(quarters, dtype=float), 3, axis=1) / 3.0
    bins = np.zeros((len(BIN_FEATURES), *counts.shape))
    bins[STOP] = counts
    covered = np.ones_like(bins)
    covered[STOP, 0, 0] = known
    return Tally(np.zeros((len(FEATURES), counts.shape[0], 2)), bins, known=covered)


MEASURED = [day([90, 100]), day([100, 110]), day([110, 120])]
"""The second is the typical one; standard deviations are 10, the others are off by 10."""


def test_geh_of_a_textbook_pair() -> None:
    assert geh(np.array([1000.0, 0.0]), np.array([1100.0, 0.0])) == pytest.approx(
        [3.0861], abs=1e-4
    )


def test_hourly_counts_are_those_of_stop_and_exit_detectors() -> None:
    sums = np.zeros((len(FEATURES), 1, 2))
    sums[INDEX["count_stop"], 0] = 30.0, 10.0
    sums[INDEX["count_exit"], 0] = 5.0, 10.0
    sums[INDEX["count_advance"], 0] = 99.0, 10.0
    bins = np.zeros((len(BIN_FEATURES), 1, 1))
    assert hourly(Tally(sums, bins)) == pytest.approx([180.0, 30.0])
    sums[INDEX["count_stop"], 0] = 0.0, 0.0
    assert np.isnan(hourly(Tally(sums, bins))[0]), "an interval was not counted"
    assert geh(hourly(Tally(sums, bins)), np.array([180.0, 30.0])).tolist() == [0.0]


def test_the_typical_day_is_the_one_nearest_to_the_mean() -> None:
    assert representative(np.array([[[90.0]], [[99.0]], [[130.0]]])) == 1


def test_the_typical_day_itself_meets_all_four() -> None:
    assert fhwa(MEASURED, [day([100, 110])], 1, THRESHOLDS) == Criteria(1.0, 1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("simulated", "expected"),
    [
        ([109, 101], Criteria(1.0, 1.0, 1.0, 1.0)),  # off by 9 either way: 0 in the mean
        ([104, 114], Criteria(1.0, 1.0, 1.0, 0.0)),  # 4 of 10 is more than a third
        ([115, 110], Criteria(1.0, 0.5, 1.0, 0.0)),  # 15 is 1.5 standard deviations
        ([100, 131], Criteria(0.5, 0.5, 0.0, 0.0)),  # 21 is beyond 1.96 of them
    ],
)
def test_criteria_by_hand(simulated: list[float], expected: Criteria) -> None:
    assert fhwa(MEASURED, [day(simulated)], 1, THRESHOLDS) == expected


def test_of_several_simulated_days_the_mean_counts() -> None:
    assert fhwa(MEASURED, [day([60, 70]), day([140, 150])], 1, THRESHOLDS) == Criteria(
        1.0, 1.0, 1.0, 1.0
    )


def test_each_detector_is_judged_by_its_own_days() -> None:
    measured = [day([90], [10]), day([100], [10]), day([110], [10])]
    found = fhwa(measured, [day([100], [11])], 1, THRESHOLDS)
    assert found == Criteria(0.5, 0.5, 0.5, 0.5)


def test_what_was_not_counted_every_day_is_left_out() -> None:
    measured = [day([90], [5], known=False), day([100], [6]), day([110], [7])]
    assert fhwa(measured, [day([300], [6])], 1, THRESHOLDS) == Criteria(1.0, 1.0, 1.0, 1.0)


def test_two_days_are_too_few_and_so_is_nothing_counted() -> None:
    assert fhwa(MEASURED[:2], [day([100, 110])], 1, THRESHOLDS) is None
    empty = [day([0, 0])] * 3
    assert fhwa(empty, empty, 1, THRESHOLDS) is None


def test_counts_of_an_hour_are_compared_by_the_hour() -> None:
    measured = [day([c, 0, 0, 0]) for c in (90, 100, 110)]
    spread = day([25, 25, 25, 25])
    by_hour, by_quarter = (
        fhwa(measured, [spread], 12, THRESHOLDS),
        fhwa(measured, [spread], 1, THRESHOLDS),
    )
    assert by_hour == Criteria(1.0, 1.0, 1.0, 1.0)
    assert by_quarter is not None and by_quarter.within_2_sigma == 0.0
