"""Fits in a world whose statistics are straight lines: the answer is known in advance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.diagnosis import Hypothesis, Reference, Tally, records
from ugat_marl.diagnosis.engine import Engine, OrdinaryDays, Replicate, spread
from ugat_marl.diagnosis.features import BIN_FEATURES, FEATURES, INDEX
from ugat_marl.diagnosis.fit import (
    Fitter,
    _may_move,
    _moved_a_little,
    _possible,
    _shifted,
    _straightness,
    uncertainty,
)
from ugat_marl.diagnosis.hypotheses import Members
from ugat_marl.diagnosis.propose import Direction
from ugat_marl.diagnosis.prune import doubtful
from ugat_marl.diagnosis.records import Fitted
from ugat_marl.diagnosis.statistics import Pools
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import Effect

THRESHOLDS = Thresholds()

Array = NDArray[np.float64]

POOLS = Pools({"network": np.ones((1, 1))}, THRESHOLDS)
WIDTH = 20
HEADWAY = Hypothesis("headway", (), ("seconds",), ((1.5,),), (1.0,), 0.05)
GAP = Hypothesis("min_gap", (), ("metres",), ((3.5,),), (2.5,), 0.2)
_GENERATOR = np.random.default_rng(1)
SLOPES = {
    "headway": 6.0 * _GENERATOR.standard_normal(WIDTH),
    "min_gap": 2.0 * _GENERATOR.standard_normal(WIDTH),
}
NOMINAL = {"headway": 1.0, "min_gap": 2.5}


def day(number: int, values: dict[str, float], street: int = 0) -> Tally:
    """A day of the world, with noise that belongs to the day and not to the model."""
    noise = np.random.default_rng([street, number]).standard_normal(WIDTH)
    mean = 20.0 + sum((values[name] - NOMINAL[name]) * SLOPES[name] for name in values)
    sums = np.zeros((len(FEATURES), 1, 2))
    sums[:WIDTH, 0] = np.stack([100 * (mean + noise), np.full(WIDTH, 100.0)], axis=-1)
    return Tally(sums, np.zeros((len(BIN_FEATURES), 1, 1)))


class World(Engine):
    """Simulates by a formula."""

    ordinary_days = OrdinaryDays()

    def __init__(self) -> None:
        self._thresholds = THRESHOLDS
        self.asked: list[tuple[str, ...]] = []

    def replicates(
        self,
        effects: Sequence[Effect],
        numbers: Sequence[int],
        advance: Callable[[], None] | None = None,
    ) -> list[Replicate]:
        self.asked.append(tuple(map(str, effects)))
        return [Replicate(self.played(number, effects), 60.0) for number in numbers]

    def played(self, number: int, effects: Sequence[Effect]) -> Tally:
        """One day of a model."""
        values = {
            e.name: float(next(v for k, v in e.record().items() if k != "name")) for e in effects
        }
        return day(number, values)


def played(world: World) -> dict[int, Tally]:
    """Days of the scenario as it is."""
    return {number: item.tally for number, item in world.ordinary((), range(80)).items()}


def a_fitter(
    truth: dict[str, float], street: int, days: int = 8, world: World | None = None
) -> Fitter:
    world = world or World()
    base_days = played(world)
    base = Reference(POOLS, list(base_days.values()))
    data = [day(number, truth, street) for number in range(5)]
    return Fitter(world, POOLS, base, base_days, data, days=days, speeds=True)


def start(*members: tuple[Hypothesis, float]) -> Members:
    return tuple((hypothesis, (value,)) for hypothesis, value in members)


def test_a_planted_value_is_found_from_afar() -> None:
    fitter = a_fitter({"headway": 1.43}, street=7)
    best = fitter.refine(fitter.simulate(start((HEADWAY, 1.9))))
    assert best.values[0] == pytest.approx(1.43, abs=0.06)
    assert best.cost < fitter.simulate(start((HEADWAY, 1.9))).cost


class Hours(World):
    """Counts of a network over 24 hours, each with its own demand."""

    order = spread(24)

    def __init__(self) -> None:
        super().__init__()
        self.demand = 3000 * (1.2 + np.sin(2 * np.pi * (np.arange(24) - 9) / 24))

    def played(self, number: int, effects: Sequence[Effect]) -> Tally:
        return self.counted(number, math.prod(float(e.record()["factor"]) for e in effects))

    def counted(self, number: int, factor: float, street: int = 0) -> Tally:
        """One hour, in which as many vehicles come as `factor` says, and chance."""
        hour = self.order[number % 24]
        generator = np.random.default_rng([street, number])
        sums = np.zeros((len(FEATURES), 1, 2))
        sums[INDEX["count_stop"], 0] = (generator.poisson(factor * self.demand[hour]), 60)
        bins = np.zeros((len(BIN_FEATURES), 1, 1))
        return Tally(sums, bins, window=(3600.0 * hour, 3600.0 * (hour + 1)))


def test_demand_is_fitted_in_the_hours_of_a_day_of_which_few_are_simulated() -> None:
    """Hours of the night alone would ask for twice as much as is missing."""
    world = Hours()
    demand = Hypothesis(
        "demand_level", (("edge", "*"),), ("factor",), ((0.8,), (1.2,)), (1.0,), 0.03, both=True
    )
    base_days = {number: world.counted(number, 1.0) for number in range(144)}
    base = Reference(POOLS, list(base_days.values()))
    data = [world.counted(number, 1.2, street=9) for number in range(24)]
    fitter = Fitter(world, POOLS, base, base_days, data, days=6, speeds=True)
    best = fitter.refine(fitter.simulate(start((demand, 1.1))), 6)
    assert best.values[0] == pytest.approx(1.2, abs=0.04)


@pytest.mark.parametrize("value", [0.5, 0.95, 0.99, 0.9999, 1.0])
def test_a_derivative_near_the_end_of_a_range_is_no_shorter_than_elsewhere(value: float) -> None:
    sigma = Hypothesis("imperfection", (), ("sigma",), ((0.85,),), (0.5,), 0.05)
    (moved,) = _moved_a_little(sigma, (value,), 0, 0.1)
    assert abs(moved - value) >= 0.05 - 1e-9 and 0 <= moved <= 1


def test_two_values_are_fitted_at_once() -> None:
    fitter = a_fitter({"headway": 1.43, "min_gap": 3.3}, street=8)
    best = fitter.refine(fitter.simulate(start((HEADWAY, 1.2), (GAP, 4.0))))
    assert best.values == pytest.approx([1.43, 3.3], abs=0.2)


def directions(fitter: Fitter, *members: tuple[Hypothesis, float]) -> list[Direction]:
    """Changes of the statistics by single effects at one strength, as a search knows them."""
    plain = fitter.simulate(())
    return [
        Direction(hypothesis, (value,), *fitter.difference(plain, member), hypothesis.nominal)
        for hypothesis, value in members
        for member in [start((hypothesis, value))]
    ]


def test_known_directions_save_simulations() -> None:
    slow, quick = World(), World()
    members = start((HEADWAY, 1.2), (GAP, 4.0))
    truth = {"headway": 1.43, "min_gap": 3.3}
    known = directions(a_fitter(truth, street=8), (HEADWAY, 1.5), (GAP, 3.5))
    found: list[Fitted] = []
    for world, given in ((slow, ()), (quick, known)):
        fitter = a_fitter(truth, street=8, world=world)
        begun = fitter.simulate(members)
        world.asked.clear()
        found.append(fitter.refine(begun, directions=given))
    assert found[1].values == pytest.approx(found[0].values, abs=0.05)
    assert len(set(quick.asked)) < 0.6 * len(set(slow.asked))


def test_misleading_directions_are_given_up() -> None:
    fitter = a_fitter({"headway": 1.43}, street=7)
    true = directions(fitter, (HEADWAY, 1.5))[0]
    opposite = {name: -values for name, values in true.difference.items()}
    wrong = replace(true, difference=opposite)
    best = fitter.refine(fitter.simulate(start((HEADWAY, 1.9))), directions=[wrong])
    assert best.values[0] == pytest.approx(1.43, abs=0.06)


def test_steps_correct_slopes() -> None:
    fitter = a_fitter({"headway": 1.43, "min_gap": 3.3}, street=8)
    known = directions(fitter, (HEADWAY, 1.5), (GAP, 3.5))
    twice = [
        replace(one, difference={k: 2 * v for k, v in one.difference.items()}) for one in known
    ]
    best = fitter.refine(fitter.simulate(start((HEADWAY, 1.2), (GAP, 4.0))), 6, twice)
    assert best.values == pytest.approx([1.43, 3.3], abs=0.2)


class Bent(World):
    """A strong response that falls off: long moves say less than short ones."""

    def played(self, number: int, effects: Sequence[Effect]) -> Tally:
        values = {e.name: float(e.record()["seconds"]) for e in effects}
        return day(number, {name: 1.0 + 400.0 / value for name, value in values.items()})


def test_near_the_data_moves_are_shortened_to_where_statistics_are_linear() -> None:
    fitter = a_fitter({"headway": 1.0 + 400.0 / 3.0}, street=17)
    fitter.engine = Bent()
    model = fitter.simulate(start((HEADWAY, 3.0)))
    ((_, far),) = fitter.changes(model)
    ((_, near),) = fitter.changes(model, closely=True)
    assert far == pytest.approx(THRESHOLDS.nearby * 2.0)
    assert near == pytest.approx(HEADWAY.least)


@pytest.mark.parametrize("afar", [1.2, 5.0])
def test_a_fit_whose_cost_still_falls_goes_on(afar: float) -> None:
    """Of three steps from there the last one takes off nine tenths of the cost."""
    fitter = a_fitter({"headway": 1.0 + 400.0 / 3.0}, street=17)
    fitter.engine = Bent()
    best = fitter.refine(fitter.simulate(start((HEADWAY, afar))), 1)
    assert best.values[0] == pytest.approx(3.0, abs=0.005)


EMERGENCY = Hypothesis("emergency_deceleration", (), ("mps2",), ((3.0,),), (9.0,), 0.5)


class Bounded(World):
    """An emergency deceleration that changes nothing above 2 m/s^2."""

    def played(self, number: int, effects: Sequence[Effect]) -> Tally:
        values = {
            e.name: float(next(v for k, v in e.record().items() if k != "name")) for e in effects
        }
        hard = values.pop("emergency_deceleration", 9.0) < 2.0
        return day(number, {**values, "min_gap": 4.0 if hard else 2.5})


def test_an_effect_near_its_bound_does_not_hold_the_others_back() -> None:
    fitter = a_fitter({"headway": 1.4, "min_gap": 4.0}, street=17, world=Bounded())
    assert [list(free) for free in _may_move(start((HEADWAY, 1.2), (EMERGENCY, 1.9)))] == [
        [True, True],
        [True, False],
    ]
    assert len(_may_move(start((EMERGENCY, 1.9)))) == len(_may_move(start((HEADWAY, 1.2)))) == 1
    best = fitter.refine(fitter.simulate(start((HEADWAY, 1.2), (EMERGENCY, 1.9))))
    assert best.values[0] == pytest.approx(1.4, abs=0.06)
    assert best.values[1] < 2.0


def test_the_true_model_costs_least() -> None:
    fitter = a_fitter({"headway": 1.43}, street=9)
    true = fitter.refine(fitter.simulate(start((HEADWAY, 1.5))))
    wrong = fitter.refine(fitter.simulate(start((GAP, 3.5))))
    both = fitter.refine(fitter.simulate(start((HEADWAY, 1.5), (GAP, 2.7))))
    assert true.cost < wrong.cost
    assert true.cost < both.cost, "an effect that is not there is not worth its price"


def test_values_stay_in_range() -> None:
    fitter = a_fitter({"headway": 1.0}, street=10)
    allowed = HEADWAY.clipped((-1e9,))[0], HEADWAY.clipped((1e9,))[0]
    best = fitter.refine(fitter.simulate(start((HEADWAY, allowed[1]))))
    assert allowed[0] <= best.values[0] <= allowed[1]


def test_a_model_without_numbers_has_nothing_to_refine() -> None:
    fitter = a_fitter({"headway": 1.2}, street=11)
    plain = fitter.simulate(())
    assert fitter.refine(plain) is plain
    errors, extra = uncertainty(fitter, plain)
    assert len(errors) == 0
    assert not any(values.any() for values in extra.values())


def test_95_percent_intervals_cover_95_percent() -> None:
    inside = 0
    errors: list[float] = []
    estimates: list[float] = []
    for street in range(100, 160):
        fitter = a_fitter({"headway": 1.4}, street)
        best = fitter.refine(fitter.simulate(start((HEADWAY, 1.5))))
        (error,), _ = uncertainty(fitter, best)
        errors.append(error)
        estimates.append(best.values[0])
        inside += abs(best.values[0] - 1.4) <= 1.96 * error
    assert 0.85 <= inside / 60 <= 1.0
    assert np.mean(errors) == pytest.approx(np.std(estimates), rel=0.4)


def test_stretches_of_the_day_make_no_interval_wider() -> None:
    fitter = a_fitter({"headway": 1.4}, street=18)
    model = fitter.simulate(start((HEADWAY, 1.4)))
    days = [day(number, {"headway": 1.4}) for number in range(24)]
    busier = np.array([1.3, 1.0])
    apart = [
        replace(one, sums=one.sums * busier if number % 2 else one.sums, window=(number % 2, 9.0))
        for number, one in enumerate(days)
    ]
    (alike,), _ = uncertainty(fitter, model, days)
    (error,), _ = uncertainty(fitter, model, apart)
    assert error == pytest.approx(alike, rel=0.5)
    (alone,), _ = uncertainty(
        fitter, model, [replace(d, window=(n, 9)) for n, d in enumerate(days)]
    )
    assert alone == pytest.approx(alike, rel=0.5)


def test_uncertain_values_make_statistics_uncertain() -> None:
    fitter = a_fitter({"headway": 1.4}, street=12)
    best = fitter.refine(fitter.simulate(start((HEADWAY, 1.5))))
    (error,), extra = uncertainty(fitter, best)
    slopes = SLOPES["headway"]
    assert extra["network"][0, :WIDTH] == pytest.approx((slopes * error) ** 2, rel=0.02)


def test_the_same_days_are_compared() -> None:
    # Base and model share their noise, so the model's mean is as well known as the base's.
    fitter = a_fitter({"headway": 1.4}, street=13)
    found = fitter.simulate(start((HEADWAY, 1.4)))
    expected = fitter.base.blocks["network"].mean[0, :WIDTH] + 0.4 * SLOPES["headway"]
    assert found.reference.blocks["network"].mean[0, :WIDTH] == pytest.approx(expected, abs=0.02)


def test_a_fit_is_deterministic() -> None:
    def fitted() -> Array:
        fitter = a_fitter({"headway": 1.43, "min_gap": 3.3}, street=8)
        return fitter.refine(fitter.simulate(start((HEADWAY, 1.2), (GAP, 4.0)))).values

    assert (fitted() == fitted()).all()


# --- the last step, derivatives and windows ------------------------------------------------------


def test_a_fit_that_stopped_early_takes_a_last_step() -> None:
    fitter = a_fitter({"headway": 1.43}, street=14)
    early = fitter.simulate(start((HEADWAY, 1.9)))
    found = fitter.settled(early, np.array([0.03]))
    assert found.values[0] == pytest.approx(1.43, abs=0.09)  # three standard errors of five days
    assert found.cost < early.cost
    assert len(found.tallies) == THRESHOLDS.settling_days > len(early.tallies)


class LocksUp(World):
    """Traffic stands still on one day of every model but the scenario as it is."""

    ordinary_days = OrdinaryDays(day_to_day=10.0)

    def played(self, number: int, effects: Sequence[Effect]) -> Tally:
        found = super().played(number, effects)
        found.bins[0] = 1000.0 + 10.0 * np.sin(number)
        if effects and number == 3:
            found.bins[0] = 500.0
            found.sums[:WIDTH, 0, 0] += 3000.0
        return found


def test_a_day_on_which_a_model_locks_up_is_no_part_of_it() -> None:
    fitter = a_fitter({"headway": 1.43}, street=14, world=LocksUp())
    model = fitter.simulate(start((HEADWAY, 1.5)))
    assert list(model.days) == [0, 1, 2, 4, 5, 6, 7]
    mean = model.reference.blocks["network"].mean[0, :WIDTH]
    assert mean == pytest.approx(20.0 + 0.5 * SLOPES["headway"], abs=0.35)
    found = fitter.settled(fitter.refine(model), np.array([0.03]))
    assert found.values[0] == pytest.approx(1.43, abs=0.09)


def test_a_fit_within_its_errors_stays_where_it_is() -> None:
    fitter = a_fitter({"headway": 1.43}, street=15)
    found = fitter.settled(fitter.simulate(start((HEADWAY, 1.46))), np.array([1.0]))
    assert found.values[0] == 1.46
    assert len(found.tallies) == THRESHOLDS.settling_days
    plain = fitter.simulate(())
    assert fitter.settled(plain, np.empty(0)) is plain


def test_an_effect_without_a_value_is_simulated_on_as_many_days_as_others() -> None:
    fitter = a_fitter({"headway": 1.43}, street=15)
    known = Hypothesis("headway", (("seconds", 1.43),), (), ((),), None)
    found = fitter.settled(fitter.simulate(((known, ()),)), np.empty(0))
    assert len(found.tallies) == THRESHOLDS.settling_days


def test_a_derivative_is_taken_over_a_move_that_does_something_plain() -> None:
    fitter = a_fitter({"headway": 1.43}, street=16)
    model = fitter.simulate(start((HEADWAY, 2.5), (GAP, 3.7)))
    (strong, far), (weak, farther) = fitter.changes(model)
    assert far == pytest.approx(THRESHOLDS.nearby * 1.5), "a strong effect is moved a little"
    assert 1.5 * THRESHOLDS.nearby * 1.2 < farther <= THRESHOLDS.far * 1.2 + 1e-4, "a weak one more"
    for name, change, delta in (("headway", strong, far), ("min_gap", weak, farther)):
        assert change["network"][0, :WIDTH] / delta == pytest.approx(SLOPES[name], rel=1e-6)


def test_what_does_nothing_is_moved_no_farther_than_nominal() -> None:
    fitter = a_fitter_of_windows(Windows.TRUTH)
    after = (("edge", "a"), ("begin_s", 3600.0), ("end_s", 4200.0))
    dead = Hypothesis("demand_surge", after, ("factor",), ((1.5,),), (1.0,), 0.05)
    model = fitter.simulate(start((dead, 1.3)))
    ((change, delta),) = fitter.changes(model)
    assert abs(delta) <= THRESHOLDS.far * 0.3 + 1e-4
    assert not change["network"][0].any()


class Windows(World):
    """Every statistic is three minutes of an hour, of which a surge takes some."""

    TRUTH = (900.0, 2400.0)

    def played(self, number: int, effects: Sequence[Effect]) -> Tally:
        change = np.zeros(WIDTH)
        for item in (effect.record() for effect in effects):
            window = float(item["begin_s"]), float(item["end_s"])
            change += (float(item["factor"]) - 1.0) * surge(*window)
        return with_surge(number, change)


def surge(begin_s: float, end_s: float) -> Array:
    """Share of the window in every three minutes, times what a factor of 2 does there."""
    edges = np.linspace(0.0, 3600.0, WIDTH + 1)
    return 20.0 * np.clip(
        np.minimum(edges[1:], end_s) - np.maximum(edges[:-1], begin_s), 0.0, None
    ) / 180.0  # fmt: skip


def with_surge(number: int, change: Array, street: int = 0) -> Tally:
    plain = day(number, {}, street)
    plain.sums[:WIDTH, 0, 0] += 100.0 * change
    return plain


def a_surge(begin_s: float, end_s: float) -> Members:
    fixed = (("edge", "a"), ("begin_s", begin_s), ("end_s", end_s))
    return ((Hypothesis("demand_surge", fixed, ("factor",), ((1.5,),), (1.0,), 0.1), (1.5,)),)


def a_fitter_of_windows(*truth: tuple[float, float]) -> Fitter:
    world = Windows()
    base_days = played(world)
    change = 0.5 * sum((surge(*window) for window in truth), np.zeros(WIDTH))
    data = [with_surge(number, change, 18) for number in range(5)]
    base = Reference(POOLS, list(base_days.values()))
    return Fitter(world, POOLS, base, base_days, data, days=8, speeds=True)


def window_of(members: Members, place: int = 0) -> tuple[float, float]:
    fixed = dict(members[place][0].fixed)
    return float(fixed["begin_s"]), float(fixed["end_s"])


@pytest.mark.parametrize(
    "first",
    [(600.0, 2700.0), (1200.0, 2100.0), (600.0, 2100.0), (1200.0, 2700.0), (900.0, 2400.0)],
)
def test_a_window_five_minutes_off_at_both_ends_is_found(first: tuple[float, float]) -> None:
    fitter = a_fitter_of_windows(Windows.TRUTH)
    begun = fitter.simulate(a_surge(*first))
    best = fitter.fitted(begun)
    assert window_of(best.members) == pytest.approx(Windows.TRUTH, abs=45.0)
    assert best.values[0] == pytest.approx(1.5, abs=0.05)
    assert best.cost <= begun.cost


def test_two_windows_that_are_off_to_both_sides_are_found() -> None:
    truth = (600.0, 1200.0), (2400.0, 3000.0)
    fitter = a_fitter_of_windows(*truth)
    members = (*a_surge(480.0, 1080.0), *a_surge(2520.0, 3120.0))
    best = fitter._windows(fitter.simulate(members))
    for place, window in enumerate(truth):
        assert window_of(best.members, place) == pytest.approx(window, abs=45.0)


def test_the_values_alone_would_not_find_the_window() -> None:
    fitter = a_fitter_of_windows(Windows.TRUTH)
    begun = fitter.simulate(a_surge(600.0, 2700.0))
    assert fitter.refine(begun).cost > fitter.fitted(begun).cost + 100.0


def test_windows_stay_on_the_clock_and_keep_a_minute() -> None:
    fitter = a_fitter_of_windows((0.0, 180.0))
    best = fitter.fitted(fitter.simulate(a_surge(120.0, 420.0)))
    assert window_of(best.members) == pytest.approx((0.0, 180.0), abs=45.0)
    world = fitter.engine
    assert isinstance(world, Windows)
    for text in {item for model in world.asked for item in model}:
        began, ended = map(float, text.split(",")[1:3])
        assert began >= 0.0
        assert ended - began >= THRESHOLDS.shortest_window_s


def test_how_strong_a_surge_was_is_only_known_together_with_how_long_it_lasted() -> None:
    fitter = a_fitter_of_windows(Windows.TRUTH)
    model = fitter.simulate(a_surge(*Windows.TRUTH))
    (error,), extra = uncertainty(fitter, model)
    # Least squares by hand: the derivatives in strength, begin and end, and noise of variance 1.
    strength = surge(*Windows.TRUTH)
    begin = (surge(960.0, 2400.0) - strength) * 0.5 / 60.0
    end = (surge(900.0, 2340.0) - strength) * 0.5 / 60.0
    rows = np.stack([strength, begin, end])
    covariance = np.linalg.inv(rows @ rows.T) * (1 / 5 + 1 / 8)
    alone = np.sqrt((1 / 5 + 1 / 8) / (strength @ strength))
    assert covariance[0, 0] ** 0.5 > 1.02 * alone
    assert error == pytest.approx(covariance[0, 0] ** 0.5, rel=0.35)
    edge = int(2400.0 / 180.0)
    assert extra["network"][0, edge] > 0.0, "the minutes at the ends are uncertain, too"


def test_a_value_that_does_nothing_is_not_known_exactly() -> None:
    fitter = a_fitter_of_windows(Windows.TRUTH)
    after = (("edge", "a"), ("begin_s", 3600.0), ("end_s", 4200.0))
    dead = Hypothesis("demand_surge", after, ("factor",), ((1.5,),), (1.0,), 0.05)
    model = fitter.simulate((*a_surge(*Windows.TRUTH), (dead, (1.3,))))
    (known, unknown), _ = uncertainty(fitter, model)
    ((_, delta),) = fitter.changes(fitter.simulate(((dead, (1.3,)),)))
    assert known < 0.05
    assert unknown == pytest.approx(abs(delta))


class Steps(World):
    """Whole vehicles: a headway of 1.3 s does what one of 1.7 s does."""

    def played(self, number: int, effects: Sequence[Effect]) -> Tally:
        values = {e.name: float(e.record()["seconds"]) for e in effects}
        return day(number, {name: round(2 * value) / 2 for name, value in values.items()})


def test_steps_make_an_interval_wide_and_straight_ways_do_not() -> None:
    straight = a_fitter({"headway": 1.4}, street=17)
    model = straight.simulate(start((HEADWAY, 1.4)))
    plain, _ = uncertainty(straight, model)
    straightly, _ = uncertainty(straight, model, steps=True)
    assert straightly == pytest.approx(plain, rel=1e-3)

    stepped = a_fitter({"headway": 1.4}, street=17)
    stepped.engine = Steps()
    model = stepped.simulate(start((HEADWAY, 1.5)))
    blind, kept = uncertainty(stepped, model)
    seen, same = uncertainty(stepped, model, steps=True)
    assert 3.0 * blind[0] < seen[0] < 0.5
    assert (same["network"] == kept["network"]).all(), "what the model shows is known as it was"


class Shaken(World):
    """Any move changes which vehicles meet: all moves have 0.1 s in common."""

    def played(self, number: int, effects: Sequence[Effect]) -> Tally:
        values = {e.name: float(e.record()["seconds"]) for e in effects}
        return day(number, {name: value + 0.1 * (value != 1.4) for name, value in values.items()})


def test_what_all_moves_have_in_common_changes_no_interval() -> None:
    """It seems that a value does more than it does, so that its first error is too small."""
    straight, shaken = (a_fitter({"headway": 1.4}, street=17) for _ in range(2))
    shaken.engine = Shaken()
    right, _ = uncertainty(straight, straight.simulate(start((HEADWAY, 1.4))))
    model = shaken.simulate(start((HEADWAY, 1.4)))
    small, _ = uncertainty(shaken, model)
    told, _ = uncertainty(shaken, model, steps=True)
    assert small[0] < 0.9 * right[0]
    assert told == pytest.approx(right, rel=0.02)


class Jumping(World):
    """What 1.4 s does is far from what any other value does, and on the same side of it."""

    def played(self, number: int, effects: Sequence[Effect]) -> Tally:
        values = {e.name: float(e.record()["seconds"]) for e in effects}
        return day(number, {name: value + 9.0 * (value != 1.4) for name, value in values.items()})


def test_values_that_the_data_rule_out_are_in_no_interval() -> None:
    jumping = a_fitter({"headway": 1.4}, street=17)
    jumping.engine = Jumping()
    model = jumping.simulate(start((HEADWAY, 1.4)))
    nothing = 0.4 - HEADWAY.least / 2  # headway 1.0 changes nothing
    for error, end in ((0.01, 0.02), (3.0, nothing)):
        bound = _possible(jumping, model, np.array([error]))
        assert bound == pytest.approx([end / 1.96], rel=1e-3)
    straight = a_fitter({"headway": 1.4}, street=17)
    near = _possible(straight, straight.simulate(start((HEADWAY, 1.4))), np.array([0.001]))
    held = (0.4 - HEADWAY.least / 2) / 1.96
    assert near == pytest.approx([held], rel=1e-3), "without it the data fit far worse"
    mild = a_fitter({"headway": 1.02}, street=17)
    near = _possible(mild, mild.simulate(start((HEADWAY, 1.02))), np.array([0.001]))
    assert near == [np.inf], "values so near fit as well"


def test_days_that_say_little_leave_no_interval_that_the_data_rule_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    straight = a_fitter({"headway": 1.4}, street=17)
    model = straight.simulate(start((HEADWAY, 1.4)))
    monkeypatch.setattr("ugat_marl.diagnosis.fit._spread_of_days", lambda *_: np.eye(1) * 100.0)
    errors, _ = uncertainty(straight, model, steps=True)
    assert errors == pytest.approx([(0.4 - HEADWAY.least / 2) / 1.96], rel=1e-3)
    blank: Any = None
    assert not doubtful(records.Tested(model, blank, errors, {}), 1.96)


def test_moves_to_both_ends_of_a_range_may_be_crooked() -> None:
    """Four moves, to 0.1 s and to 10 s twice each, of which those below do nothing."""

    def difference(_model: object, members: Members) -> tuple[dict[str, Any], dict[str, Any]]:
        return {"moved": members[0][1][0] - 5.0}, {}

    fitter: Any = SimpleNamespace(thresholds=THRESHOLDS, difference=difference)
    model: Any = SimpleNamespace(members=start((HEADWAY, 5.0)))
    found = _straightness(fitter, model, np.array([9.0]), lambda x: np.array([max(x["moved"], 0)]))
    slope = 25.0 / (25.0 + 4.9**2)
    left = 2 * (4.9**2 + (5.0 / slope - 5.0) ** 2) / 3
    assert [float(x[0]) for x in found] == pytest.approx([slope, left])


@pytest.mark.parametrize("name", ["dropout", "stuck", "lane_closure"])
def test_windows_that_a_log_shows_are_not_moved(name: str) -> None:
    place = "detector" if name != "lane_closure" else "lane"
    fixed = ((place, "S_C_0"), ("begin_s", 300.0), ("end_s", 600.0))
    hypothesis = Hypothesis(name, fixed, (), ((),), None)
    moved = _shifted(hypothesis, (60.0, 0.0), 60.0)
    assert (moved == hypothesis) is (name != "lane_closure")
