"""The usual criteria against counts by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from ugat_marl.diagnosis import Tally
from ugat_marl.diagnosis.features import ALL_FEATURES, BIN_FEATURES, FEATURES, INDEX
from ugat_marl.diagnosis.statistics import Distance, Pools, Reference
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.verify import (
    Criteria,
    fhwa,
    geh,
    hourly,
    lanes_table,
    representative,
    statistics_table,
    travel_times,
    verify_model,
)

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


def test_no_measured_interval_is_split() -> None:
    """Counts of ten minutes are judged by twenty, for a quarter of an hour would smooth them."""
    generator = np.random.default_rng(1)
    counts = generator.poisson(100, (40, 6)).astype(float)  # 40 days of an hour

    def of_day(row: np.ndarray) -> Tally:
        bins = np.zeros((len(BIN_FEATURES), 1, 12))
        bins[STOP] = np.repeat(row / 2.0, 2)
        return Tally(np.zeros((len(FEATURES), 1, 2)), bins)

    days = [of_day(row) for row in counts]
    sums = counts.reshape(40, 3, 2).sum(axis=2)
    mean = of_day(np.repeat(sums.mean(axis=0) / 2.0, 2))
    typical = sums[representative(sums[:, None])]
    within = np.abs(typical - sums.mean(axis=0)) <= sums.std(axis=0, ddof=1)
    found = fhwa(days, [mean], 2, THRESHOLDS)
    assert found is not None and found.within_1_sigma == pytest.approx(within.mean())


def test_a_statistic_without_any_difference_stays_in_the_tables() -> None:
    width = len(ALL_FEATURES)
    used = np.zeros((1, width), np.bool_)
    used[0, :2] = True
    z = np.zeros((1, width))
    z[0, 1] = 4.0
    parts = {"network": z, "lane": z}
    distance = Distance(0.0, {}, 0.0, {"network": used, "lane": used}, parts, parts)
    block = SimpleNamespace(mean=np.ones((1, width)), variance=np.ones((1, width)))
    reference = SimpleNamespace(
        distance=lambda *_, **__: distance, blocks={"network": block, "lane": block}
    )
    model: Any = SimpleNamespace(model=SimpleNamespace(reference=reference))
    layout = SimpleNamespace(places=[(0, "in", "in_0")], intersections=("A",))
    pools = SimpleNamespace(pool=lambda _: {"network": np.ones((1, width, 2))})
    study: Any = SimpleNamespace(heldout=[day([1])], layout=layout, pools=pools)
    first, second = statistics_table(study, model, model, distance, distance)
    assert (first.z_before, second.z_before) == (0.0, 4.0)
    (lane,) = lanes_table(study.layout, distance, distance)
    assert lane.before == pytest.approx(np.sqrt(8.0))  # of a 0 and a 4


def test_rows_show_the_mean_of_the_held_out_hours() -> None:
    """The held-out hours are the busy ones, and a tenth busier than in the model."""
    generator = np.random.default_rng(0)
    pools = Pools({"network": np.ones((1, 1)), "lane": np.eye(1)}, THRESHOLDS)
    number = INDEX["count_stop"]

    def of_hour(hour: int, rate: float) -> Tally:
        sums = np.zeros((len(FEATURES), 1, 2))
        sums[number] = (generator.poisson(rate * 60), 60)
        window = (3600.0 * hour, 3600.0 * (hour + 1))
        return Tally(sums, np.zeros((len(BIN_FEATURES), 1, 12)), window=window)

    quiet_and_busy = [of_hour(i % 2, (4, 12)[i % 2]) for i in range(60)]
    reference = Reference(pools, quiet_and_busy)
    model: Any = SimpleNamespace(model=SimpleNamespace(reference=reference))
    heldout = [of_hour(1, 13.2), of_hour(1, 13.2)]
    study: Any = SimpleNamespace(heldout=heldout, pools=pools)
    distance = reference.distance(heldout)
    rows = statistics_table(study, model, model, distance, distance)
    (row,) = (x for x in rows if x.statistic == "count_stop")
    assert row.measured == pytest.approx(sum(day.sums[number, 0, 0] for day in heldout) / 120)
    assert row.before == pytest.approx(12, abs=0.3) and row.after == row.before


def test_a_model_that_is_merely_noisier_is_no_gain() -> None:
    """Held-out days of the scenario as it is, which has gaps of 2 s with a spread of 1 or 1.5."""
    generator = np.random.default_rng(1)
    pools = Pools({"network": np.ones((1, 8)), "lane": np.eye(8)}, THRESHOLDS)
    rows = [INDEX[name] for name in ("gap2", "gap3", "gap4-5", "gap6-8", "lost", "speed1")]

    def days(count: int, spread: float, mean: float = 2.0) -> list[Tally]:
        found: list[Tally] = []
        for _ in range(count):
            sums = np.zeros((len(FEATURES), 8, 2))
            sums[rows, :, 0] = 60 * generator.normal(mean, spread, (len(rows), 8))
            sums[rows, :, 1] = 60
            found.append(Tally(sums, np.zeros((len(BIN_FEATURES), 8, 12))))
        return found

    base = Reference(pools, days(60, 1.0))

    def tested(reference: Reference) -> Any:
        model = SimpleNamespace(reference=reference, members=(), tallies=(), effects=())
        return SimpleNamespace(model=model, extra={})

    def gains(mean: float, spread: float) -> list[float]:
        """The model with this mean and spread against as many sets of held-out days."""
        residual = SimpleNamespace(distance=0.0, expected=0.0)
        null = SimpleNamespace(test=lambda *_: residual)
        best = tested(Reference(pools, days(40, spread, mean), prior=base))
        found: list[float] = []
        for _ in range(40):
            held: Any = SimpleNamespace(
                heldout=days(2, 1.0, mean), null=lambda *_, **__: null, test_days=lambda _: ()
            )
            found.append(verify_model(held, tested(base), best).gain)
        return found

    noisier = np.array(gains(2.0, 1.5))
    assert noisier.mean() < 0.0 and (noisier >= THRESHOLDS.confirmed).mean() < 0.1
    assert np.min(gains(4.0, 1.0)) > THRESHOLDS.confirmed


def test_travel_times_ask_for_no_further_days() -> None:
    asked: list[list[int]] = []

    def ordinary(_: object, numbers: list[int]) -> dict[int, Any]:
        asked.append(numbers)
        return {number: SimpleNamespace(travel_time_s=100.0) for number in numbers}

    engine = SimpleNamespace(first=lambda count: range(1, count + 1), ordinary=ordinary)
    study: Any = SimpleNamespace(engine=engine, effort=SimpleNamespace(test=4, base=4))
    base: Any = SimpleNamespace(model=SimpleNamespace(days=dict.fromkeys(range(4)), effects=()))
    travel_times(study, base, base)
    assert asked == [[1, 2, 3]] * 2
