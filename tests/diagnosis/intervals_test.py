"""Features of intervals: sums by hand, and the same from measured counts as from passages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ugat_marl.data import Intervals, MeasuredData, as_counts
from ugat_marl.diagnosis.features import ALL_FEATURES, BIN_FEATURES, FEATURES, INDEX, DetectorLayout
from ugat_marl.diagnosis.features import tally as tally_of
from ugat_marl.diagnosis.intervals import (
    counts_tally,
    interval_sums,
    usual_length,
    with_intervals,
    without_gaps,
)
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import Network, Passages, Period, read_scenario
from ugat_marl.simulation import standard_detectors

THRESHOLDS = Thresholds()
NAN = np.nan


def test_a_vehicle_counts_where_it_arrives_and_occupies_where_it_stands() -> None:
    seen = Passages(
        np.array([NAN, 10.0, 59.0, 110.0, 130.0]),
        np.array([4.0, 11.0, 62.0, 112.0, NAN]),
        np.array([NAN, 10.0, 4.0, 6.0, NAN]),
        np.full(5, NAN),
    )
    found = Intervals.of(seen, Period("a", 0.0, 140.0, "fit", {}, {}), 60.0)
    assert found.begin_s.tolist() == [0.0, 60.0, 120.0]
    assert found.end_s.tolist() == [60.0, 120.0, 140.0]
    assert found.vehicles.tolist() == [3.0, 1.0, 1.0]
    assert found.occupied_s.tolist() == [4.0 + 1.0 + 1.0, 2.0 + 2.0, 10.0]
    np.testing.assert_array_equal(found.speed_mps, [7.0, 6.0, NAN])


def test_sums_are_those_of_the_definitions() -> None:
    found = Intervals(
        np.array([0.0, 60.0, 120.0, 180.0]),
        np.array([60.0, 120.0, 180.0, 200.0]),
        np.array([10.0, 4.0, 0.0, 3.0]),
        np.array([30.0, 8.0, 0.0, 2.0]),
        np.array([3.0, 12.0, NAN, 10.0]),
    )
    assert interval_sums(found, 60.0) == {
        "over": (40.0, 17.0),
        "mean_speed": (30.0 + 48.0 + 30.0, 17.0),
        "busy_count": (300.0 + 32.0, 38.0),  # the last interval is shorter than usual
        "busy_speed": (900.0 + 384.0, 332.0),
        "bunching": (116.0, 14.0),
    }


def test_what_was_not_measured_has_no_weight() -> None:
    found = Intervals(
        np.array([0.0, 60.0]),
        np.array([60.0, 120.0]),
        np.array([10.0, 4.0]),
        np.array([NAN, NAN]),
        np.array([NAN, NAN]),
    )
    sums = interval_sums(found, 60.0)
    assert {name for name, (_, weight) in sums.items() if weight} == {"bunching"}


def recording(layout: DetectorLayout, seed: int) -> MeasuredData:
    """A quarter of an hour of vehicles at every detector, times in milliseconds."""
    generator = np.random.default_rng(seed)
    passages: dict[str, Passages] = {}
    for detector in layout.detectors:
        on = np.round(np.cumsum(generator.uniform(3.0, 20.0, 60)), 3)
        off = np.round(on + generator.uniform(0.2, 2.5, 60), 3)
        inside = off < 900.0
        speed = np.round(generator.uniform(2.0, 15.0, 60), 2)
        passages[detector.id] = Passages(
            on[inside], off[inside], speed[inside], np.full(int(inside.sum()), NAN)
        )
    return MeasuredData(layout.detectors, (Period("day", 0.0, 900.0, "fit", {}, passages),))


@pytest.fixture(scope="module")
def layout(data: Path) -> DetectorLayout:
    network = Network.read(read_scenario(data / "crossing"))
    return DetectorLayout.of(network, standard_detectors(network))


@pytest.mark.parametrize("length_s", [60.0, 300.0, 450.0])
def test_counts_of_a_street_have_the_features_of_the_passages_behind_them(
    layout: DetectorLayout, length_s: float
) -> None:
    measured = recording(layout, 3)
    (period,) = measured.periods
    from_passages = with_intervals(
        tally_of(layout, period, layout.greens(period), THRESHOLDS), layout, period, length_s
    )
    counts = as_counts(measured, length_s).counts
    assert counts is not None
    assert usual_length(counts) == length_s
    whole = without_gaps(counts, [period], THRESHOLDS)
    from_counts = counts_tally(layout, period, counts, whole, THRESHOLDS)
    rows = [INDEX[f"count_{kind}"] for kind in ("advance", "stop", "exit")]
    rows += list(range(len(FEATURES), len(ALL_FEATURES)))
    assert from_counts.sums[len(FEATURES) :, ..., 1].any(axis=1).all(), "every feature is known"
    np.testing.assert_allclose(from_counts.sums[rows], from_passages.sums[rows], rtol=2e-3)
    others = [row for row in range(len(FEATURES)) if row not in rows]
    assert not from_counts.sums[others].any(), "single vehicles are not known"
    occupied = BIN_FEATURES.index("occupied")
    together = 1 if length_s <= 300.0 else 2
    mine, theirs = (one.gathered(together)[0][occupied] for one in (from_counts, from_passages))
    if length_s != 450.0:
        np.testing.assert_allclose(mine, theirs, atol=0.02)


def test_counts_without_more_are_counts(layout: DetectorLayout) -> None:
    counts = as_counts(recording(layout, 3), 300.0).counts
    assert counts is not None
    bare = counts.drop("occupancy", "mean_speed_mps")
    assert usual_length(bare) is None
    period = Period("day", 0.0, 900.0, "fit", {}, {})
    whole = without_gaps(bare, [period], THRESHOLDS)
    found = counts_tally(layout, period, bare, whole, THRESHOLDS)
    assert len(found.sums) == len(FEATURES)
    assert not found.counted[BIN_FEATURES.index("occupied")].any()


@pytest.mark.parametrize("length_s", [0.0, -60.0, NAN])
def test_an_impossible_interval_is_refused(layout: DetectorLayout, length_s: float) -> None:
    with pytest.raises(OptionError, match="must be above 0"):
        as_counts(recording(layout, 3), length_s)
