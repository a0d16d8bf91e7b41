"""Which effects are proposed for a difference that was put together by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.diagnosis import Hypothesis, Reference, Tally
from ugat_marl.diagnosis.features import BIN_FEATURES, FEATURES
from ugat_marl.diagnosis.hypotheses import Members, merged
from ugat_marl.diagnosis.propose import (
    Direction,
    _useful,
    between,
    exchanges,
    promising,
    propose,
    squared_gap,
)
from ugat_marl.diagnosis.records import Proposed
from ugat_marl.diagnosis.statistics import Pools, Whitener
from ugat_marl.diagnosis.thresholds import Thresholds

Array = NDArray[np.float64]

THRESHOLDS = Thresholds(price=14.0)
POOLS = Pools({"network": np.ones((1, 1))}, THRESHOLDS)
WIDTH = 30
NO_TIME = np.zeros((len(BIN_FEATURES), 1))

NAMES = ("headway", "min_gap", "acceleration", "deceleration", "imperfection", "startup_delay",
         "desired_speed", "heavy_share")  # fmt: skip
FIELDS = ("seconds", "metres", "mps2", "mps2", "sigma", "seconds", "factor", "share")
NOMINAL = (1.0, 2.5, 2.6, 4.5, 0.5, 0.0, 1.0, 0.0)
LEVEL = (1.5, 3.5, 1.6, 3.0, 0.8, 0.6, 0.85, 0.1)


def day(values: Array) -> Tally:
    sums = np.zeros((len(FEATURES), 1, 2))
    sums[:WIDTH, 0] = np.stack([100.0 * values, np.full(WIDTH, 100.0)], axis=-1)
    return Tally(sums, np.zeros((len(BIN_FEATURES), 1, 1)))


@pytest.fixture(scope="module")
def reference() -> Reference:
    noise = np.random.default_rng(1).standard_normal((400, WIDTH))
    return Reference(POOLS, [day(20.0 + values) for values in noise])


def directions(seed: int = 2, size: float = 12.0) -> list[Direction]:
    """Hypotheses that move the statistics in directions of their own."""
    generator = np.random.default_rng(seed)
    found: list[Direction] = []
    for name, field, nominal, level in zip(NAMES, FIELDS, NOMINAL, LEVEL, strict=True):
        direction = np.zeros((1, len(FEATURES)))
        direction[0, :WIDTH] = generator.standard_normal(WIDTH)
        direction *= size / np.linalg.norm(direction)
        hypothesis = Hypothesis(name, (), (field,), ((level,),), (nominal,), 0.0)
        nothing = np.zeros_like(direction)
        found.append(
            Direction(
                hypothesis,
                (level,),
                {"network": direction, "time": NO_TIME},
                {"network": nothing, "time": NO_TIME},
                (nominal,),
            )
        )
    return found


def whitener(
    reference: Reference,
    planted: dict[str, float],
    among: Sequence[Direction],
    noise: int | None = None,
) -> Whitener:
    """For data in which these hypotheses are present, at multiples of their directions."""
    values = reference.blocks["network"].mean[0, :WIDTH].copy()
    for direction in among:
        strength = planted.get(direction.hypothesis.name, 0.0)
        values = values + strength * direction.difference["network"][0, :WIDTH]
    rows = np.tile(values, (5, 1))
    if noise is not None:
        rows = rows + np.random.default_rng(noise).standard_normal(rows.shape)
    return Whitener(reference, [day(row) for row in rows], 0.0)


def values(proposal: Proposed) -> dict[str, float]:
    return {hypothesis.name: found[0] for hypothesis, found in proposal.members}


@pytest.mark.parametrize(
    "planted",
    [
        {"headway": 0.7},
        {"min_gap": 1.2, "desired_speed": 0.5},
        {"acceleration": 1.0, "deceleration": 0.6, "startup_delay": 0.9},
        {"headway": 0.4, "imperfection": 0.3, "heavy_share": 1.3},
    ],
)
def test_planted_combinations_are_recovered_exactly(
    reference: Reference, planted: dict[str, float]
) -> None:
    among = directions()
    best = propose(among, whitener(reference, planted, among), THRESHOLDS)[0]
    expected = {
        name: NOMINAL[NAMES.index(name)]
        + strength * (LEVEL[NAMES.index(name)] - NOMINAL[NAMES.index(name)])
        for name, strength in planted.items()
    }
    assert values(best) == pytest.approx(expected, abs=2e-3)
    # The ridge leaves next to nothing; what remains is the price.
    assert best.expected == pytest.approx(THRESHOLDS.price * len(planted), abs=1.0)


def test_effects_that_hide_each_other_are_proposed_together(reference: Reference) -> None:
    # Two directions that nearly cancel: neither alone helps much, both together explain all.
    among = directions()[:4]
    other = among[1]
    hidden = {
        "network": -0.95 * among[0].difference["network"] + 0.3 * other.difference["network"],
        "time": NO_TIME,
    }
    among[1] = Direction(other.hypothesis, other.level, hidden, other.variance, other.origin)
    target = whitener(reference, {"headway": 1.0, "min_gap": 1.0}, among)
    best = propose(among, target, THRESHOLDS)[0]
    assert set(values(best)) == {"headway", "min_gap"}
    assert best.expected == pytest.approx(2 * THRESHOLDS.price, abs=1.0)


def test_a_price_keeps_spurious_effects_out(reference: Reference) -> None:
    among = directions()
    sizes: list[int] = []
    for seed in range(40):
        best = propose(among, whitener(reference, {"headway": 0.8}, among, noise=seed), THRESHOLDS)[
            0
        ]
        assert "headway" in values(best)
        sizes.append(len(best.members))
    assert np.mean(np.array(sizes) > 1) <= 0.05


def test_of_nothing_but_noise_nothing_is_worth_its_price(reference: Reference) -> None:
    among = directions()
    tempted = 0
    for seed in range(100, 140):
        target = whitener(reference, {}, among, noise=seed)
        found = propose(among, target, THRESHOLDS)
        tempted += bool(found) and found[0].expected < target.gap
    assert tempted <= 2


def test_no_effect_works_backwards(reference: Reference) -> None:
    among = directions()[:3]
    found = propose(among, whitener(reference, {"headway": -0.8}, among), THRESHOLDS)
    assert found
    assert all("headway" not in values(item) for item in found)


def test_rays_are_followed_only_so_far(reference: Reference) -> None:
    among = directions()[:1]
    best = propose(among, whitener(reference, {"headway": 5.0}, among), THRESHOLDS)[0]
    assert values(best)["headway"] == pytest.approx(1.0 + THRESHOLDS.farthest * 0.5)


def test_two_strengths_of_one_hypothesis_never_stand_in_one_model(reference: Reference) -> None:
    among = directions()[:2]
    first = among[0]
    among.append(
        Direction(first.hypothesis, (1.9,), directions(9)[0].difference, first.variance, (1.0,))
    )
    target = whitener(reference, {"headway": 0.8, "min_gap": 0.6}, among)
    for item in propose(among, target, replace(THRESHOLDS, price=0.0)):
        names = [hypothesis.name for hypothesis, _ in item.members]
        assert len(names) == len(set(names))
    assert len(propose(among, target, replace(THRESHOLDS, price=0.0))) == 3  # each alone, and both


def test_a_hypothesis_without_numbers_is_there_or_not(reference: Reference) -> None:
    among = directions()[:2]
    model = Hypothesis("driver_model", (("model", "IDM"),), (), ((),), None)
    among.append(Direction(model, (), directions(5)[0].difference, among[0].variance, None))
    # Its direction alone makes the difference.
    values_ = (
        reference.blocks["network"].mean[0, :WIDTH] + among[2].difference["network"][0, :WIDTH]
    )
    target = Whitener(reference, [day(values_)] * 5, 0.0)
    best = propose(among, target, THRESHOLDS)[0]
    assert [(hypothesis.name, found) for hypothesis, found in best.members] == [
        ("driver_model", ())
    ]


def test_no_rays_no_proposals(reference: Reference) -> None:
    assert propose([], whitener(reference, {}, []), THRESHOLDS) == []


def test_many_rays_are_searched_in_good_time(reference: Reference) -> None:
    among = [
        Direction(
            Hypothesis("headway", (("place", str(i)),), ("seconds",), ((1.5,),), (1.0,)),
            (1.5,),
            directions(100 + i)[0].difference,
            directions()[0].variance,
            (1.0,),
        )
        for i in range(60)
    ]
    target = Whitener(
        reference,
        [
            day(
                reference.blocks["network"].mean[0, :WIDTH]
                + 0.8 * among[7].difference["network"][0, :WIDTH]
                + 0.9 * among[50].difference["network"][0, :WIDTH]
            )
        ]
        * 5,
        0.0,
    )
    best = propose(among, target, THRESHOLDS)[0]
    assert {dict(h.fixed)["place"] for h, _ in best.members} == {"7", "50"}


def test_rays_between_two_strengths_of_one_effect() -> None:
    one, other = directions(3)[0], directions(4)[0]
    strong = Direction(one.hypothesis, (2.0,), other.difference, one.variance, one.origin)
    weak = Direction(one.hypothesis, (0.7,), other.difference, one.variance, one.origin)
    found = between([one, strong], (0.33, 0.67))
    assert found[:2] == [one, strong]
    assert [item.level[0] for item in found[2:]] == pytest.approx([1.665, 1.835])
    middle = found[2].difference["network"]
    straight = 0.67 * one.difference["network"] + 0.33 * other.difference["network"]
    assert middle == pytest.approx(straight)
    # Nothing lies between shorter and longer than nominal, nor between two effects.
    assert len(between([weak, one], (0.33, 0.67))) == 2
    assert len(between(directions()[:2], (0.33, 0.67))) == 2


def on_top(among: Sequence[Direction], present: str, values: tuple[float, ...]) -> list[Direction]:
    """Directions on top of a model with one effect, which goes to nothing and farther."""
    found: list[Direction] = []
    for one in among:
        if one.hypothesis.name != present:
            found.append(one)
            continue
        assert one.hypothesis.nominal is not None
        (usual,), (level,) = one.hypothesis.nominal, one.level
        for new in (usual, values[0] + 0.4 * (values[0] - usual)):
            share = (new - values[0]) / (level - usual)
            moved = {name: share * change for name, change in one.difference.items()}
            found.append(Direction(one.hypothesis, (new,), moved, one.variance, values))
    return found


def left_by(
    reference: Reference, among: Sequence[Direction], hidden: str, present: str, strength: float
) -> tuple[Members, list[Direction], Whitener]:
    """What a model with one effect leaves of data in which another one is hidden."""
    held = next(one for one in among if one.hypothesis.name == present)
    members = ((held.hypothesis, held.at(strength)),)
    planted = dict.fromkeys((hidden,), 1.0)
    planted[present] = planted.get(present, 0.0) - strength
    return members, on_top(among, present, held.at(strength)), whitener(reference, planted, among)


def test_an_imitation_is_exchanged_for_the_right_effect(reference: Reference) -> None:
    among = directions()
    right = among[5]  # a start-up delay; the headway does nearly the same
    mixed = 0.9 * right.difference["network"] + 0.3 * among[0].difference["network"]
    imitation = {"network": mixed, "time": NO_TIME}
    among[0] = replace(among[0], difference=imitation)
    members, above, target = left_by(reference, among, "startup_delay", "headway", 0.9)
    best = exchanges(members, above, target, THRESHOLDS)[0]
    assert values(best) == pytest.approx({"headway": 1.0, "startup_delay": 0.6}, abs=0.02)
    assert best.expected < 1.0 < target.gap
    assert merged(members, best.members) == ((right.hypothesis, (0.6,)),)


def test_what_has_no_values_that_change_nothing_is_not_exchanged(reference: Reference) -> None:
    among = directions()
    mixed = 0.9 * among[5].difference["network"]
    imitation = {"network": mixed, "time": NO_TIME}
    for neutral in (True, False):
        headway = replace(among[0].hypothesis, neutral=neutral)
        among[0] = replace(among[0], hypothesis=headway, difference=imitation)
        members, above, target = left_by(reference, among, "startup_delay", "headway", 0.9)
        assert bool(exchanges(members, above, target, THRESHOLDS)) is neutral


def test_a_right_effect_is_not_exchanged(reference: Reference) -> None:
    among = directions()
    members, above, target = left_by(reference, among, "startup_delay", "startup_delay", 1.0)
    assert exchanges(members, above, target, THRESHOLDS) == []


def test_of_a_strong_effect_a_near_imitation_may_come_though_worse_is_predicted(
    reference: Reference,
) -> None:
    """Without the strong effect a start-up delay is predicted to leave a fiftieth of it."""
    among = [
        replace(one, difference={name: 100.0 * x for name, x in one.difference.items()})
        for one in directions()
    ]
    right, other = among[5], among[2]
    mixed = right.difference["network"] + 0.15 * other.difference["network"]
    among[0] = replace(among[0], difference={"network": mixed, "time": NO_TIME})
    members, above, target = left_by(reference, among, "headway", "headway", 1.0)
    assert target.gap == pytest.approx(0.0, abs=1e-6)
    near = exchanges(members, above, target, THRESHOLDS)
    assert [set(values(one)) for one in near] == [{"headway", "startup_delay"}]
    assert near[0].expected > THRESHOLDS.near_cost
    exact = replace(THRESHOLDS, imitation_share=0.0)
    assert exchanges(members, above, target, exact) == []


def test_of_each_effect_only_the_best_exchanges_are_tried(reference: Reference) -> None:
    among = directions()
    members, above, target = left_by(reference, among, "startup_delay", "headway", 0.9)
    wide = replace(THRESHOLDS, near_share=1e6, near_cost=1e6)
    assert len(exchanges(members, above, target, replace(wide, exchanged=9))) > 2
    assert len(exchanges(members, above, target, wide)) == 2


def test_what_stays_moves_along(reference: Reference) -> None:
    """Beside the imitation another effect is too strong."""
    among = directions()
    right, other = among[5], among[2]
    imitation = {"network": 0.9 * right.difference["network"], "time": NO_TIME}
    among[0] = replace(among[0], difference=imitation)
    held = among[0]
    members = ((held.hypothesis, (1.5,)), (other.hypothesis, other.at(1.3)))
    above = on_top(among, "headway", (1.5,))
    above = on_top(above, "acceleration", other.at(1.3))
    planted = {"startup_delay": 1.0, "acceleration": -0.3, "headway": -1.0}
    best = exchanges(members, above, whitener(reference, planted, among), THRESHOLDS)[0]
    expected = {"headway": 1.0, "startup_delay": 0.6, "acceleration": 1.6}
    assert values(best) == pytest.approx(expected, abs=0.03)


def test_the_variance_between_two_strengths_is_that_of_a_weighted_mean() -> None:
    one, other = directions(3)[0], directions(4)[0]
    variance = {"network": np.full((1, len(FEATURES)), 4.0), "time": NO_TIME}
    weak = replace(one, variance=variance)
    strong = replace(weak, level=(2.0,), difference=other.difference)
    middle = between([weak, strong], (0.25,))[2]
    assert middle.variance["network"] == pytest.approx(4.0 * (0.75**2 + 0.25**2))


def test_changes_of_single_lanes_that_may_be_noise_are_not_proposed() -> None:
    noise = np.random.default_rng(1).standard_normal((400, WIDTH))
    days = [day(20.0 + values) for values in noise]
    reference = Reference(Pools({"lane": np.ones((1, 1))}, THRESHOLDS), days)
    one = directions()[0]
    change = one.difference["network"]
    measured = reference.blocks["lane"].mean[0, :WIDTH] + change[0, :WIDTH]
    target = Whitener(reference, [day(measured)] * 5, 0.0)
    for variance, proposed in ((0.0, 1), (400.0, 0)):
        loud = {"lane": np.full_like(change, variance), "time": NO_TIME}
        of_lane = replace(one, difference={"lane": change, "time": NO_TIME}, variance=loud)
        assert len(propose([of_lane], target, THRESHOLDS)) == proposed


def test_an_effect_with_an_opposite_may_work_backwards(reference: Reference) -> None:
    among = directions()
    opposite = replace(among[0], hypothesis=replace(among[0].hypothesis, both=True))
    target = whitener(reference, {"headway": -0.8}, among)
    (found,) = propose([opposite], target, THRESHOLDS)
    assert values(found)["headway"] == pytest.approx(1.0 - 0.8 * 0.5, abs=0.01)


def test_an_effect_with_an_opposite_may_come_in_its_exchange(reference: Reference) -> None:
    among = directions()
    right = among[5]
    among[0] = replace(
        among[0], difference={"network": 0.9 * right.difference["network"], "time": NO_TIME}
    )
    backwards = {name: -change for name, change in right.difference.items()}
    for both in (True, False):
        hypothesis = replace(right.hypothesis, both=both)
        among[5] = replace(right, hypothesis=hypothesis, difference=backwards)
        held = among[0]
        members = ((held.hypothesis, held.at(0.9)),)
        above = on_top(among, "headway", held.at(0.9))
        target = whitener(reference, {"headway": -0.9, "startup_delay": -1.0}, among)
        found = exchanges(members, above, target, THRESHOLDS)
        assert any("startup_delay" in values(one) for one in found) == both


def in_sizes(*costs: tuple[int, float]) -> list[Proposed]:
    """Sets of effects by their number and the cost that they would leave, least first."""
    among = [one.hypothesis for one in directions()]
    sets = [
        Proposed(tuple((h, (float(place),)) for h in among[:size]), cost)
        for place, (size, cost) in enumerate(costs)
    ]
    return sorted(sets, key=lambda proposal: proposal.expected)


def test_a_larger_set_has_to_promise_clearly_more() -> None:
    worth = THRESHOLDS.larger_share * 100.0 - THRESHOLDS.larger_gain
    for cost, sizes in ((worth + 1.0, [1]), (worth - 1.0, [1, 2])):
        chosen = promising(in_sizes((1, 100.0), (2, cost)), THRESHOLDS)
        assert [len(one.members) for one in chosen] == sizes


def test_near_sets_of_a_size_are_tried_too_but_not_all() -> None:
    most = THRESHOLDS.near_share * 100.0 + THRESHOLDS.near_cost
    near = np.linspace(100.0, most - 1.0, THRESHOLDS.candidates[0] + 3)
    chosen = promising(in_sizes(*((1, float(cost)) for cost in near)), THRESHOLDS)
    assert [one.expected for one in chosen] == list(near[: THRESHOLDS.candidates[0]])
    far = promising(in_sizes((1, 100.0), (1, most + 1.0)), THRESHOLDS)
    assert [one.expected for one in far] == [100.0]


def test_the_hypotheses_of_the_best_sets_are_kept_for_triples() -> None:
    among = directions()
    sets = in_sizes((1, 9.0), (2, 5.0))
    best: dict[tuple[object, ...], Proposed] = {(i,): one for i, one in enumerate(sets[::-1])}
    third = replace(sets[0], members=((among[7].hypothesis, (0.1,)),), expected=1.0)
    best[(9,)] = third
    assert _useful(best, among, 2) == [7, 0]
    assert _useful(best, among, 9) == [7, 0, 1]


def test_the_gap_is_measured_in_units_of_the_noise_of_the_periods(reference: Reference) -> None:
    shifted = reference.blocks["network"].mean[0, :WIDTH] + 0.2 * np.eye(WIDTH)[0]
    gaps = [
        squared_gap(reference.distance([day(shifted)] * periods), reference, periods)
        for periods in (1, 4)
    ]
    assert gaps[0] == pytest.approx(0.04, rel=0.3), "the noise has a variance of 1"
    assert gaps[1] == pytest.approx(4 * gaps[0], rel=0.05)
