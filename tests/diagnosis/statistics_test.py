"""Distances against closed forms, on tallies drawn from normal distributions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.diagnosis import Reference, Tally, change_between, sum_of
from ugat_marl.diagnosis.features import (
    BIN_FEATURES,
    FEATURES,
    INDEX,
    SPEED_FEATURES,
    DetectorLayout,
    IncomingLane,
)
from ugat_marl.diagnosis.residual import Null
from ugat_marl.diagnosis.statistics import Pools, Whitener, of_the_same_stretches
from ugat_marl.diagnosis.supplementary_data import TRAVEL_TIME, Label
from ugat_marl.diagnosis.thresholds import Thresholds

THRESHOLDS = Thresholds()

Array = NDArray[np.float64]

USED = ("lost", "gap2", "gap4-5", "free_speed", "red_time", "count_stop")
WEIGHT = 50.0
NETWORK = Pools({"network": np.ones((1, 1))}, THRESHOLDS)
SEVERAL = Pools({"network": np.ones((1, 3)), "lane": np.eye(3)}, THRESHOLDS)


def days_of(
    values: Array, weight: float | Array = WEIGHT, features: Sequence[str] = USED
) -> list[Tally]:
    """Days whose features have these means, ``(days, features, places)``."""
    rows = [INDEX[name] for name in features]
    found: list[Tally] = []
    for day in values:
        sums = np.zeros((len(FEATURES), day.shape[1], 2))
        weights = np.broadcast_to(weight, day.shape)
        sums[rows] = np.stack([day * weights, weights], axis=-1)
        found.append(Tally(sums, np.zeros((len(BIN_FEATURES), day.shape[1], 1))))
    return found


def gaussian(
    seed: int, days: int, places: int = 1, mean: float = 10.0, correlation: float = 0.0
) -> Array:
    """Values of unit variance, all features correlated alike."""
    generator = np.random.default_rng(seed)
    common = generator.standard_normal((days, 1, places))
    own = generator.standard_normal((days, len(USED), places))
    return mean + np.sqrt(correlation) * common + np.sqrt(1 - correlation) * own


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_the_distance_of_gaussian_data_is_chi_square(correlation: float) -> None:
    reference = Reference(NETWORK, days_of(gaussian(1, 1500, correlation=correlation)))
    data = gaussian(2, 2000, correlation=correlation).reshape(400, 5, len(USED), 1)
    totals = np.array([reference.distance(days_of(item)).total for item in data])
    freedom = len(USED)
    assert totals.mean() == pytest.approx(freedom, rel=0.1)
    assert totals.var() == pytest.approx(2 * freedom, rel=0.35)
    assert (totals > 12.59).mean() == pytest.approx(0.05, abs=0.03)  # 95 % of chi-square with 6


def test_a_shift_counts_with_the_number_of_days() -> None:
    # z = 3 sqrt(D) in one of independent statistics, without noise in the data.
    reference = Reference(NETWORK, days_of(gaussian(3, 2000)))
    for days in (1, 4):
        values = np.full((days, len(USED), 1), 10.0)
        values[:, 0] += 3.0
        assert reference.distance(days_of(values)).total == pytest.approx(9.0 * days, rel=0.12)


def stretches(seed: int, days: int, apart: float, shift: float = 0.0) -> list[Tally]:
    """Days of a morning and of an afternoon, by turns, whose means are `apart`."""
    values = gaussian(seed, days)
    values[1::2] += apart
    values[:, 0] += shift
    windows = ((0.0, 1800.0), (1800.0, 3600.0))
    return [replace(day, window=windows[k % 2]) for k, day in enumerate(days_of(values))]


def test_each_stretch_of_the_day_is_compared_with_its_own() -> None:
    """The same distances as of one stretch, though one has twice the values of the other."""
    model, blind = stretches(5, 400, 10.0), days_of(gaussian(5, 400))
    apart, alike = Reference(NETWORK, model), Reference(NETWORK, blind)
    for data, shift in (((6, 2), 0.0), ((7, 4), 1.5)):
        here = apart.distance(stretches(*data, 10.0, shift)).total
        there = alike.distance(stretches(*data, 0.0, shift)).total
        assert here == pytest.approx(there, rel=0.15)
    # one stretch alone, as held-out periods may be
    alone = [day for day in stretches(8, 8, 10.0) if day.window == (1800.0, 3600.0)]
    assert apart.distance(alone).total < 20.0
    assert apart.distance(days_of(gaussian(8, 4) + 10.0)).total > 300.0  # of no known stretch


def test_noise_of_stretches_is_that_of_their_days() -> None:
    """A model with twenty mornings and four afternoons, and data of nearly afternoons alone."""
    windows = ((0.0, 1800.0), (1800.0, 3600.0))

    def days(seed: int, mornings: int, afternoons: int) -> list[Tally]:
        found = days_of(gaussian(seed, mornings + afternoons))
        return [replace(day, window=windows[k >= mornings]) for k, day in enumerate(found)]

    z = [
        Reference(NETWORK, days(2 * k, 20, 4)).distance(days(2 * k + 1, 1, 9)).z["network"]
        for k in range(300)
    ]
    assert 0.9 < np.std([values[values != 0.0] for values in z]) < 1.15


def test_days_of_the_same_stretches_have_the_datas_proportions() -> None:
    """Simulated days are under five periods in turn, and two of them are held out."""
    peak, noon = (25200.0, 27000.0), (43200.0, 45000.0)
    order = [(peak, noon)[k % 5 % 2] for k in range(20)]
    model = [replace(day, window=w) for day, w in zip(days_of(gaussian(1, 20)), order, strict=True)]
    both = [replace(day, window=w) for day, w in zip(model, (noon, peak), strict=False)]
    chosen = of_the_same_stretches(model, both)
    assert [day.window for day in chosen].count(peak) == 8 == len(chosen) / 2
    kept = {id(day) for day in chosen}
    assert [id(day) for day in chosen] == [id(day) for day in model if id(day) in kept]
    assert len(of_the_same_stretches(model, both[1:])) == 12, "of one stretch all days"
    assert len(of_the_same_stretches(model, [replace(model[0], window=(0.0, 1.0))])) == 20


@pytest.mark.parametrize("periods", [2, 4, 6])
def test_other_signals_are_no_chance(periods: int) -> None:
    """Days run the signals of the measured periods in turn; each half of them has all of these."""
    generator = np.random.default_rng(3)
    own = generator.standard_normal((periods, len(USED), 1))

    def days(seed: int, count: int) -> list[Tally]:
        values = gaussian(seed, count) + own[np.arange(count) % periods]
        found = days_of(values)
        return [replace(day, period=str(k % periods)) for k, day in enumerate(found)]

    pools = Pools({"network": np.ones((1, 1)), "lane": np.eye(1)}, THRESHOLDS)
    null = Null(pools, days(9, 60), 4, speeds=True)
    assert null.expected < 4 * len(USED)
    assert null.test(days(10, 4)).p > 0.05


def test_other_stretches_are_no_chance() -> None:
    """A shift of two standard errors or so is seen as well as within one stretch."""
    pools = Pools({"network": np.ones((1, 1)), "lane": np.eye(1)}, THRESHOLDS)
    null = Null(pools, stretches(9, 60, 10.0), 4, speeds=True)
    assert null.expected < 4 * len(USED)
    assert null.test(stretches(10, 4, 10.0)).p > 0.05
    assert null.test(stretches(10, 4, 10.0, shift=4.0)).p < 0.01


def test_means_are_ratios_and_their_variance_is_that_of_ratios() -> None:
    # 10 s of 4 vehicles, 6 s of 2, 20 s of 6: mean 36 / 12 = 3, residuals -2, 0, 2 at 4 per day.
    values = np.array([[[10 / 4]], [[6 / 2]], [[20 / 6]]])
    weights = (4.0, 2.0, 6.0)
    tallies = [
        days_of(day[None], weight, ("lost",))[0]
        for day, weight in zip(values, weights, strict=True)
    ]
    block = Reference(NETWORK, tallies).blocks["network"]
    row = INDEX["lost"]
    assert block.mean[0, row] == pytest.approx(3.0)
    assert block.weight[0, row] == pytest.approx(4.0)
    assert block.variance[0, row] == pytest.approx(((2 / 4) ** 2 + (2 / 4) ** 2) / 2)
    assert block.error[0, row] == pytest.approx(0.25 / 3)


@pytest.mark.parametrize("probes", [3, 30, 300])
def test_a_few_probes_are_as_often_off_as_their_number_says(probes: int) -> None:
    generator = np.random.default_rng(probes)
    (plain,) = days_of(np.full((1, len(USED), 1), 10.0))

    def day(count: int) -> Tally:
        total_s = generator.normal(60.0, 20.0, count).sum()
        return replace(plain, supplementary={TRAVEL_TIME: np.array([[[total_s, count]]])})

    pools = Pools(NETWORK.blocks, THRESHOLDS, 1, {TRAVEL_TIME: (Label("a", "b"),)})
    reference = Reference(pools, [day(300) for _ in range(100)])
    found = [reference.distance([day(probes)]).z[TRAVEL_TIME][0, 0] for _ in range(300)]
    assert 0.75 < np.std(found) < 1.25


def test_data_with_fewer_observations_are_noisier() -> None:
    reference = Reference(NETWORK, days_of(gaussian(4, 800)))
    values = np.full((1, len(USED), 1), 10.0)
    values[0, 0] += 4.0
    many = reference.distance(days_of(values)).z["network"][0, INDEX["lost"]]
    few = reference.distance(days_of(values, WEIGHT / 4)).z["network"][0, INDEX["lost"]]
    assert many / few == pytest.approx(2.0, rel=0.02)


def test_lanes_pool_by_adding() -> None:
    weights = np.broadcast_to(np.array([10.0, 20.0, 30.0]), (len(USED), 3))
    tallies = [day for values in gaussian(5, 30, 3) for day in days_of(values[None], weights)]
    reference = Reference(SEVERAL, tallies)
    lane, network = reference.blocks["lane"], reference.blocks["network"]
    row = INDEX["gap2"]
    expected = (lane.mean[:, row] * [10, 20, 30]).sum() / 60
    assert network.mean[0, row] == pytest.approx(expected)
    assert network.weight[0, row] == pytest.approx(60)


def test_intersections_pool_only_where_there_are_several() -> None:
    def layout(lights: int) -> DetectorLayout:
        lanes = tuple(IncomingLane(f"in{i}_0", f"in{i}", i, (0,), 10.0, {}) for i in range(lights))
        exits = ((0, "out_0", "x"),)
        return DetectorLayout(tuple(f"C{i}" for i in range(lights)), lanes, exits, (), {})

    assert set(Pools.of(layout(1), THRESHOLDS).blocks) == {"network", "lane"}
    pools = Pools.of(layout(2), THRESHOLDS).blocks
    assert pools["intersection"].tolist() == [[1, 0, 1], [0, 1, 0]]
    assert pools["network"].tolist() == [[1, 1, 1]]


# --- what does not count -------------------------------------------------------------------------


def test_a_statistic_that_is_hardly_observed_never_counts() -> None:
    values = gaussian(6, 200)
    weights = np.full((len(USED), 1), WEIGHT)
    weights[2] = 1.0
    tallies = [day for item in values for day in days_of(item[None], weights)]
    reference = Reference(NETWORK, tallies)
    wild = np.full((5, len(USED), 1), 10.0)
    wild[:, 2] = 1e9
    found = reference.distance(days_of(wild))
    assert found.total < 1.0
    assert found.z["network"][0, INDEX[USED[2]]] == 0.0


def test_a_statistic_without_observations_in_the_data_never_counts() -> None:
    reference = Reference(NETWORK, days_of(gaussian(7, 200)))
    values = np.full((5, len(USED), 1), 10.0)
    weights = np.full((len(USED), 1), WEIGHT)
    weights[0] = 0.0
    found = reference.distance([d for v in values for d in days_of(v[None], weights)])
    assert np.isfinite(found.total)
    assert found.total < 1.0


def test_without_speeds_features_of_speed_never_count() -> None:
    tallies = days_of(gaussian(8, 200))
    values = np.full((5, len(USED), 1), 10.0)
    values[:, USED.index("free_speed")] = 99.0
    assert "free_speed" in SPEED_FEATURES
    assert Reference(NETWORK, tallies, speeds=False).distance(days_of(values)).total < 1.0
    assert Reference(NETWORK, tallies, speeds=True).distance(days_of(values)).total > 1000.0


def test_a_constant_statistic_is_not_infinitely_precise() -> None:
    reference = Reference(NETWORK, days_of(np.full((50, len(USED), 1), 10.0)))
    found = reference.distance(days_of(np.full((5, len(USED), 1), 10.001)))
    assert np.isfinite(found.total)
    assert found.total < 10.0


def test_one_wild_lane_counts_only_so_much() -> None:
    reference = Reference(SEVERAL, days_of(gaussian(9, 400, 3)))
    values = np.full((1, len(USED), 3), 10.0)
    parts: list[float] = []
    for outlier in (10.0, 1e6):
        values[0, 0, 1] = 10.0 + outlier
        parts.append(reference.distance(days_of(values)).parts["lane"])
    # (5 asinh(z / 5))^2: 5 asinh(2) = 7.2 and 5 asinh(2e5) = 64.5, but for the shrunk correlation.
    assert parts[0] == pytest.approx(7.2**2, rel=0.25)
    assert parts[1] == pytest.approx(64.5**2, rel=0.25)


def test_bins_in_time_count_as_their_poisson_noise() -> None:
    generator = np.random.default_rng(10)

    def day(rate: float) -> Tally:
        bins = np.zeros((len(BIN_FEATURES), 1, 12))
        bins[1, 0] = generator.poisson(rate, 12)
        return Tally(np.zeros((len(FEATURES), 1, 2)), bins)

    reference = Reference(NETWORK, [day(30.0) for _ in range(300)])
    assert reference.blocks["time"].variance[1].mean() == pytest.approx(30.0, rel=0.1)
    data = [[day(30.0) for _ in range(5)] for _ in range(200)]
    assert np.mean([reference.distance(d).parts["time"] for d in data]) == pytest.approx(
        12, rel=0.1
    )


# --- common random numbers -----------------------------------------------------------------------


def test_paired_days_say_more_about_the_mean() -> None:
    # The same days under a model that adds 2 to everything, with a little noise of its own.
    base_values = gaussian(11, 400)
    base = Reference(NETWORK, days_of(base_values))
    row = INDEX["lost"]
    errors: list[float] = []
    plain: list[float] = []
    claimed: list[float] = []
    for seed in range(60):
        chosen = np.random.default_rng(seed).choice(400, 8, replace=False)
        own = 0.2 * np.random.default_rng([seed, 1]).standard_normal((8, len(USED), 1))
        after = days_of(base_values[chosen] + 2.0 + own)
        before = days_of(base_values[chosen])
        paired = Reference(NETWORK, after, prior=base, paired=before).blocks["network"]
        alone = Reference(NETWORK, after, prior=base).blocks["network"]
        truth = base.blocks["network"].mean[0, row] + 2.0
        errors.append(paired.mean[0, row] - truth)
        plain.append(alone.mean[0, row] - truth)
        claimed.append(paired.error[0, row])
    assert np.std(errors) < 0.4 * np.std(plain)
    assert np.mean(np.square(errors)) < 1.5 * np.mean(claimed)


def test_few_days_borrow_variances_from_the_prior() -> None:
    base = Reference(NETWORK, days_of(gaussian(12, 400)))
    row = INDEX["lost"]
    flat = Reference(NETWORK, days_of(np.full((6, len(USED), 1), 10.0)), prior=base)
    # Half their own (nothing but the grain), half the prior's.
    assert flat.blocks["network"].variance[0, row] == pytest.approx(0.5, rel=0.15)


def test_a_shift_is_measured_on_the_same_days() -> None:
    values = gaussian(13, 8)
    moved = values.copy()
    moved[:, 1] += 1.5
    difference, variance = change_between(NETWORK, days_of(moved), days_of(values))
    assert difference["network"][0, INDEX[USED[1]]] == pytest.approx(1.5)
    assert difference["network"][0, INDEX[USED[0]]] == pytest.approx(0.0)
    assert variance["network"][0, INDEX[USED[1]]] == pytest.approx(0.0, abs=1e-12)


# --- whitening -----------------------------------------------------------------------------------


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_the_norm_of_a_whitened_difference_is_the_mahalanobis_distance(correlation: float) -> None:
    reference = Reference(NETWORK, days_of(gaussian(14, 300, correlation=correlation)))
    data = days_of(gaussian(15, 5, mean=11.0, correlation=correlation))
    whitened = Whitener(reference, data, 0.0).measured
    assert float(whitened @ whitened) == pytest.approx(reference.distance(data).total)


def test_whitened_noise_is_white() -> None:
    reference = Reference(NETWORK, days_of(gaussian(16, 1500, correlation=0.7)))
    data = days_of(gaussian(17, 5, correlation=0.7))
    whitener = Whitener(reference, data, 0.0)
    mean = reference.blocks["network"].mean
    rows = []
    for values in gaussian(18, 1500, correlation=0.7).reshape(300, 5, len(USED), 1):
        pooled = NETWORK.pool(sum_of(days_of(values)))["network"]
        value = pooled[..., 0] / np.maximum(pooled[..., 1], 1e-9)
        difference = np.where(pooled[..., 1] > 0, value - np.nan_to_num(mean), 0.0)
        time = np.zeros((len(BIN_FEATURES), 1))
        rows.append(whitener({"network": difference, "time": time}))
    covariance = np.cov(np.stack(rows).T)
    assert covariance == pytest.approx(np.eye(len(USED)), abs=0.25)


def test_tolerance_makes_large_differences_less_precise() -> None:
    reference = Reference(NETWORK, days_of(gaussian(19, 300)))
    data = days_of(np.full((5, len(USED), 1), 1000.0))
    whitened = Whitener(reference, data, 0.1).measured
    # Everything is off by 990, known to a tenth of that.
    assert np.abs(whitened).mean() == pytest.approx(10.0, rel=0.1)


# --- is what is left chance? ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def null() -> Null:
    return Null(SEVERAL, days_of(gaussian(20, 60, 3)), 5, speeds=True)


def test_null_data_are_seldom_rejected() -> None:
    chances: list[float] = []
    beyond: list[bool] = []
    for model in range(6):  # each knows its own noise from 60 days only
        null = Null(SEVERAL, days_of(gaussian(30 + model, 60, 3)), 5, speeds=True)
        data = gaussian(21 + 100 * model, 400, 3).reshape(80, 5, len(USED), 3)
        found = [null.test(days_of(item)) for item in data]
        chances += [item.p for item in found]
        beyond += [item.distance > item.floor for item in found]
        mean = float(np.mean([item.distance for item in found]))
        assert mean == pytest.approx(null.expected, rel=0.3)
    p = np.array(chances)
    assert (p < 0.05).mean() <= 0.05
    assert (p < 0.01).mean() <= 0.02
    assert ((p >= 0) & (p <= 1)).all()
    assert np.median(p) > 0.3
    assert np.mean(beyond) < 0.05


def test_a_difference_on_all_days_is_found(null: Null) -> None:
    values = gaussian(22, 5, 3)
    values[:, 0] += 3.0
    found = null.test(days_of(values))
    assert found.p < 1e-4
    assert found.distance > found.floor


def test_one_broken_day_of_five_is_no_discrepancy(null: Null) -> None:
    values = gaussian(23, 5, 3)
    assert null.test(days_of(values)).p > 0.05
    values[2] += 30.0
    assert null.test(days_of(values)).distance > null.floor
    assert null.test(days_of(values)).p > 0.05


def test_uncertain_parameters_make_the_test_more_lenient(null: Null) -> None:
    values = gaussian(24, 5, 3)
    values[:, 0] += 1.5
    extra = {name: np.full_like(b.mean, 4.0) for name, b in null.reference.blocks.items()}
    assert null.test(days_of(values), extra).p > null.test(days_of(values)).p


def test_the_test_is_deterministic() -> None:
    tallies, data = days_of(gaussian(25, 40, 3)), days_of(gaussian(26, 5, 3))
    one, two = (Null(SEVERAL, tallies, 5, speeds=True).test(data) for _ in range(2))
    assert one == two


@pytest.mark.parametrize("periods", [1, 2, 30])
def test_any_number_of_periods_can_be_tested(periods: int) -> None:
    null = Null(SEVERAL, days_of(gaussian(27, 24, 3)), periods, speeds=True)
    assert 0 < null.test(days_of(gaussian(28, periods, 3))).p <= 1
