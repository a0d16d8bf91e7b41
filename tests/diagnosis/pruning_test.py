"""Which effects are left out, in a world where cost and chance are given by hand."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ugat_marl.diagnosis import Hypothesis, global_hypotheses, records, select
from ugat_marl.diagnosis.engine import OutOfTime
from ugat_marl.diagnosis.features import FEATURES
from ugat_marl.diagnosis.fit import Fitter
from ugat_marl.diagnosis.hypotheses import CAUTION, Members, library
from ugat_marl.diagnosis.prune import Pruner, doubtful
from ugat_marl.diagnosis.records import Fitted
from ugat_marl.diagnosis.select import Selector
from ugat_marl.diagnosis.thresholds import Effort, Thresholds
from ugat_marl.effects import known_effects, load_scenario
from ugat_marl.progress import Advance, Silent

THRESHOLDS = Thresholds()

HEADWAY = (Hypothesis("headway", (), ("seconds",), ((1.5,),), (1.0,), 0.05), (1.5,))
DEMAND = (Hypothesis("demand_level", (), ("factor",), ((1.2,),), (1.0,), 0.02), (0.95,))
SPEED = (Hypothesis("desired_speed", (), ("factor",), ((1.2,),), (1.0,), 0.02), (1.2,))
FEW = 500.0
"""What a model costs more when few days were simulated."""


@dataclass
class Ledger:
    """Costs and chances of sets of effects, by their names."""

    costs: dict[tuple[str, ...], float]
    chances: dict[tuple[str, ...], float]
    luck: dict[tuple[str, ...], float] = field(default_factory=dict)
    tested: list[tuple[str, ...]] = field(default_factory=list)
    exactly: list[tuple[str, ...]] = field(default_factory=list)
    refined: dict[tuple[str, ...], Members] = field(default_factory=dict)
    in_the_end: dict[tuple[str, ...], float] = field(default_factory=dict)
    thresholds: Thresholds = THRESHOLDS

    def simulate(self, members: Members, days: int | None = None) -> Fitted:
        cost = self.costs[names(members)]
        if days is None:
            cost += FEW + self.luck.get(names(members), 0.0)
        blank = cast(Any, None)
        return Fitted(members, {}, blank, blank, cost)

    def refine(self, start: Fitted, rounds: int, *, closely: bool = False) -> Fitted:
        members = self.refined.get(names(start.members), start.members)
        cost = self.in_the_end.get(names(members), start.cost) if closely else start.cost
        return replace(start, members=members, cost=cost)

    def fitted(self, start: Fitted, directions: object) -> Fitted:
        return self.refine(start, 1)

    def test(self, model: Fitted) -> records.Tested:
        self.tested.append(names(model.members))
        return self.with_chance(self.simulate(model.members, 16))

    def kept(self, model: Fitted) -> Fitted:
        return model

    def exact(self, tested: records.Tested) -> records.Tested:
        self.exactly.append(names(tested.model.members))
        return tested

    def with_chance(self, model: Fitted, errors: float = 0.0) -> records.Tested:
        chance = cast(Any, Chance(self.chances[names(model.members)]))
        return records.Tested(model, chance, np.full(len(model.values), errors), {})

    def left(self, *members: tuple[Hypothesis, tuple[float, ...]], errors: float = 0.0) -> Members:
        best = self.with_chance(self.simulate(members, 16), errors)
        fitter = cast(Fitter, cast(object, self))
        blank = cast(Any, None)
        base = records.Tested(Fitted((), {}, blank, blank, 0.0), blank, np.empty(0), {})
        left = Pruner(fitter, self, 0.05, Silent()).pruned(best, base)
        if left.model.members:
            assert self.exactly[-1] == names(left.model.members), "the result has exact errors"
        return left.model.members


@dataclass
class Chance:
    p: float


def selector_with(ledger: Ledger) -> Any:
    """A selector whose simulations are those of a ledger."""
    selector: Any = object.__new__(Selector)
    selector._fitter, selector._thresholds, selector._reporter = ledger, THRESHOLDS, Silent()
    selector._seen, selector._of_round, selector._alpha = {}, {}, 0.05
    selector._effort, selector._of_library, selector._places = Effort(), (), ()
    selector._library = ()
    return selector


def spent(*_: object) -> None:
    """Stand for a step at which the budget ends."""
    raise OutOfTime("the budget is spent")


def names(members: Members) -> tuple[str, ...]:
    return tuple(hypothesis.name for hypothesis, _ in members)


@pytest.mark.parametrize("more", [1.0, 100.0, THRESHOLDS.negligible - 1.0])
def test_what_the_other_explains_alone_is_left_out(more: float) -> None:
    both = ("headway", "demand_level")
    ledger = Ledger(
        {both: 1000.0, ("headway",): 1000.0 + more, ("demand_level",): 9000.0},
        {both: 0.9, ("headway",): 0.8, ("demand_level",): 0.0},
    )
    assert ledger.left(HEADWAY, DEMAND) == (HEADWAY,)


def test_luck_on_a_few_days_leaves_nothing_out() -> None:
    both = ("headway", "demand_level")
    ledger = Ledger(
        {both: 1000.0, ("headway",): 1400.0, ("demand_level",): 9000.0},
        {both: 0.9, ("headway",): 0.8, ("demand_level",): 0.0},
        {("headway",): -700.0},
    )
    assert ledger.left(HEADWAY, DEMAND) == (HEADWAY, DEMAND)
    assert not ledger.tested


def test_what_leaves_more_than_chance_behind_stays() -> None:
    both = ("headway", "demand_level")
    ledger = Ledger(
        {both: 1000.0, ("headway",): 1040.0, ("demand_level",): 9000.0},
        {both: 0.9, ("headway",): 1e-4, ("demand_level",): 0.0},
    )
    assert ledger.left(HEADWAY, DEMAND) == (HEADWAY, DEMAND)
    assert ledger.tested == [("headway",)]
    assert ledger.exactly == [both], "no exact errors of what is not taken"


def test_no_time_is_lost_on_sets_that_plainly_do_not_suffice() -> None:
    both = ("headway", "demand_level")
    ledger = Ledger(
        {both: 1000.0, ("headway",): 5000.0, ("demand_level",): 9000.0},
        {both: 0.9, ("headway",): 0.5, ("demand_level",): 0.5},
    )
    assert ledger.left(HEADWAY, DEMAND) == (HEADWAY, DEMAND)
    assert not ledger.tested


def test_one_after_the_other_is_left_out() -> None:
    every = ("headway", "demand_level", "desired_speed")
    costs: dict[tuple[str, ...], float]
    costs = {every: 1000.0, every[:2]: 1010.0, ("headway", "desired_speed"): 1020.0}
    costs |= {every[1:]: 9000.0, ("headway",): 1030.0, ("demand_level",): 9000.0}
    ledger = Ledger(costs, dict.fromkeys(costs, 0.6))
    assert ledger.left(HEADWAY, DEMAND, SPEED) == (HEADWAY,)


def test_an_effect_whose_interval_holds_the_nominal_value_is_doubted_where_nothing_suffices() -> (
    None
):
    both = ("headway", "demand_level")
    ledger = Ledger(
        {both: 1000.0, ("headway",): 1400.0, ("demand_level",): 9000.0},
        {both: 1e-6, ("headway",): 1e-9, ("demand_level",): 0.0},
    )
    assert ledger.left(HEADWAY, DEMAND, errors=0.04) == (HEADWAY,)
    assert ledger.left(HEADWAY, DEMAND, errors=0.01) == (HEADWAY, DEMAND)


def test_an_effect_too_weak_to_matter_is_dropped() -> None:
    weak = (DEMAND[0], (0.99,))
    both = ("headway", "demand_level")
    ledger = Ledger({both: 1000.0, ("headway",): 9000.0}, {both: 0.9, ("headway",): 0.0})
    assert ledger.left(HEADWAY, weak) == (HEADWAY,)


def test_an_effect_that_is_fitted_to_nothing_is_not_named() -> None:
    both, nothing = ("headway", "demand_level"), (DEMAND[0], (1.0,))
    ledger = Ledger(
        {both: 1000.0, ("headway",): 9000.0, ("demand_level",): 900.0},
        {both: 0.0, ("headway",): 0.0, ("demand_level",): 0.0},
        refined={("demand_level",): (nothing,)},
    )
    assert ledger.left(HEADWAY, DEMAND) == ()
    assert ledger.left(nothing) == ()


def test_what_the_fit_without_another_effect_makes_too_weak_to_matter_is_dropped() -> None:
    every, weak = ("headway", "demand_level", "desired_speed"), (DEMAND[0], (0.99,))
    costs: dict[tuple[str, ...], float]
    costs = {every: 1000.0, every[:2]: 900.0, every[::2]: 9000.0, every[1:]: 9000.0}
    costs |= {("headway",): 5000.0, ("demand_level",): 9000.0}
    ledger = Ledger(costs, dict.fromkeys(costs, 0.9), refined={every[:2]: (HEADWAY, weak)})
    assert ledger.left(HEADWAY, DEMAND, SPEED) == (HEADWAY,)


def test_progress_is_told_of_every_smaller_set() -> None:
    both = ("headway", "demand_level")
    ledger = Ledger({both: 1000.0, ("headway",): 1900.0, ("demand_level",): 9000.0}, {both: 0.9})
    best = ledger.with_chance(ledger.simulate((HEADWAY, DEMAND), 16))
    notes: list[str] = []

    class Heard(Silent):
        @contextlib.contextmanager
        def task(self, name: str, total: int) -> Iterator[Advance]:
            assert (name, total) == ("without single effects", 2)
            yield lambda note="": notes.append(note)

    fitter = cast(Fitter, cast(object, ledger))
    Pruner(fitter, ledger, 0.05, Heard()).pruned(best, best)
    assert sorted(notes) == ["demand_level", "headway"]


def test_an_effect_whose_interval_holds_the_usual_value_is_never_named() -> None:
    both = ("headway", "demand_level")
    ledger = Ledger(
        {both: 1000.0, ("headway",): 1400.0, ("demand_level",): 9000.0},
        {both: 0.9, ("headway",): 1e-9, ("demand_level",): 0.0},
    )
    # the set suffices and its parts do not, but 0.95 +- 0.08 may be the usual 1
    assert ledger.left(HEADWAY, DEMAND, errors=0.04) == (HEADWAY,)
    assert ledger.left(HEADWAY, DEMAND, errors=0.02) == (HEADWAY, DEMAND)


def test_the_least_certain_effect_goes_first_and_the_rest_is_judged_anew() -> None:
    every = ("headway", "demand_level", "desired_speed")
    costs: dict[tuple[str, ...], float]
    costs = {every: 1000.0, every[:2]: 9000.0, every[1:]: 9000.0, every[::2]: 9000.0}
    costs |= {("headway",): 99000.0, ("desired_speed",): 99000.0}
    ledger = Ledger(costs, {**dict.fromkeys(costs, 1e-9), every: 0.6})
    # headway 0.5, demand 0.05 and speed 0.2 away from usual: 0.11 doubts the last two of them
    assert ledger.left(HEADWAY, DEMAND, SPEED, errors=0.11) == (HEADWAY, SPEED)
    assert set(ledger.tested) == {every[::2]}


def test_if_every_effect_may_be_absent_none_is_named() -> None:
    ledger = Ledger({("headway",): 1000.0}, {("headway",): 0.9})
    assert ledger.left(HEADWAY, errors=0.4) == ()


LOCAL = (
    Hypothesis("demand_surge", (("edge", "a"), ("begin_s", 0.0), ("end_s", 9.0)), ("factor",),
               ((1.5,),), (1.0,), 0.1),
    Hypothesis("turning", (("from_edge", "a"), ("to_edge", "b")), ("share",), ((0.2,),), (0.0,)),
    Hypothesis("parking", (("lane", "a_0"), ("dwell_s", 40.0)), ("per_hour",), ((9.0,),), (0.0,)),
    Hypothesis("local_speed", (("edge", "a"),), ("factor",), ((0.8,),), (1.0,), 0.02),
)  # fmt: skip
EVERY = (*global_hypotheses(load_scenario("single-v1"), library()), *LOCAL)


@pytest.mark.parametrize("hypothesis", [x for x in EVERY if x.free], ids=lambda x: x.name)
def test_of_every_effect_the_interval_decides(hypothesis: Hypothesis) -> None:
    assert hypothesis.nominal is not None
    (usual,), (strong, *_) = hypothesis.nominal, hypothesis.levels[0]
    blank = cast(Any, None)
    for share, named in ((2.1, True), (1.9, False)):
        error = abs(strong - usual) / share
        model = Fitted(((hypothesis, (strong,)),), {}, blank, blank, 0.0)
        tested = records.Tested(model, blank, np.array([error]), {})
        assert (doubtful(tested, THRESHOLDS.half_interval) == []) == named


def test_a_number_for_types_that_disagree_is_never_in_doubt() -> None:
    # 1.95 is between cars and trucks, and so slower than the cars and livelier than the trucks.
    hypotheses = global_hypotheses(load_scenario("mixed-v1"), {"acceleration", "headway"})
    blank = cast(Any, None)
    members = tuple((one, cast("tuple[float, ...]", one.nominal)) for one in hypotheses)
    model = Fitted(members, {}, blank, blank, 0.0)
    tested = records.Tested(model, blank, np.array([0.1, 0.1]), {})
    (index,) = doubtful(tested, THRESHOLDS.half_interval)
    assert members[index][0].name == "headway"


def test_every_effect_with_a_number_has_a_usual_value() -> None:
    # Without one, nothing could show that its interval holds it.
    without = {x.name for x in EVERY if x.nominal is None}
    assert all(not known_effects()[name].ranges for name in without), without


def test_when_the_budget_ends_no_doubtful_effect_is_named_either() -> None:
    both = ("headway", "demand_level")
    costs = {both: 900.0, ("headway",): 1000.0, ("demand_level",): 950.0}
    ledger = Ledger(costs, {(): 0.0, **dict.fromkeys(costs, 0.0)})
    best = ledger.with_chance(ledger.simulate((HEADWAY, DEMAND), 16), 0.04)
    assert doubtful(best, THRESHOLDS.half_interval) == [1], "0.95 +- 0.08 may be the usual 1"
    base = ledger.with_chance(replace(best.model, members=(), cost=2000.0), 0.0)
    selector = selector_with(ledger)
    alone = [ledger.simulate((member,), 16) for member in (HEADWAY, DEMAND)]
    selector._seen = {str(number): model for number, model in enumerate([best.model, *alone])}
    assert selector._without_doubtful(best, base).model.members == (HEADWAY,)
    nearer = replace(base, model=replace(base.model, cost=990.0))
    assert selector._without_doubtful(best, nearer) is nearer
    selector._seen = {"both": best.model}
    assert selector._without_doubtful(best, base) is base


def test_when_the_budget_ends_at_once_what_another_search_found_is_not_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ledger = Ledger({("headway",): 900.0}, {("headway",): 0.0})
    selector = selector_with(ledger)
    selector.examined = set()
    monkeypatch.setattr(Selector, "_library_directions", spent)
    base = ledger.with_chance(ledger.simulate((HEADWAY,), 16))
    base = replace(base, model=replace(base.model, members=(), cost=2000.0))
    located = records.Located(base, (), True, frozenset())
    selected = selector.select(located, (HEADWAY,))
    assert selected.best.model.members == (HEADWAY,)
    assert not selected.complete


@pytest.mark.parametrize(("factor", "kept"), [(0.99, (HEADWAY,)), (0.95, (HEADWAY, DEMAND))])
def test_when_the_budget_ends_nothing_too_small_to_matter_is_named(
    factor: float, kept: Members
) -> None:
    """A demand of 0.99 is below the least change of 0.02 that is worth a name."""
    weak = (DEMAND[0], (factor,))
    both = ("headway", "demand_level")
    costs = {both: 900.0, ("headway",): 1000.0, ("demand_level",): 950.0}
    ledger = Ledger(costs, {("demand_level",): 0.9})
    selector = selector_with(ledger)
    models = [ledger.simulate(members, 16) for members in ((HEADWAY, weak), (HEADWAY,), (weak,))]
    base = replace(models[0], members=(), cost=2000.0)
    selector._seen = {str(number): model for number, model in enumerate(models)}
    assert names(selector._that_matter(models[0], base).members) == names(kept)
    selector._seen = {"both": models[0]}
    assert selector._that_matter(models[0], base) is models[0]
    if factor == 0.99:
        assert selector._that_matter(models[2], base) is base
        selector._seen = {str(number): model for number, model in enumerate(models)}
        nearer = replace(base, cost=990.0)
        assert selector._that_matter(models[0], nearer) is nearer
        assert ledger.left(weak) == ()


@pytest.mark.parametrize(("errors", "tried"), [(0.05, True), (0.005, False)])
def test_sets_without_an_effect_beyond_doubt_are_not_tried(
    errors: float, tried: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    costs = {("headway",): 5e3, ("desired_speed",): 5e3, ("headway", "desired_speed"): 0.0}
    ledger = Ledger(costs, dict.fromkeys(costs, 0.5))
    asked: list[tuple[str, ...]] = []
    simulate = ledger.simulate

    def watched(members: Members, days: int | None = None) -> Fitted:
        asked.append(names(members))
        return simulate(members, days)

    monkeypatch.setattr(ledger, "simulate", watched)
    assert names(ledger.left(HEADWAY, SPEED, errors=errors)) == ("headway", "desired_speed")
    assert (("headway",) in asked) == tried


def test_a_further_effect_is_compared_on_equal_numbers_of_days() -> None:
    both = ("headway", "demand_level")
    ledger = Ledger({both: 700.0, ("headway",): 1000.0}, {both: 0.9, ("headway",): 0.01})
    start = ledger.with_chance(ledger.simulate((HEADWAY,), 16))
    selector = selector_with(ledger)
    selector.test = ledger.test
    # With few days both cost more than the headway alone does with many.
    assert ledger.simulate((HEADWAY, DEMAND)).cost > start.model.cost
    found = selector._fitted(start, [(DEMAND,)], 1, "candidates")
    assert found.model.members == (HEADWAY, DEMAND)
    ledger.costs[both] = 1000.0 - THRESHOLDS.price / 2
    selector.test = lambda model: pytest.fail("half a price is not a gain")
    assert selector._fitted(start, [(DEMAND,)], 1, "candidates") is None


@pytest.mark.parametrize(
    ("first", "found"), [(1900.0, ("desired_speed",)), (2100.0, ("demand_level",))]
)
def test_what_is_fitted_more_slowly_is_not_left_for_an_imitation(
    first: float, found: tuple[str, ...]
) -> None:
    """Few steps put the imitation first; only candidates of twice its cost are given up."""
    costs = {(): 9000.0, ("demand_level",): 1000.0 - FEW, ("desired_speed",): first - FEW}
    in_the_end = {("demand_level",): 980.0, ("desired_speed",): 100.0}
    ledger = Ledger(costs, dict.fromkeys(costs, 0.01), in_the_end=in_the_end)
    selector = selector_with(ledger)
    selector.test = ledger.test
    start = ledger.with_chance(ledger.simulate((), 16))
    best = selector._fitted(start, [(DEMAND,), (SPEED,)], 0, "candidates")
    assert names(best.model.members) == found


def test_an_exchange_is_fitted_although_it_costs_more_before_that() -> None:
    """Of five candidates the exchange comes last; fitted, it is the best."""
    parts = [(h, h.levels[0]) for h in EVERY if len(h.levels) and h.name != "headway"][:4]
    bigger = [("headway", hypothesis.name) for hypothesis, _ in parts]
    costs = {("headway",): 1000.0, **{key: 900.0 - n for n, key in enumerate(bigger)}}
    costs |= {("desired_speed",): 1200.0}
    ledger = Ledger(costs, dict.fromkeys(costs, 0.9), in_the_end={("desired_speed",): 500.0})
    ledger.fitted = lambda start, _: ledger.refine(start, 1, closely=True)  # type: ignore[method-assign]
    selector = selector_with(ledger)
    selector.test = ledger.with_chance
    start = ledger.with_chance(ledger.simulate((HEADWAY,), 16))
    none = (HEADWAY[0], HEADWAY[0].nominal)
    found = selector._fitted(start, [*((part,) for part in parts), (none, SPEED)], 1, "candidates")
    assert names(found.model.members) == ("desired_speed",)


def test_simulated_strengths_that_cost_less_are_candidates_themselves() -> None:
    costs = {("headway",): 1000.0, ("headway", "demand_level"): 900.0}
    ledger = Ledger({**costs, ("headway", "desired_speed"): 1100.0}, {})
    selector = selector_with(ledger)
    one, other = (SimpleNamespace(hypothesis=h, level=level) for h, level in (SPEED, DEMAND))
    selector._of_round = {1: [one, other]}
    model = ledger.simulate((HEADWAY,), 16)
    assert selector._nearer(model, 1) == [(DEMAND,)]
    assert selector._nearer(model, 2) == []


@pytest.mark.parametrize(
    ("before", "gain", "after", "taken"),
    [
        (1e-6, THRESHOLDS.price / 2, 0.5, True),
        (1e-6, -THRESHOLDS.price / 2, 0.5, True),
        (1e-6, THRESHOLDS.price / 2, 0.01, False),
        (0.04, THRESHOLDS.price / 2, 0.5, False),
        (1e-6, -2 * THRESHOLDS.price, 0.5, False),
    ],
)
def test_an_effect_that_leaves_only_chance_is_taken_for_less_than_its_price(
    before: float, gain: float, after: float, taken: bool
) -> None:
    """Though not if what was left before may have been chance, nor if it costs more itself."""
    costs = {("headway",): 1000.0, ("headway", "demand_level"): 1000.0 - gain}
    ledger = Ledger(costs, {("headway",): before, ("headway", "demand_level"): after})
    selector = selector_with(ledger)
    selector.test = ledger.test
    start = ledger.with_chance(ledger.simulate((HEADWAY,), 16))
    found = selector._fitted(start, [(DEMAND,)], 1, "candidates")
    assert (found is not None) == taken


def test_only_strengths_that_come_nearer_to_the_data_are_candidates_by_themselves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ledger: Any = Ledger({("headway",): 900.0, ("desired_speed",): 800.0}, {})
    gaps = {"headway": 0.9 * THRESHOLDS.nearer, "desired_speed": 1.1 * THRESHOLDS.nearer}
    ledger.base, ledger.data = None, []
    selector = selector_with(ledger)
    selector._library, selector._first = [HEADWAY[0], SPEED[0]], 1.0

    def simulate(members: Members, days: int) -> Fitted:
        model = Ledger.simulate(ledger, members, days)
        return replace(model, distance=cast(Any, gaps[names(members)[0]]))

    ledger.simulate = simulate
    monkeypatch.setattr(select, "squared_gap", lambda distance, base, periods: distance)
    assert selector._nearest() == [(HEADWAY,)]


def tried_in_round(
    monkeypatch: pytest.MonkeyPatch, number: int, gap: float, expected: float = 0.0
) -> list[list[str]]:
    """What a round tries, in words, call by call.

    The squared difference is `gap` times 100, the number of statistics. The proposals of the
    library would leave `expected`, and nothing that is tried helps.
    """
    ledger: Any = Ledger({}, {})
    ledger.data = [SimpleNamespace(sums=FEATURES)]
    selector = selector_with(ledger)
    selector._library, selector._library_directions = (), lambda model, number: ()
    measured = np.zeros(100)
    selector._whitener = lambda model, blocks: SimpleNamespace(measured=measured, gap=100.0 * gap)
    selector._nearest, selector._nearer = lambda: ["nearest"], lambda model, number: ["nearer"]
    selector._at_places = lambda model, directions, number: ["places"]
    tried: list[list[str]] = []
    selector._fitted = lambda start, chosen, number, what: tried.append(chosen)
    found = [SimpleNamespace(members="predicted", expected=expected)]
    monkeypatch.setattr(select, "propose", lambda *_: found)
    monkeypatch.setattr(select, "promising", lambda *_: found)
    swapped = SimpleNamespace(members="exchange")
    monkeypatch.setattr(select, "exchanges", lambda *_: [swapped] * 5)
    monkeypatch.setattr(select, "cautious_drivers", lambda library: ["cautious"])
    assert selector._round(SimpleNamespace(model=SimpleNamespace(members=())), number) is None
    return tried


@pytest.mark.parametrize(
    ("number", "gap", "calls"),
    [
        # a small distance lies in single places
        (0, 0.5 * THRESHOLDS.small_distance, [["predicted", "places", "nearest"]]),
        (0, 2.0 * THRESHOLDS.small_distance, [["predicted", "nearest"], ["places"]]),
        (0, 2.0 * THRESHOLDS.large_distance, [["predicted", "nearest", "cautious"], ["places"]]),
        (1, 2.0 * THRESHOLDS.large_distance, [["predicted", "nearer", "exchange"], ["places"]]),
    ],
)
def test_what_a_round_tries_follows_from_the_distance(
    number: int, gap: float, calls: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = tried_in_round(monkeypatch, number, gap)
    assert [list(dict.fromkeys(each)) for each in tried] == calls
    assert tried[0].count("exchange") == (5 if number else 0)  # all that were proposed


def test_what_the_library_does_not_explain_at_all_is_looked_for_at_places(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gap = 2.0 * THRESHOLDS.small_distance
    enough = 100.0 + THRESHOLDS.look_elsewhere * (100.0 * gap - 100.0)
    for expected, at_once in ((enough - 1.0, False), (enough + 1.0, True)):
        tried = tried_in_round(monkeypatch, 0, gap, expected)
        assert ("places" in tried[0]) == at_once


def test_a_share_of_each_difference_counts_as_noise_of_the_model() -> None:
    """No simulation is more exact than that, however many of its days are simulated."""
    ledger: Any = Ledger({("headway",): 1000.0}, {("headway",): 0.5})
    ledger.data, ledger.settled, ledger.changes = [], lambda model, errors: model, lambda model: []
    selector = selector_with(ledger)
    selector._first = SimpleNamespace(difference={"network": np.array([[3.0, -20.0]])})
    selector._days = lambda model: []
    asked: list[Any] = []
    selector._null = lambda *_: SimpleNamespace(
        test=lambda data, extra: asked.append(extra) or Chance(0.5)
    )
    model = replace(ledger.simulate((HEADWAY,), 16), members=())
    with pytest.MonkeyPatch.context() as patched:
        nothing = {"network": np.zeros((1, 2))}
        patched.setattr(select, "uncertainty", lambda *_: (np.empty(0), dict(nothing)))
        selector._tested(model)
    share = THRESHOLDS.tolerance
    assert asked[0]["network"] == pytest.approx(np.array([[3.0, -20.0]]) ** 2 * share**2)


@pytest.mark.parametrize(
    ("chance", "error", "named"),
    [(0.5, 0.1, (1.5,)), (0.01, 0.1, None), (0.5, 1.0, None)],
    ids=["it explains", "something remains", "its interval holds the usual value"],
)
def test_an_effect_that_is_clear_along_its_direction_is_named(
    chance: float, error: float, named: tuple[float, ...] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Linear prediction places it where it does nothing; the network shows it at 1.5."""
    headway, other = HEADWAY[0], DEMAND[0]
    both = ("desired_speed", "headway")
    ledger = Ledger(
        {("desired_speed",): 100.0, both: 90.0, ("desired_speed", "demand_level"): 200.0},
        {("desired_speed",): 0.001, both: chance},
    )
    selector = selector_with(ledger)
    selector.kept, selector.test = ledger.kept, ledger.test
    selector.exact = lambda tested: replace(tested, errors=np.full(2, error))
    strengths = [(headway, (1.2,)), (headway, (1.5,)), (other, (1.2,))]
    selector._directions = lambda *_: [
        SimpleNamespace(hypothesis=hypothesis, level=level) for hypothesis, level in strengths
    ]
    selector._whitener = lambda *_: None
    gaps = {((headway, (1.2,)),): 80.0, ((headway, (1.5,)),): 30.0, ((other, (1.2,)),): 300.0}
    selector._gap_of_network = lambda model: gaps[model.members[1:]]
    proposals = [
        SimpleNamespace(members=((SPEED[0], (1.1,)),)),  # it is there already
        SimpleNamespace(members=((headway, (1.1,)), (other, (1.1,)))),
        SimpleNamespace(members=((headway, (1.1,)),)),
        SimpleNamespace(members=((other, (1.1,)),)),
    ]
    monkeypatch.setattr(select, "propose", lambda *_: proposals)
    best = ledger.with_chance(ledger.simulate((SPEED,), 16))
    found = selector._explained_at_last(best)
    assert found.model.members == ((SPEED,) if named is None else (SPEED, (headway, named)))


def test_a_budget_that_ends_behind_the_search_leaves_its_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ledger = Ledger({("headway",): 900.0}, {("headway",): 0.001})
    selector = selector_with(ledger)
    selector.examined = set()
    found = ledger.with_chance(ledger.simulate((HEADWAY,), 16))
    selector._library_directions = selector._round = lambda *_: None
    selector._fitted = lambda *_: found
    selector._explained_at_last = spent
    monkeypatch.setattr(select, "Pruner", lambda *_: SimpleNamespace(pruned=lambda *_: found))
    base = replace(found, model=replace(found.model, members=(), cost=2000.0))
    located = records.Located(base, (), True, frozenset())
    selected = selector.select(located, (HEADWAY,))
    assert selected.best is found
    assert selected.complete


@pytest.mark.parametrize(
    ("chance", "delay_s", "named"),
    [(0.5, 0.3, True), (0.01, 0.3, False), (0.5, 0.01, False)],
    ids=["they explain", "something remains", "one is too small to matter"],
)
def test_beside_one_property_of_drivers_the_others_are_tried_together(
    chance: float, delay_s: float, named: bool
) -> None:
    """A clock or a closure may imitate them, and no single step leads there."""
    known = {item.name: item for item in global_hypotheses(load_scenario("single-v1"), CAUTION)}
    faster = (known["acceleration"], (0.7,))
    drivers = tuple(CAUTION)
    ledger = Ledger(
        {drivers: 10.0, ("acceleration", "headway"): 100.0}, {drivers: chance},
    )  # fmt: skip
    selector = selector_with(ledger)
    selector.kept, selector.test, selector.exact = ledger.kept, ledger.test, ledger.exact
    selector._library = tuple(known.values())
    selector._with_clear_effect = lambda _: None
    delay = known["startup_delay"], (delay_s,)
    ledger.refined[drivers] = (faster, (known["deceleration"], (3.2,)), delay)
    chances = {("acceleration", "headway"): 0.001}
    ledger.chances |= chances
    best = ledger.with_chance(ledger.simulate((faster, HEADWAY), 16))
    found = selector._explained_at_last(best).model.members
    assert names(found) == (drivers if named else ("acceleration", "headway"))
    if named:
        assert [values for _, values in found] == [(0.7,), (3.2,), (0.3,)]


def test_the_same_effects_with_a_further_one_are_no_other_explanation() -> None:
    costs = {("headway",): 100.0, ("headway", "demand_level"): 103.0, ("desired_speed",): 400.0}
    ledger = Ledger(costs, {("headway",): 0.5})
    selector = selector_with(ledger)
    selector.examined, selector._costs = set(), {}
    sets: list[Members] = [(HEADWAY,), (HEADWAY, DEMAND), (SPEED,)]
    selector._seen = {str(k): ledger.simulate(members, 16) for k, members in enumerate(sets)}
    best = ledger.with_chance(ledger.simulate((HEADWAY,), 16))
    base = replace(best, model=replace(best.model, members=()))
    located = records.Located(base, (), True, frozenset())
    assert selector._selected(best, located, complete=True).runner_up_is_worse_by == 300.0
