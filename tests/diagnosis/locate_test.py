"""Where data and model disagree: planted at known places, and nowhere."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.diagnosis import Reference, Tally
from ugat_marl.diagnosis.features import (
    BIN_FEATURES,
    FEATURES,
    INDEX,
    DetectorLayout,
    IncomingLane,
    bins_in,
)
from ugat_marl.diagnosis.locate import (
    SHOWN,
    _statistics,
    _stretches,
    difference_of,
    locate,
    of_no_single_day,
    two_sided,
)
from ugat_marl.diagnosis.records import Disagreement
from ugat_marl.diagnosis.statistics import Pools
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.verdict import _separating

THRESHOLDS = Thresholds()

Array = NDArray[np.float64]

LANES, BINS, SPAN = 4, 12, (0.0, 3600.0)
SITE = DetectorLayout(
    ("A", "B"),
    tuple(IncomingLane(f"in{i}_0", f"in{i}", i // 2, (0,), 14.0, {}) for i in range(LANES)),
    ((0, "out0_0", ("x0",)), (1, "out1_0", ("x1",))),
    (),
    {},
)
PLACES = LANES + 2
USED = [INDEX[name] for name in ("lost", "gap2", "gap4-5", "free_speed", "count_stop")]


def days(
    seed: int, count: int, shift: Array | None = None, bump: Array | None = None
) -> list[Tally]:
    """Gaussian features and Poisson counts; `shift` per feature and lane, `bump` per bin."""
    generator = np.random.default_rng(seed)
    found: list[Tally] = []
    for _ in range(count):
        values = 10.0 + generator.standard_normal((len(USED), LANES))
        if shift is not None:
            values = values + shift
        sums = np.zeros((len(FEATURES), PLACES, 2))
        sums[USED, :LANES] = np.stack([40 * values, np.full_like(values, 40)], axis=-1)
        rate = np.zeros((len(BIN_FEATURES), PLACES, BINS))
        rate[:2, :LANES] = 25.0
        if bump is not None:
            rate = rate + bump
        found.append(Tally(sums, generator.poisson(rate).astype(np.float64)))
    return found


def test_what_a_light_or_an_approach_keeps_is_not_put_on_its_first_lane() -> None:
    z = np.zeros((PLACES, len(FEATURES)))
    z[0, [INDEX["kept_to_stop"], INDEX["kept_to_exit"], INDEX["lost"]]] = 8.0, 9.0, 7.0
    rows = _statistics(SITE, "lane", z, z, THRESHOLDS)
    found = {(row.statistic, row.approach, row.lane) for row in rows}
    assert found == {("kept_to_stop", "in0", None), ("lost", "in0", "in0_0")}


@pytest.fixture(scope="module")
def reference() -> Reference:
    return Reference(Pools.of(SITE, THRESHOLDS), days(1, 150))


def found(reference: Reference, data: list[Tally], alpha: float = 0.05) -> list[Disagreement]:
    return locate(SITE, reference, reference.distance(data), alpha, SPAN)


def test_where_nothing_is_wrong_little_is_found(reference: Reference) -> None:
    wrong = [bool(found(reference, days(100 + seed, 5))) for seed in range(100)]
    assert np.mean(wrong) <= 0.08


def test_false_discoveries_are_few_among_many_true_ones(reference: Reference) -> None:
    shift = np.zeros((len(USED), LANES))
    shift[0] = 3.0  # lost time on every lane
    false = total = 0
    for seed in range(30):
        for item in found(reference, days(200 + seed, 5, shift)):
            total += 1
            false += item.statistic != "lost"
    assert total > 60
    assert false / total <= 0.1


def test_a_planted_difference_is_found_with_place_regime_sign_and_size(
    reference: Reference,
) -> None:
    shift = np.zeros((len(USED), LANES))
    shift[USED.index(INDEX["free_speed"]), 2] = -4.0
    items = found(reference, days(3, 5, shift))
    narrow = next(item for item in items if item.lane)
    assert (narrow.tls, narrow.approach, narrow.lane) == ("B", "in2", "in2_0")
    assert (narrow.regime, narrow.statistic, narrow.unit) == ("free flow", "free_speed", "m/s")
    assert narrow.size == pytest.approx(-4.0, abs=1.0)
    assert narrow.z < -6
    wide = next(item for item in items if item.lane is None and item.tls == "B")
    assert wide.size == pytest.approx(-2.0, abs=0.7)  # half of the lanes there
    assert not any(item.tls == "A" and item.regime == "free flow" for item in items)


def test_a_planted_window_is_found_with_its_bins(reference: Reference) -> None:
    bump = np.zeros((len(BIN_FEATURES), PLACES, BINS))
    bump[BIN_FEATURES.index("count_advance"), 1, 3:6] = 25.0
    timed = [item for item in found(reference, days(4, 5, bump=bump)) if item.window]
    assert len(timed) == 1
    item = timed[0]
    assert (item.tls, item.lane, item.regime) == ("A", "in1_0", "volume")
    assert item.window == (900.0, 1800.0)
    assert item.size == pytest.approx(75.0, abs=15.0)
    assert (item.statistic, item.unit) == ("count_advance in time", "vehicles")


def test_a_window_of_joined_bins_lies_where_they_lie() -> None:
    """Counts of 10 min in a period of 55 min: the last 5 min are in no joined bin."""

    def of_55_min(tallies: list[Tally]) -> list[Tally]:
        return [replace(day, bins=day.bins[..., :11]) for day in tallies]

    pools = Pools.of(SITE, THRESHOLDS, together=2)
    joined = Reference(pools, of_55_min(days(1, 150)))
    bump = np.zeros((len(BIN_FEATURES), PLACES, BINS))
    bump[BIN_FEATURES.index("count_advance"), 1, 4:8] = 25.0
    distance = joined.distance(of_55_min(days(4, 5, bump=bump)))
    items = locate(SITE, joined, distance, 0.05, (0.0, 3300.0))
    assert [item.window for item in items if item.window] == [(1200.0, 2400.0)]


@pytest.mark.parametrize(
    ("length_s", "together", "covered_s"),
    [(3600, 1, 3600), (3300, 2, 3000), (3000, 3, 2700), (600, 3, 600), (3150, 5, 3150)],
)
def test_joined_bins_cover_what_is_gathered(
    length_s: float, together: int, covered_s: float
) -> None:
    pools = Pools.of(SITE, THRESHOLDS, together)
    assert pools.grouped_s(length_s) == pytest.approx(covered_s)
    bins = np.ones((len(BIN_FEATURES), PLACES, bins_in(length_s, THRESHOLDS)))
    gathered, _ = Tally(np.zeros((len(FEATURES), PLACES, 2)), bins).gathered(together)
    share = gathered[0, 0].sum() / bins.shape[-1]
    assert pools.grouped_s(length_s) == pytest.approx(length_s * share)


def test_a_constant_change_is_no_window(reference: Reference) -> None:
    bump = np.zeros((len(BIN_FEATURES), PLACES, BINS))
    bump[BIN_FEATURES.index("count_advance"), 1] = 8.0
    assert [item for item in found(reference, days(5, 5, bump=bump)) if item.window] == []


def test_periods_of_different_spans_have_no_windows(reference: Reference) -> None:
    bump = np.zeros((len(BIN_FEATURES), PLACES, BINS))
    bump[0, 1, 3:6] = 30.0
    data = days(6, 5, bump=bump)
    items = locate(SITE, reference, reference.distance(data), 0.05, None)
    assert [item for item in items if item.window] == []


def test_size_and_z_of_a_stretch_are_both_beside_the_rest(reference: Reference) -> None:
    """More vehicles all the time, and fewer more for a quarter of an hour."""
    bump = np.zeros((len(BIN_FEATURES), PLACES, BINS))
    bump[:2, 0] = 20.0
    bump[:2, 0, 6:9] = 6.0
    distance = reference.distance(days(7, 5, bump=bump))
    one = next(each for each in _stretches(SITE, reference, distance, SPAN) if each.lane == "in0_0")
    assert one.window == (1800.0, 2700.0)
    assert one.z < -3.0
    assert -60.0 < one.size < -20.0  # 42 fewer, and chance


def test_what_tells_two_lanes_apart_is_a_statistic_of_a_lane() -> None:
    """The same effect on one lane or on the other: the network as a whole is the same."""
    pools = Pools.of(SITE, THRESHOLDS)

    def model(lane: int) -> Any:
        shift = np.zeros((len(USED), LANES))
        shift[1, lane] = 1.2
        return SimpleNamespace(reference=Reference(pools, days(1, 60, shift=shift)))

    told = _separating(model(0), model(2), USED, THRESHOLDS.deciding_z, SITE)
    assert re.search(r"\(discharge\) on lane in[02]_0 differs most between them", told)
    assert int(told.partition("about ")[2].split()[0]) <= 25
    same = _separating(model(0), model(0), USED, THRESHOLDS.deciding_z, SITE)
    assert same.startswith("other data: over whole periods no statistic")


def test_the_strongest_statistic_speaks_for_its_regime(reference: Reference) -> None:
    shift = np.zeros((len(USED), LANES))
    shift[USED.index(INDEX["lost"]), 0] = 4.0
    shift[USED.index(INDEX["gap2"]), 0] = 8.0
    items = [item for item in found(reference, days(7, 5, shift)) if item.lane == "in0_0"]
    assert [(item.regime, item.statistic) for item in items] == [("discharge", "gap2")]


def test_the_strongest_lane_is_among_many_wide_places() -> None:
    """More wide places are found than are shown, and one lane is worst of all."""
    lights, each = 16, 2
    many = tuple(
        IncomingLane(f"in{i}_0", f"in{i}", i // each, (0,), 14.0, {}) for i in range(lights * each)
    )
    site = DetectorLayout(tuple(f"T{i}" for i in range(lights)), many, (), (), {})
    used = [INDEX[name] for name in ("lost", "free_speed", "platoon_gap", "red_speed")]

    def of_all_lanes(seed: int, count: int, shift: float, worst: float) -> list[Tally]:
        generator = np.random.default_rng(seed)
        found: list[Tally] = []
        for _ in range(count):
            values = 10.0 + shift + generator.standard_normal((len(used), len(many)))
            values[0, 5] += worst
            sums = np.zeros((len(FEATURES), len(many), 2))
            sums[used] = np.stack([40 * values, np.full_like(values, 40)], axis=-1)
            found.append(Tally(sums, np.zeros((len(BIN_FEATURES), len(many), BINS))))
        return found

    model = Reference(Pools.of(site, THRESHOLDS), of_all_lanes(1, 60, 0.0, 0.0))
    items = locate(site, model, model.distance(of_all_lanes(9, 5, 1.5, 20.0)), 0.05, None)
    lanes = [item.lane for item in items]
    assert len(items) == SHOWN
    wide = lanes.count(None)
    assert "in5_0" in lanes and lanes[:wide] == [None] * wide
    sizes = [abs(item.z) for item in items]
    assert sizes[:wide] == sorted(sizes[:wide], reverse=True)
    assert sizes[wide:] == sorted(sizes[wide:], reverse=True)


def test_a_p_value_and_its_difference() -> None:
    assert two_sided(difference_of(0.25, 6.0), 6.0) == pytest.approx(0.25)


@pytest.mark.parametrize(("moved", "found"), [(1, False), (3, True)])
def test_a_difference_of_a_single_day_is_none(
    moved: int, found: bool, reference: Reference
) -> None:
    shift = np.zeros((len(USED), LANES))
    shift[1, 2] = 12.0 / moved
    data = [*days(5, moved, shift), *days(8, 3 - moved)]
    distance = of_no_single_day(reference, data)
    items = locate(SITE, reference, distance, 0.05, SPAN)
    assert any(item.lane == "in2_0" for item in items) is found
    assert locate(SITE, reference, reference.distance(data), 0.05, SPAN), "or it is no test"


def test_disagreements_can_be_written(reference: Reference) -> None:
    shift = np.full((len(USED), LANES), 5.0)
    bump = np.zeros((len(BIN_FEATURES), PLACES, BINS))
    bump[1, 0, :3] = 40.0
    items = [asdict(item) for item in found(reference, days(8, 5, shift, bump))]
    assert {item["window"] is None for item in items} == {True, False}
    for item in items:
        again = json.loads(json.dumps(item, allow_nan=False))
        window = item["window"] and list(item["window"])  # a list in the file
        assert again == {**item, "window": window}


def test_bins_without_data_are_no_stretch() -> None:
    """Counts are 4 deviations too high all day long, and two hours are missing."""
    z = np.array([[4.0, 4.1, 3.9, 4.0, 0.0, 0.0, 0.0, 0.0, 4.0, 4.1, 3.9, 4.0]])
    used = z != 0.0
    site = replace(SITE, lanes=SITE.lanes[:1], exits=())
    pools: Any = SimpleNamespace(thresholds=THRESHOLDS, grouped_s=lambda length_s: length_s)
    distance: Any = SimpleNamespace(z={"time": z}, difference={"time": z})
    for of_the_model in (used, np.ones_like(used)):  # which has days with all intervals
        block = SimpleNamespace(used=of_the_model)
        reference: Any = SimpleNamespace(pools=pools, blocks={"time": block})
        (found,) = _stretches(site, reference, distance, SPAN)
        assert abs(found.z) < 0.5
