"""Features of intervals: sums by hand, and the same from measured counts as from passages."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from ugat_marl.data import Intervals, MeasuredData, as_counts
from ugat_marl.diagnosis.features import ALL_FEATURES, BIN_FEATURES, FEATURES, INDEX, DetectorLayout
from ugat_marl.diagnosis.features import tally as tally_of
from ugat_marl.diagnosis.intervals import (
    counts_tally,
    implausible,
    interval_sums,
    reports_of_counts,
    seeming_lengths,
    usual_length,
    with_intervals,
    without_gaps,
    without_occupancies,
)
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.unmeasured import Unmeasured
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


@pytest.mark.parametrize("length_s", [60.0, 240.0, 300.0, 450.0])
def test_counts_of_a_street_have_the_features_of_the_passages_behind_them(
    layout: DetectorLayout, length_s: float
) -> None:
    measured = recording(layout, 3)
    (period,) = measured.periods
    alone = tally_of(layout, period, layout.greens(period), THRESHOLDS)
    from_passages = with_intervals(alone, layout, period, length_s)
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
    np.testing.assert_allclose(from_counts.bins, from_passages.bins, atol=0.02)
    if 300.0 % length_s == 0.0:  # the bins are whole intervals
        np.testing.assert_allclose(from_counts.bins, alone.bins, atol=0.02)


def test_counts_without_more_are_counts(layout: DetectorLayout) -> None:
    counts = as_counts(recording(layout, 3), 300.0).counts
    assert counts is not None
    bare = counts.drop("occupancy", "mean_speed_mps")
    assert usual_length(bare) == 300.0
    period = Period("day", 0.0, 900.0, "fit", {}, {})
    whole = without_gaps(bare, [period], THRESHOLDS)
    found = counts_tally(layout, period, bare, whole, THRESHOLDS)
    assert len(found.sums) == len(FEATURES)
    seen = recording(layout, 3).periods[0]
    simulated = with_intervals(
        tally_of(layout, seen, layout.greens(seen), THRESHOLDS), layout, seen, 300.0
    )
    lacking = Unmeasured.of([period], summed=found.sums[..., 1:] > 0)
    np.testing.assert_allclose(lacking.summed_in(simulated).sums, found.sums)
    assert not found.counted[BIN_FEATURES.index("occupied")].any()


@pytest.mark.parametrize("length_s", [0.0, -60.0, 0.1, NAN, math.inf])
def test_an_impossible_interval_is_refused(layout: DetectorLayout, length_s: float) -> None:
    with pytest.raises(OptionError, match="give seconds, 1 or more"):
        as_counts(recording(layout, 3), length_s)


# --- detectors that are not what they seem --------------------------------------------------------


def free_traffic(extension_s: float, longer_m: float = 0.0) -> dict[str, np.ndarray]:
    """Sums of cars of 5 m at 8 to 15 m/s over points, and over loops that stay on."""
    generator = np.random.default_rng(2)
    speed = generator.uniform(8.0, 15.0, (40, 6))
    times = (5.0 + longer_m) / speed

    def reports(extra_s: float) -> Intervals:
        begin = 60.0 * np.arange(40)
        occupied = (times + extra_s).sum(axis=1)
        return Intervals(begin, begin + 60.0, np.full(40, 6.0), occupied, speed.mean(axis=1))

    every = (("advance", reports(extension_s)), ("stop", reports(0.0)), ("exit", reports(0.0)))
    return seeming_lengths(every, THRESHOLDS)


def test_free_traffic_shows_the_length_of_vehicle_and_zone() -> None:
    for longer in (0.0, 2.0):
        total, vehicles = free_traffic(0.0, longer)["exit"]
        assert vehicles == 240
        assert total / vehicles == pytest.approx(5.0 + longer, rel=0.03)
    crowded = Intervals(
        np.zeros(1), np.full(1, 60.0), np.full(1, 9.0), np.full(1, 30.0), np.full(1, 2.0)
    )
    assert seeming_lengths([("stop", crowded)], THRESHOLDS)["stop"].tolist() == [0.0, 0.0]


def test_longer_vehicles_are_not_put_on_detectors_and_extensions_are() -> None:
    model = free_traffic(0.0)
    assert implausible(model, model, THRESHOLDS) == {}
    assert implausible(free_traffic(0.0, 2.0), model, THRESHOLDS) == {}
    found = implausible(free_traffic(0.5), model, THRESHOLDS)
    assert set(found) == {"advance"}
    two = {kind: sums for kind, sums in free_traffic(0.5).items() if kind != "stop"}
    assert set(implausible(two, model, THRESHOLDS)) == {"advance"}, "of two kinds only the one"
    near = {kind: sums for kind, sums in free_traffic(0.2).items() if kind != "stop"}
    assert set(implausible(near, model, THRESHOLDS)) == {"advance"}, "2.3 m off the other kind"
    here, there = found["advance"]
    assert here - there == pytest.approx(0.5 * 11.5, rel=0.05)
    assert set(implausible(free_traffic(0.0, 5.0), model, THRESHOLDS)) == set(model)


def test_occupancies_set_aside_have_no_weight(layout: DetectorLayout) -> None:
    counts = as_counts(recording(layout, 3), 300.0).counts
    assert counts is not None
    period = Period("day", 0.0, 900.0, "fit", {}, {})
    whole = without_gaps(counts, [period], THRESHOLDS)
    before = counts_tally(layout, period, counts, whole, THRESHOLDS)
    after = without_occupancies(before, ("advance",))
    changed = {
        name
        for name, row in INDEX.items()
        if row < len(before.sums) and (before.sums[row] != after.sums[row]).any()
    }
    assert changed == {"over_advance", "busy_count_advance", "busy_speed_advance"}
    occupied = BIN_FEATURES.index("occupied")
    assert before.counted[occupied].any() and not after.counted[occupied].any()
    assert {kind for kind, _ in reports_of_counts(layout, counts)} == {"advance", "stop", "exit"}
