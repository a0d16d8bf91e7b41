"""Periods at several times of day: the test keeps its level and its power."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ugat_marl.diagnosis.features import BIN_FEATURES, FEATURES, INDEX, Tally
from ugat_marl.diagnosis.residual import Null
from ugat_marl.diagnosis.statistics import Pools, Reference
from ugat_marl.diagnosis.study import effort_for
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.scenarios import Period

PLACES = 4
NUMBERS = Thresholds()
POOLS = Pools({"network": np.ones((1, PLACES)), "lane": np.eye(PLACES)}, NUMBERS)


def drawn_day(generator: np.random.Generator, stretch: int, stretches: int, factor: float) -> Tally:
    """A day of one stretch, whose demand is its own; `factor` changes counts and gaps."""
    sums = np.zeros((len(FEATURES), PLACES, 2))
    bins = np.zeros((len(BIN_FEATURES), PLACES, 12))
    rate = 40 * (1 + 0.3 * np.sin(2 * np.pi * stretch / stretches)) * factor
    counts = generator.poisson(rate, size=(PLACES, 12))
    for name in ("count_stop", "count_advance"):
        bins[BIN_FEATURES.index(name)] = counts
        sums[INDEX[name], :, 0], sums[INDEX[name], :, 1] = counts.sum(axis=1), 60
    for name in ("gap4-5", "gap6-8", "lost"):
        sums[INDEX[name], :, 0] = 60 * generator.normal(2 * factor, 0.05, PLACES)
        sums[INDEX[name], :, 1] = 60
    return Tally(sums, bins, window=(3600.0 * stretch, 3600.0 * (stretch + 1)))


@pytest.mark.parametrize("stretches", [1, 4, 10, 24])
def test_a_difference_is_seen_however_many_stretches_there_are(stretches: int) -> None:
    hours = [Period(str(h), h, h + 1, "fit", {}, {}) for h in range(stretches)]
    days = effort_for(9, hours).base
    generator = np.random.default_rng(stretches)

    def data(count: int, factor: float = 1.0) -> list[Tally]:
        return [drawn_day(generator, i % stretches, stretches, factor) for i in range(count)]

    null = Null(POOLS, data(days), max(stretches, 5), speeds=True)
    assert null.test(data(max(stretches, 5), 1.05)).p < 1e-3
    chances = [null.test(data(max(stretches, 5))).p for _ in range(20)]
    assert min(chances) > 1e-3 and sum(p < 0.05 for p in chances) <= 4


def test_an_interval_that_some_days_lack_is_compared_on_the_others() -> None:
    """Of twenty days each lacks a twentieth of the intervals, and one interval is mostly gone."""
    generator = np.random.default_rng(5)
    reference = Reference(POOLS, [drawn_day(generator, 0, 1, 1.0) for _ in range(36)])
    data: list[Tally] = []
    for _ in range(20):
        day = drawn_day(generator, 0, 1, 1.1)
        known = (generator.random(day.bins.shape) > 0.05).astype(float)
        known[..., 7] = generator.random() > 0.8
        data.append(replace(day, bins=day.bins * known, known=known))
    distance, used = reference.distance(data), reference.blocks["time"].used
    compared = distance.used["time"][used].reshape(-1, 12)
    assert compared[:, :7].all() and compared[:, 8:].all() and not compared[:, 7].any()
    # a tenth more than 40 vehicles, whatever days are missing
    assert distance.difference["time"][used].mean() == pytest.approx(4 * 11 / 12, abs=0.5)


def test_a_group_of_intervals_counts_on_days_that_have_it_whole() -> None:
    pools = Pools({"network": np.ones((1, 1))}, NUMBERS, together=3)

    def day(missing: int) -> Tally:
        bins = np.full((len(BIN_FEATURES), 1, 6), 10.0)
        known = np.ones_like(bins)
        known[..., missing] = 0.0
        return Tally(np.zeros((len(FEATURES), 1, 2)), bins * known, known=known)

    sums = pools.pool_all([day(0), day(1), day(4)])["time"]
    assert (sums == np.array([[30.0, 1.0], [60.0, 2.0]])).all()


def test_values_are_as_certain_as_within_a_stretch() -> None:
    """The means of stretches differ by far more than days of one of them."""
    generator = np.random.default_rng(3)
    days = [drawn_day(generator, i % 4, 4, 1.0) for i in range(24)]
    reference = Reference(POOLS, days)
    alike = Reference(POOLS, [drawn_day(generator, 0, 4, 1.0) for _ in range(24)])
    for name in ("network", "lane"):
        ratio = reference.blocks[name].variance / alike.blocks[name].variance
        used = reference.blocks[name].used & alike.blocks[name].used
        assert 0.4 < np.median(ratio[used]) < 2.5
