"""The check before a scenario is corrected, and verdicts in terms of traffic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ugat_marl.diagnosis import TrafficCheck, workflow
from ugat_marl.diagnosis.engine import OutOfTime
from ugat_marl.diagnosis.features import ALL_FEATURES, BIN_FEATURES, FEATURES, INDEX, Tally
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.traffic import _levelled, approach_table, traffic_check
from ugat_marl.diagnosis.verify import judged
from ugat_marl.diagnosis.workflow import _reason_against as reason_against
from ugat_marl.diagnosis.workflow import _without_search as without_search
from ugat_marl.effects import (
    DemandSurge,
    DetectorExtension,
    DetectorSplash,
    Effect,
    Headway,
    LaneService,
    Undercount,
    parse_domain,
)

THRESHOLDS = Thresholds()
LAYOUT: Any = SimpleNamespace(
    intersections=("A",),
    lanes=(SimpleNamespace(edge="in", intersection=0), SimpleNamespace(edge="in", intersection=0)),
    approaches=((0, 1),),
    ride_s=lambda lane: 3.0,
)


def days(
    seed: int, count: int, travel_s: float, queue: float, gap_s: float = 2.0, served: float = 20.0
) -> list[Tally]:
    """Days of two lanes with 50 vehicles and 20 greens each."""
    generator = np.random.default_rng(seed)
    made: list[Tally] = []
    for _ in range(count):
        sums = np.zeros((len(FEATURES), 2, 2))
        sums[INDEX["gap6-8"]] = (40 * gap_s, 40)
        bins = np.zeros((len(BIN_FEATURES), 2, 4))
        bins[BIN_FEATURES.index("count_stop")] = generator.poisson(served, (2, 4))
        times = 50 * generator.normal(travel_s, 0.5, 2)
        held = 20 * generator.normal(queue, 0.2, 2)
        vehicles, greens = np.full(2, 50.0), np.full(2, 20.0)
        journeys = np.array([[times, vehicles], [held, greens]]).transpose(0, 2, 1)
        made.append(Tally(sums, bins, journeys=journeys))
    return made


def without_journeys(tallies: Sequence[Tally]) -> list[Tally]:
    return [Tally(day.sums, day.bins) for day in tallies]


def test_a_correction_that_brings_travel_times_nearer_passes() -> None:
    check = traffic_check(days(1, 2, 25, 5), days(2, 16, 20, 4), days(3, 16, 25, 5), THRESHOLDS)
    assert check is not None and check.better
    assert check.measure == "travel time and queue"
    # |25 - 20| / 25 + |5 - 4| / 5
    assert check.error_before == pytest.approx(0.4, abs=0.06)
    assert check.error_after < 0.08
    assert 0.0 < check.noise < 0.1
    assert check.days == 16, "of each model; fewer have another error"


def test_greens_without_vehicles_are_no_journeys() -> None:
    """An advance detector was dead on the held-out days, and its lanes had greens all the same."""

    def dead(tallies: list[Tally]) -> list[Tally]:
        return [replace(day, journeys=day.journeys * [[[0.0]], [[1.0]]]) for day in tallies]

    real, old, new = days(1, 2, 25, 5), days(2, 16, 20, 4), days(3, 16, 25, 5)
    check = traffic_check(dead(real), old, new, THRESHOLDS)
    assert check is not None and check.measure != "travel time and queue"


def test_a_correction_that_empties_a_lane_is_refused() -> None:
    """The other lane alone would come nearer."""
    real, old = days(1, 2, 25, 5), days(2, 16, 25, 5)
    old = [replace(day, journeys=day.journeys * [[[1.1, 1.0], [1.0, 1.0]]]) for day in old]
    new = [
        replace(day, journeys=day.journeys * [[[1.0], [0.0]], [[1.0], [0.0]]])
        for day in days(3, 16, 25, 5)
    ]
    check = traffic_check(real, old, new, THRESHOLDS)
    assert check is not None and not check.better
    assert check.error_after == pytest.approx(1.0, abs=0.1)  # half of the times, half of the queues


def test_a_correction_that_makes_waiting_worse_is_refused() -> None:
    check = traffic_check(days(1, 2, 20, 4), days(2, 16, 20, 4), days(3, 16, 22, 5), THRESHOLDS)
    assert check is not None and not check.better
    assert check.error_after > check.error_before


def test_a_correction_that_leaves_traffic_far_off_is_refused() -> None:
    # |80 - 25| / 25 + |16 - 5| / 5: better than 400 s and 80 vehicles, and still no picture of it.
    check = traffic_check(days(1, 2, 25, 5), days(2, 16, 400, 80), days(3, 16, 80, 16), THRESHOLDS)
    assert check is not None and not check.better
    assert 1.0 < check.error_after < check.error_before


def test_a_correction_without_use_passes_as_often_as_is_said() -> None:
    checks = [
        traffic_check(
            days(s, 2, 20, 4), days(s + 1000, 16, 20, 4), days(s + 2000, 16, 20, 4), THRESHOLDS
        )
        for s in range(60)
    ]
    passed = sum(check is not None and check.better for check in checks)
    assert passed <= 8, "one in twenty, and chance"


def test_without_travel_times_counts_decide() -> None:
    street, sim, repaired = days(1, 2, 20, 4, served=30), days(2, 16, 20, 4), days(2, 16, 20, 4)
    check = traffic_check(
        without_journeys(street), without_journeys(sim), without_journeys(repaired), THRESHOLDS
    )
    assert check is not None and check.measure == "service counts"
    assert not check.better
    right = days(3, 16, 20, 4, served=30)
    check = traffic_check(
        without_journeys(street), without_journeys(sim), without_journeys(right), THRESHOLDS
    )
    assert check is not None and check.better


@pytest.mark.parametrize(
    ("domain", "given", "measure"),
    [
        ("demand_level=*,1.5", True, "service counts"),
        ("demand_level=*,1.5+undercount=*,0.1", True, "service counts"),
        ("demand_level=*,1.5+headway=1.4", True, "travel time and queue"),
        ("demand_level=*,1.5", False, "travel time and queue"),
    ],
)
def test_counts_judge_demand_where_arrivals_are_given(
    domain: str, given: bool, measure: str
) -> None:
    """Effects of demand leave such days as they are, but for their counts."""
    study: Any = SimpleNamespace(
        config=SimpleNamespace(thresholds=THRESHOLDS),
        heldout=days(1, 2, 25, 5, served=30),
        other_days="simulator" if given else None,
    )

    def model(served: float, effects: Sequence[Effect] = ()) -> Any:
        known = dict(enumerate(days(2, 16, 25, 5, served=served)))
        return SimpleNamespace(model=SimpleNamespace(days=known, effects=effects))

    check = judged(study, model(20), model(30, parse_domain(domain)))
    assert check is not None and check.measure == measure
    assert check.better == (measure == "service counts")


@pytest.mark.parametrize(("kind", "measure"), [("advance", "counts upstream"), ("", None)])
def test_where_nobody_was_counted_behind_the_stop_line_counts_upstream_decide(
    kind: str, measure: str | None
) -> None:
    def counted(seed: int, count: int, vehicles: float) -> list[Tally]:
        made = days(seed, count, 20, 4, served=vehicles)
        for day in made:
            rows = day.bins.copy()
            day.bins[:] = 0.0
            if kind:
                day.bins[BIN_FEATURES.index(f"count_{kind}")] = rows[
                    BIN_FEATURES.index("count_stop")
                ]
        return without_journeys(made)

    street, sim, right = counted(1, 2, 30.0), counted(2, 16, 20.0), counted(3, 16, 30.0)
    check = traffic_check(street, sim, right, THRESHOLDS)
    assert (check and check.measure) == measure
    assert check is None or check.better


def test_mornings_and_evenings_are_no_chance() -> None:
    """A perfect correction passes, however much stretches of the day differ."""

    def of_both(seed: int, count: int, share: float) -> list[Tally]:
        morning = days(seed, count, 20 * share, 4 * share)
        evening = days(seed + 1, count, 60 * share, 12 * share)
        stretches = [(0.0, 3600.0)] * count + [(36000.0, 39600.0)] * count
        both = zip([*morning, *evening], stretches, strict=True)
        return [replace(day, window=window) for day, window in both]

    street, sim, right = of_both(1, 1, 1.0), of_both(2, 8, 0.85), of_both(2, 8, 1.0)
    check = traffic_check(street, sim, right, THRESHOLDS)
    assert check is not None and check.better
    one = traffic_check(days(1, 2, 20, 4), days(2, 16, 17, 3.4), days(2, 16, 20, 4), THRESHOLDS)
    assert one is not None and check.noise < 2 * one.noise


def test_each_stretch_of_the_day_takes_a_degree_of_freedom() -> None:
    sums = np.random.default_rng(1).normal(100.0, 10.0, (8, 1, 2, 2))
    stretches = [(3600.0 * (day % 4), 3600.0 * (day % 4 + 1)) for day in range(8)]
    level, wider = _levelled(sums, stretches)
    assert wider == pytest.approx(math.sqrt(7 / 4))
    for stretch in range(4):
        assert level[stretch::4].mean(axis=0) == pytest.approx(sums.mean(axis=0))
    same, wider = _levelled(sums, stretches[:1] * 8)
    assert wider == 1.0
    assert np.array_equal(same, sums)


@pytest.mark.parametrize("each", [1, 2, 6])
def test_chance_passes_seldom_however_few_days_each_hour_has(each: int) -> None:
    """Twelve hours, and a model that is no better than the one before."""

    def of_hours(seed: int, count: int) -> list[Tally]:
        made: list[Tally] = []
        for hour in range(12):
            level = 1 + 0.3 * np.sin(hour)
            own = days(seed + hour, count, 20 * level, 4 * level)
            window = (3600.0 * hour, 3600.0 * (hour + 1))
            made += [replace(day, window=window) for day in own]
        return made

    passed = 0
    for seed in range(0, 6000, 100):
        street, one, other = of_hours(seed, 1), of_hours(seed + 33, each), of_hours(seed + 66, each)
        check = traffic_check(street, one, other, THRESHOLDS)
        assert check is not None and check.noise > 0
        passed += check.better
    assert passed <= 8, "one in twenty, and chance"


def test_occupied_times_judge_where_no_speeds_are_known() -> None:
    def of_counts(occupied_s: float, count: int) -> list[Tally]:
        rows: list[Tally] = []
        for number in range(count):
            sums = np.zeros((len(ALL_FEATURES), 2, 2))
            sums[INDEX["over_stop"]] = (40 * (occupied_s + 0.01 * (number % 3)), 40)
            rows.append(Tally(sums, np.ones((len(BIN_FEATURES), 2, 4))))
        return rows

    street, sim, repaired = of_counts(1.5, 2), of_counts(1.0, 16), of_counts(1.5, 16)
    check = traffic_check(street, sim, repaired, THRESHOLDS)
    assert check is not None and check.better
    assert check.measure == "speed and occupancy"
    assert check.error_before == pytest.approx(1 / 3, abs=0.02)


def test_without_anything_to_judge_by_there_is_no_judgement() -> None:
    empty = [Tally(np.zeros((len(FEATURES), 0, 2)), np.zeros((len(BIN_FEATURES), 0, 4)))]
    assert traffic_check(empty, empty * 3, empty * 3, THRESHOLDS) is None


def test_an_approach_in_terms_of_traffic() -> None:
    street, sim = days(1, 2, 25, 5, gap_s=2.4), days(2, 16, 20, 4, gap_s=2.0)
    (row,) = approach_table(LAYOUT, street, sim, days(3, 16, 25, 5, gap_s=2.5), THRESHOLDS)
    assert (row.tls, row.approach) == ("A", "in")
    assert row.capacity.measured == pytest.approx(1500.0)
    assert (row.capacity.before, row.capacity.after) == pytest.approx((1800.0, 1440.0))
    assert row.queue.measured == pytest.approx(10.0, abs=0.6), "both lanes together"
    assert row.delay.measured == pytest.approx(22.0, abs=1.0), "3 s are the free ride"
    assert row.delay.before == pytest.approx(17.0, abs=0.5)
    assert approach_table(LAYOUT, without_journeys(street), sim, sim, THRESHOLDS) == ()


@pytest.mark.parametrize(
    ("verdict", "better", "refused"),
    [
        ("explained", True, ""),
        ("explained", False, "travel time and queue"),
        ("provisional", False, "travel time and queue"),
        ("partially_explained", True, "Something besides"),
    ],
)
def test_why_a_scenario_is_not_corrected(verdict: str, better: bool, refused: str) -> None:
    after = days(3, 16, 25, 5) if better else days(3, 16, 20, 4)
    check = traffic_check(days(1, 2, 25, 5), days(2, 16, 20, 4), after, THRESHOLDS)
    conclusion: Any = SimpleNamespace(verdict=verdict)
    reason = reason_against(conclusion, check)
    assert (reason is not None) == bool(refused)
    assert refused in (reason or "")


@pytest.mark.parametrize(
    ("before", "after", "noise", "said"),
    [
        (0.191, 0.160, 0.041, "more or longer periods can tell"),  # it falls, within the noise
        (0.160, 0.191, 0.041, "do not bring travel time and queue near"),
        (9.0, 3.0, 0.3, "do not bring travel time and queue near"),  # far off still
        (1.4, 1.2, 0.3, "do not bring travel time and queue near"),  # of other vehicles
    ],
)
def test_a_correction_that_is_refused_says_whether_more_data_would_tell(
    before: float, after: float, noise: float, said: str
) -> None:
    check = TrafficCheck("travel time and queue", before, after, noise, better=False, days=4)
    conclusion: Any = SimpleNamespace(verdict="explained")
    reason = reason_against(conclusion, check)
    assert reason is not None and said in reason
    assert f"relative errors (4 simulated days) is {100 * before:.1f} % before" in reason
    assert ("can tell" in reason) == check.undecided
    assert reason_against(conclusion, replace(check, better=True)) is None


def test_what_was_not_fitted_has_no_interval_and_a_window_is_a_window() -> None:
    surge = without_search(DemandSurge("in", 600.0, 1200.0, 1.5), "patterns")
    assert (surge.place, surge.window) == ("in", (600.0, 1200.0))
    assert [*surge.parameters] == ["factor"]
    assert surge.parameters["factor"].low is None and surge.parameters["factor"].high is None
    loops = without_search(DetectorExtension("advance", 1.0, "merged"), "detections", 0.1)
    assert (loops.window, loops.parameters["seconds"].low) == (None, pytest.approx(0.9))
    splash = without_search(DetectorSplash("stop", 0.8), "detections", 0.4).parameters["share"]
    assert (splash.low, splash.high) == (pytest.approx(0.4), 1.0), "no share is above 1"


SPLASH = DetectorSplash("stop", 0.2)
FAULT = Undercount("advance:a", 0.2)


@pytest.mark.parametrize(
    ("verdict", "errors", "effects", "corrected"),
    [
        ("explained", (SPLASH,), (Headway(1.4), FAULT), [Headway(1.4)]),
        ("explained", (SPLASH,), (), []),
        ("explained", (), (FAULT,), []),
        ("provisional", (SPLASH,), (Headway(1.4),), [Headway(1.4)]),
        ("provisional", (), (FAULT,), []),  # the nearest explanation: the traffic is right
        ("provisional", (SPLASH,), (), None),
        ("unknown", (SPLASH,), (), None),
        ("unknown", (), (Headway(1.4),), [Headway(1.4)]),
        ("no_discrepancy", (), (), None),
    ],
)
def test_a_scenario_that_was_not_examined_is_not_called_corrected(
    verdict: str,
    errors: tuple[Effect, ...],
    effects: tuple[Effect, ...],
    corrected: list[Effect] | None,
) -> None:
    diagnosis: Any = SimpleNamespace(verdict=verdict, not_corrected=None)
    assert workflow._corrections(diagnosis, errors, effects) == corrected


def test_an_unnamed_correction_that_is_not_tried_takes_no_other_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def too_late(*given: Any) -> None:
        raise OutOfTime("the budget of time is spent")

    named = (Headway(1.4),)
    best: Any = SimpleNamespace(model=SimpleNamespace(effects=named, members=named))
    conclusion = SimpleNamespace(verdict="partially_explained", best=best)
    for name, given in {
        "verify_model": None, "conclude": conclusion, "_record": Told(),
        "_with_patterns": Told(), "judged": "the check", "_reason_against": "a reason",
    }.items():  # fmt: skip
        monkeypatch.setattr(workflow, name, lambda *_, given=given, **__: given)
    monkeypatch.setattr(workflow, "_unnamed", too_late)
    for anyway in (False, True):
        study: Any = SimpleNamespace(
            config=SimpleNamespace(correct_anyway=anyway),
            measured=SimpleNamespace(of=lambda split: []),
            layout=LAYOUT,
            detection=(),
        )
        search: Any = SimpleNamespace(
            study=study,
            located=SimpleNamespace(base=None),
            selected=SimpleNamespace(best=best),
            selector=None,
        )
        told: Any
        told, effects = workflow._concluded(search, (), cast(Any, None))
        assert effects == (named if anyway else ())
        assert told.not_corrected == (None if anyway else "a reason")
        assert "budget ended before the unnamed" in told.sentence


@dataclass(frozen=True)
class Told:
    """What a record says so far."""

    patterns: tuple[str, ...] = ("a pattern",)
    sentence: str = "Nothing explains it."
    traffic_check: Any = None
    not_corrected: str | None = None
    unnamed: tuple[Any, ...] = field(default=())


@pytest.mark.parametrize(
    ("asked", "travel_s", "base_days", "corrected"),
    [
        (True, 25, 16, True),
        (True, 25, 12, True),  # fewer days of the scenario as it is than are compared usually
        (True, 20, 16, False),
        (False, 25, 16, False),
    ],
)
def test_an_unnamed_correction_is_asked_for_and_has_to_help(
    asked: bool,
    travel_s: float,
    base_days: int,
    corrected: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried: list[tuple[Effect, ...]] = []
    after = days(3, 16, travel_s, travel_s / 5)

    def ordinary(effects: tuple[Effect, ...], numbers: list[int], advance: Any) -> dict[int, Any]:
        tried.append(effects)
        return {n: SimpleNamespace(tally=after[n]) for n in numbers}

    service = LaneService("in_0", 0.0, 2.0)
    monkeypatch.setattr(workflow, "unnamed_effects", lambda *given: (service,))
    monkeypatch.setattr(workflow.Routes, "of", lambda scenario: SimpleNamespace(origins={}))
    study: Any = SimpleNamespace(
        config=SimpleNamespace(unnamed=asked, thresholds=THRESHOLDS),
        scenario=SimpleNamespace(control=SimpleNamespace(decision_interval_s=10.0)),
        engine=SimpleNamespace(first=lambda count: list(range(count)), ordinary=ordinary),
        heldout=days(1, 2, 25, 5),
        layout=LAYOUT,
    )
    base: Any = SimpleNamespace(
        model=SimpleNamespace(days=dict(enumerate(days(2, base_days, 20, 4))), effects=())
    )
    best: Any = SimpleNamespace(model=SimpleNamespace(effects=(Headway(1.4),)))
    reporter: Any = SimpleNamespace(task=lambda name, total: nullcontext(lambda: None))
    told: Any = Told()
    for verdict, named in (("unknown", ()), ("partially_explained", (Headway(1.4),))):
        conclusion: Any = SimpleNamespace(verdict=verdict, best=best)
        result = workflow._unnamed(study, told, base, conclusion, reporter)
        assert (result is not None) == corrected
        if result is not None:
            record, effects = result
            assert effects == (*named, service)
            assert record.sentence.endswith("says nothing of the cause.")
            assert [effect.name for effect in record.unnamed] == ["lane_service"]
            assert record.traffic_check is not None and record.traffic_check.better
    assert len(tried) == (2 if asked else 0)
