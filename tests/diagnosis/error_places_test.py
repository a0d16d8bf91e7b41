"""Which detectors err: equations solved by hand, and groups that are made up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from ugat_marl.diagnosis.error_places import Equation, ErrorPlaces, Group

PRIORS, PRICE = (1.0, 3.0), 8.0


def zones(
    extension_s: float, zone_m: float, speeds: Sequence[float] = (5.0, 15.0)
) -> list[Equation]:
    return [Equation(extension_s + zone_m / v, (1.0, 1 / v), 1e-3) for v in speeds]


def one(value: float, error: float = 0.01) -> list[Equation]:
    return [Equation(value, (1.0,), error)]


def found(of: dict[str, list[Equation]], priors: Sequence[float] = (1.0,)) -> dict[str, float]:
    groups: dict[Group, list[Equation]] = {}
    for name, rows in of.items():
        kind, _, edge = name.partition("_")
        groups[kind, edge] = rows
    choice = ErrorPlaces(groups, priors, PRICE).choose()
    return {place: round(x.value, 2) for (place, _), x in choice.estimates.items()}


def test_a_line_through_two_speeds_gives_extension_and_zone() -> None:
    choice = ErrorPlaces({("stop", "a"): zones(0.5, 2.0)}, PRIORS, PRICE).choose()
    assert [x.value for x in choice.estimates.values()] == pytest.approx([0.5, 2.0], rel=1e-3)
    # (a / sd)^2 of the prior, and two prices
    assert choice.cost == pytest.approx(0.5**2 + (2 / 3) ** 2 + 16, rel=1e-3)


@pytest.mark.parametrize(("extension_s", "zone_m", "index"), [(0.5, 0.0, 0), (0.0, 2.0, 1)])
def test_only_the_number_that_is_needed_is_taken(
    extension_s: float, zone_m: float, index: int
) -> None:
    choice = ErrorPlaces({("stop", "a"): zones(extension_s, zone_m)}, PRIORS, PRICE).choose()
    assert list(choice.estimates) == [("stop", index)]


def test_nothing_costs_the_squared_misfit() -> None:
    choice = ErrorPlaces({("stop", "a"): one(0.01)}, (1.0,), PRICE).choose()
    assert (choice.estimates, choice.cost) == ({}, pytest.approx(1.0))
    assert ErrorPlaces({}, (1.0,), PRICE).choose().cost == 0.0


def test_the_fewest_places_that_suffice_are_taken() -> None:
    assert found({"stop_a": one(1.0), "stop_b": one(1.0), "exit_a": one(1.0)}) == {"*": 1.0}
    assert found({"stop_a": one(1.0), "stop_b": one(1.0), "exit_a": one(0.0)}) == {"stop": 1.0}
    assert found({"stop_a": one(1.0), "stop_b": one(0.0)}) == {"stop@a": 1.0}
    assert found({"stop_a": one(1.0), "stop_b": one(-1.0)}) == {"stop@a": 1.0, "stop@b": -1.0}
    assert found({"stop_a": one(0.0), "stop_b": one(0.01)}) == {}


def test_no_detector_has_the_same_number_twice() -> None:
    apart = {f"stop_{edge}": one(value) for edge, value in zip("abcd", (1, 1, 1, 2), strict=True)}
    assert found(apart) == {"stop@a": 1.0, "stop@b": 1.0, "stop@c": 1.0, "stop@d": 2.0}


def test_what_drivers_share_makes_no_approach_stand_out() -> None:
    shared = [Equation(0.5, (1.0,), 0.01, shared={"drivers": 0.5})]
    assert found({f"stop_{edge}": shared for edge in "abcd"}) == {}
    opposite = [Equation(-0.5, (1.0,), 0.01, shared={"drivers": -0.5})]
    assert found({"stop_a": shared, "stop_b": opposite, "exit_a": shared}) == {}
    usual = [Equation(0.0, (1.0,), 0.01, shared={"drivers": 0.5})]
    assert found({"stop_a": shared, "stop_b": usual, "stop_c": usual}) == {"stop@a": 0.5}


def test_bends_are_taken_off_at_the_places_of_other_points() -> None:
    rows = [Equation(-0.2, (1.0,), 0.01, other_end=-0.2)]
    search = ErrorPlaces({("stop", "a"): rows, ("exit", "a"): one(0.0)}, (1.0,), PRICE)
    costs = [search.solved([], {"stop": share}).cost for share in (0.0, 0.5, 1.0)]
    assert costs == pytest.approx([400.0, 100.0, 0.0], abs=1e-9)
    # twice as far, or a number
    assert search.choose({"stop": 2.0}).cost == pytest.approx(8 + 2 * np.log(2) + 0.2**2, abs=0.1)


@pytest.mark.parametrize("seed", range(8))
def test_planted_numbers_are_found_among_noise(seed: int) -> None:
    generator = np.random.default_rng(seed)
    groups: dict[Group, list[Equation]] = {}
    for kind in ("advance", "stop", "exit"):
        for edge in "abcdefgh":
            rows = zones(0.4 * (kind == "stop"), 2.0 * ((kind, edge) == ("exit", "c")))
            noise = generator.normal(0.0, 0.01, len(rows))
            groups[kind, edge] = [
                Equation(row.value + float(e), row.coefficients, 0.01)
                for row, e in zip(rows, noise, strict=True)
            ]
    choice = ErrorPlaces(groups, PRIORS, PRICE).choose()
    assert set(choice.estimates) == {("stop", 0), ("exit@c", 1)}
    for number, true in ((("stop", 0), 0.4), (("exit@c", 1), 2.0)):
        estimate = choice.estimates[number]
        assert abs(estimate.value - true) < 4 * estimate.error
