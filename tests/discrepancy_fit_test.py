"""Fits in a world whose statistics are straight lines: the answer is known in advance."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.discrepancy.engine import Engine, Replicate
from ugat_marl.discrepancy.features import BIN_FEATURES, FEATURES, Tally
from ugat_marl.discrepancy.fit import Fitter, Members, uncertainty
from ugat_marl.discrepancy.hypotheses import Hypothesis
from ugat_marl.discrepancy.statistics import Pools, Reference
from ugat_marl.effects import Effect

Array = NDArray[np.float64]

POOLS = Pools({"network": np.ones((1, 1))})
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

    def __init__(self) -> None:
        self.asked: list[tuple[str, ...]] = []

    def replicates(
        self,
        effects: Sequence[Effect],
        numbers: Sequence[int],
        advance: Callable[[], None] | None = None,
    ) -> list[Replicate]:
        del advance
        self.asked.append(tuple(map(str, effects)))
        values = {
            e.name: float(next(v for k, v in e.record().items() if k != "name")) for e in effects
        }
        return [Replicate(day(number, values), 60.0) for number in numbers]


def a_fitter(truth: dict[str, float], street: int, days: int = 8) -> Fitter:
    world = World()
    base_tallies = [item.tally for item in world.replicates((), range(80))]
    base = Reference(POOLS, base_tallies)
    data = [day(number, truth, street) for number in range(5)]
    return Fitter(world, POOLS, base, base_tallies, data, days=days, price=14.0, speeds=True)


def start(*members: tuple[Hypothesis, float]) -> Members:
    return tuple((hypothesis, (value,)) for hypothesis, value in members)


def test_a_planted_value_is_found_from_afar() -> None:
    fitter = a_fitter({"headway": 1.43}, street=7)
    best = fitter.refine(fitter.simulate(start((HEADWAY, 1.9))))
    assert best.values[0] == pytest.approx(1.43, abs=0.06)
    assert best.cost < fitter.simulate(start((HEADWAY, 1.9))).cost


def test_two_values_are_fitted_at_once() -> None:
    fitter = a_fitter({"headway": 1.43, "min_gap": 3.3}, street=8)
    best = fitter.refine(fitter.simulate(start((HEADWAY, 1.2), (GAP, 4.0))))
    assert best.values == pytest.approx([1.43, 3.3], abs=0.2)


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
