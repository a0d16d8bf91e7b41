"""Single effects along their own direction: closed forms, power, and a null made anew per half."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.diagnosis import Hypothesis, Reference, Tally
from ugat_marl.diagnosis.features import BIN_FEATURES, EVENT_FEATURES, FEATURES
from ugat_marl.diagnosis.propose import Direction
from ugat_marl.diagnosis.residual import Directed, Directions, MatchedFilters, Null
from ugat_marl.diagnosis.statistics import Pools
from ugat_marl.diagnosis.thresholds import Thresholds

THRESHOLDS = Thresholds()

Array = NDArray[np.float64]

NETWORK = Pools({"network": np.ones((1, 1))}, THRESHOLDS)
SEVERAL = Pools({"network": np.ones((1, 3)), "lane": np.eye(3)}, THRESHOLDS)
ROWS = [row for row, (name, _, _) in enumerate(FEATURES) if name not in EVENT_FEATURES]
WIDTH = len(ROWS)
WEIGHT = 50.0
PERIODS = 5


def days_of(values: Array) -> list[Tally]:
    """Days whose features have these means, ``(days, features, places)``."""
    found: list[Tally] = []
    for day in values:
        sums = np.zeros((len(FEATURES), day.shape[1], 2))
        sums[ROWS] = np.stack([day * WEIGHT, np.full_like(day, WEIGHT)], axis=-1)
        found.append(Tally(sums, np.zeros((len(BIN_FEATURES), day.shape[1], 1))))
    return found


def gaussian(seed: Sequence[int], days: int, places: int = 1) -> Array:
    return 10.0 + np.random.default_rng(seed).standard_normal((days, WIDTH, places))


def change(values: Array) -> dict[str, Array]:
    """A change of the network's statistics, and of nothing else."""
    wide = np.zeros((1, len(FEATURES)))
    wide[0, ROWS] = values
    return {"network": wide, "time": np.zeros((len(BIN_FEATURES), 1))}


def unit(*places: int) -> Array:
    """A direction of length 1 that moves these statistics alike."""
    values = np.zeros(WIDTH)
    values[list(places)] = 1.0
    return values / np.linalg.norm(values)


@pytest.fixture(scope="module")
def reference() -> Reference:
    """Many days of unit variance, and no correlation at all."""
    made = Reference(NETWORK, days_of(gaussian([1], 4000)))
    block = made.blocks["network"]
    made.blocks["network"] = replace(block, correlation=np.eye(len(FEATURES)))
    return made


def noise(reference: Reference) -> Array:
    """Of what five days leave, as standard deviations of the statistics that are used."""
    block = reference.blocks["network"]
    return np.sqrt(block.noise(block.weight, PERIODS))[0, ROWS]


def data_at(reference: Reference, off: Array) -> list[Tally]:
    """Five days that lie this many standard deviations of noise from the model."""
    values = reference.blocks["network"].mean[0, ROWS] + off * noise(reference)
    return days_of(np.tile(values[None, :, None], (PERIODS, 1, 1)))


def matched(
    reference: Reference, directions: Sequence[Array], fitted: Sequence[Array] = ()
) -> Callable[[Array], float]:
    """A filter whose directions are in units of noise, asked about differences in them."""
    scale = noise(reference)

    def asked(off: Array) -> float:
        data = data_at(reference, off)
        made = MatchedFilters(
            [change(item * scale) for item in directions],
            reference,
            data,
            ("network",),
            fitted=[change(item * scale) for item in fitted],
        )
        return made(reference.distance(data))

    return asked


def test_a_difference_along_a_direction_is_its_squared_size(reference: Reference) -> None:
    ask = matched(reference, [7.0 * unit(0, 1, 2), unit(5)])
    assert ask(3.0 * unit(0, 1, 2)) == pytest.approx(9.0)
    assert ask(-4.0 * unit(5)) == pytest.approx(16.0)
    # One of three alike: the cosine is the root of a third.
    assert ask(3.0 * unit(1)) == pytest.approx(3.0)
    assert ask(100.0 * unit(8)) == pytest.approx(0.0, abs=1e-9)
    assert ask(3.0 * unit(0, 1, 2) + 2.0 * unit(5)) == pytest.approx(9.0), "the largest, no sum"


def test_parameters_that_are_not_known_make_a_difference_smaller(reference: Reference) -> None:
    data = data_at(reference, 3.0 * unit(0))
    extra = change(3.0 * noise(reference) ** 2)  # four times the noise in all
    found = MatchedFilters([change(unit(0))], reference, data, ("network",), extra)
    assert found(reference.distance(data, extra=extra)) == pytest.approx(9.0 / 4.0)


def test_a_weak_effect_on_everything_shows_only_along_its_direction(reference: Reference) -> None:
    everywhere = np.random.default_rng(2).choice((-1.0, 1.0), WIDTH)
    direction = change(everywhere * noise(reference))
    off = 3.5 * everywhere / np.sqrt(WIDTH)

    def asked(planted: Array, street: int) -> list[tuple[float, float]]:
        values = gaussian([street], 400 * PERIODS) + (planted * noise(reference))[:, None]
        found: list[tuple[float, float]] = []
        for days in values.reshape(400, PERIODS, WIDTH, 1):
            data = days_of(days)
            distance = reference.distance(data)
            along = MatchedFilters([direction], reference, data, ("network",))
            found.append((along(distance), distance.total))
        return found

    plain, planted = np.array(asked(0.0 * off, 3)), np.array(asked(off, 4))
    limits = np.quantile(plain, 0.99, axis=0)
    along, total = (planted > limits).mean(axis=0)
    assert limits[0] == pytest.approx(6.63, rel=0.3)  # 99 % of chi-square with 1
    assert along > 0.7  # normal around 3.5, beyond 2.58: 82 %
    assert total < 0.35


def test_what_a_fit_has_used_up_is_not_looked_at(reference: Reference) -> None:
    ask = matched(reference, [unit(0), unit(3)], fitted=[5.0 * unit(0)])
    assert ask(50.0 * unit(0)) == pytest.approx(0.0, abs=1e-9)
    assert ask(2.0 * unit(3)) == pytest.approx(4.0)
    # Without the fit the same difference is plain: the check above is one.
    assert matched(reference, [unit(0)])(50.0 * unit(0)) == pytest.approx(2500.0)


@pytest.mark.parametrize(("across", "seen"), [(0.9, True), (0.5, True), (0.25, False)])
def test_a_direction_nearly_inside_the_fit_is_dropped(
    reference: Reference, across: float, seen: bool
) -> None:
    assert (across > THRESHOLDS.least_apart) == seen
    direction = np.sqrt(1 - across**2) * unit(0) + across * unit(1)
    found = matched(reference, [direction], fitted=[unit(0)])(4.0 * unit(1))
    assert found == pytest.approx(16.0 if seen else 0.0, abs=1e-9)


def test_a_parameter_that_does_nothing_uses_nothing_up(reference: Reference) -> None:
    ask = matched(reference, [unit(place) for place in range(WIDTH)], fitted=[0.0 * unit(0)])
    for place in range(WIDTH):
        assert ask(3.0 * unit(place)) == pytest.approx(9.0), place


def test_parameters_that_do_the_same_use_up_one_direction(reference: Reference) -> None:
    ask = matched(reference, [unit(place) for place in range(WIDTH)], fitted=[unit(4), unit(4)])
    for place in range(WIDTH):
        assert ask(3.0 * unit(place)) == pytest.approx(0.0 if place == 4 else 9.0, abs=1e-9), place


def test_an_effect_without_consequences_is_no_direction(reference: Reference) -> None:
    assert matched(reference, [0.0 * unit(0)])(5.0 * unit(0)) == 0.0


def test_without_directions_there_are_no_filters(reference: Reference) -> None:
    assert Directions(()).filters(reference, data_at(reference, unit(0))) == {}


def test_filters_look_at_pools_and_at_single_places() -> None:
    made = Reference(SEVERAL, days_of(gaussian([5], 200, 3)))
    lane = made.blocks["lane"]
    moved = np.zeros((3, len(FEATURES)))
    moved[1, ROWS[0]] = 2.0
    nothing = {name: np.zeros_like(block.mean) for name, block in made.blocks.items()}
    hypothesis = Hypothesis("headway", (), ("seconds",), ((1.5,),), (1.0,))
    direction = Direction(hypothesis, (1.5,), nothing | {"lane": moved}, nothing, (1.0,))
    values = np.tile(lane.mean[:, ROWS].T[None], (PERIODS, 1, 1))
    values[:, 0, 1] += 2.0
    data = days_of(values)
    filters = Directions((direction,)).filters(made, data)
    assert set(filters) == {"one effect", "one effect, lanes"}
    distance = made.distance(data)
    assert filters["one effect"](distance) == 0.0, "the effect does not show in the pool"
    assert filters["one effect, lanes"](distance) > 10.0
    # What may be chance in the direction of a single place is left out.
    doubtful = replace(direction, variance=nothing | {"lane": np.ones_like(moved)})
    assert Directions((doubtful,)).filters(made, data)["one effect, lanes"](distance) == 0.0


# --- under a null --------------------------------------------------------------------------------


def some_directions(reference: Reference, count: int = 8) -> list[dict[str, Array]]:
    generator = np.random.default_rng(6)
    return [
        {name: generator.standard_normal(b.mean.shape) for name, b in reference.blocks.items()}
        for _ in range(count)
    ]


def together(seed: Sequence[int], days: int) -> list[Tally]:
    """Days on which nearly everything moves together, as it does on days of more traffic."""
    loads = 3.0 * np.random.default_rng(5).standard_normal((1, WIDTH, 1))
    common = np.random.default_rng([*seed, 1]).standard_normal((days, 1, 1))
    return days_of(gaussian(seed, days, 3) + common * loads)


def test_filters_are_made_for_each_half_and_for_the_whole() -> None:
    seen: list[int] = []

    def factory(reference: Reference) -> Directed:
        seen.append(reference._of_window.total())
        return lambda _: {"one effect": 1.0}

    null = Null(SEVERAL, days_of(gaussian([7], 41, 3)), PERIODS, speeds=True, directed=factory)
    assert sorted(seen) == [20, 21, 41]
    assert "one effect" in null.test(days_of(gaussian([8], PERIODS, 3))).blocks


def test_a_directed_statistic_replaces_no_other() -> None:
    def factory(_: Reference) -> Directed:
        return lambda _: {"lane": 1.0}

    with pytest.raises(ValueError, match="statistics of one name: lane"):
        Null(SEVERAL, days_of(gaussian([7], 41, 3)), PERIODS, speeds=True, directed=factory)


def chances(*, anew: bool) -> Array:
    """Of plain data, with filters made for each half, or once from all days."""
    found: list[float] = []
    for model in range(4):
        tallies = together([9, model], 60)
        streets = [together([10, model, street], PERIODS) for street in range(15)]

        def made(reference: Reference, data: Sequence[Tally] = streets[0]) -> Directed:
            matched = MatchedFilters(some_directions(reference), reference, data, ("network",))
            return lambda distance: {"one effect": matched(distance)}

        once = made(Reference(SEVERAL, tallies))

        def again(_: Reference, once: Directed = once) -> Directed:
            return once

        null = Null(SEVERAL, tallies, PERIODS, speeds=True, directed=made if anew else again)
        found += [null.test(data).blocks["one effect"] for data in streets]
    return np.array(found)


def test_filters_made_anew_reject_plain_data_as_seldom_as_they_say() -> None:
    p = chances(anew=True)
    assert (p < 0.05).mean() <= 0.15
    assert 0.25 < np.median(p) < 0.8


def test_filters_that_know_the_days_they_judge_reject_plain_data() -> None:
    # The mistake that the test above is for.
    p = chances(anew=False)
    assert (p < 0.05).mean() > 0.2
    assert np.median(p) < 0.25
