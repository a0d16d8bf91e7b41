"""What a diagnosis says: effects in words and in JSON, and the conclusion drawn from tests."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from ugat_marl.diagnosis import DiagnosisConfig, Hypothesis
from ugat_marl.diagnosis.features import FEATURES
from ugat_marl.diagnosis.places import one_behind_the_other
from ugat_marl.diagnosis.records import Conclusion, EffectRecord, Located, Parameter, Selected
from ugat_marl.diagnosis.verdict import (
    _rivals,
    combined,
    conclude,
    describe_effect,
    describe_members,
    effect_record,
    place_and_window,
    unchallenged,
    unverified,
)
from ugat_marl.diagnosis.workflow import _alternatives
from ugat_marl.scenarios import Detector

HEADWAY = Hypothesis("headway", (), ("seconds",), ((1.5,),), (1.0,), 0.05)
SURGE = Hypothesis(
    "demand_surge",
    (("edge", "S_C"), ("begin_s", 300.0), ("end_s", 900.0)),
    ("factor",),
    ((1.5,),),
    (1.0,),
)
TURNING = Hypothesis(
    "turning", (("from_edge", "a"), ("to_edge", "b")), ("share",), ((0.2,),), (0.0,)
)
PARKING = Hypothesis(
    "parking", (("lane", "S_C_0"), ("dwell_s", 40.0)), ("per_hour",), ((20.0,),), (0.0,)
)
MODEL = Hypothesis("driver_model", (("model", "IDM"),), (), ((),), None)
DETECTORS = [
    Detector("from", "E_C_0", 5.0, 2.0, "exit"),  # behind another light
    Detector("east", "E_C_0", 10.0, 2.0, "advance"),
    Detector("line", "E_C_0", 90.0, 2.0, "stop"),
    Detector("beside", "E_C_1", 90.0, 2.0, "stop"),
    Detector("out", "C_W_0", 10.0, 2.0, "exit"),
    Detector("away", "C_N_0", 10.0, 2.0, "exit"),
]
SITE: Any = SimpleNamespace(
    detectors=DETECTORS,
    by_id={detector.id: detector for detector in DETECTORS},
    lanes=[
        SimpleNamespace(id="E_C_0", edge="E_C", following={"C_W"}),
        SimpleNamespace(id="E_C_1", edge="E_C", following={"C_W", "C_N"}),
    ],
)
LATE = Hypothesis("late_green", (("place", "*"),), ("seconds",), ((2.0,),), (0.0,))


def selected(best: Any, complete: bool = True) -> Selected:
    return Selected(best, (), complete, examined=frozenset())


def located(base: Any) -> Located:
    return Located(base, (), complete=True, examined=frozenset())


def test_an_effect_everywhere() -> None:
    record = effect_record(HEADWAY, (1.45,), (0.02,))
    assert asdict(record) == {
        "name": "headway",
        "place": None,
        "window": None,
        "parameters": {
            "seconds": {
                "value": 1.45,
                "low": pytest.approx(1.43),
                "high": pytest.approx(1.47),
                "unit": "s",
            }
        },
    }


def test_an_effect_with_place_and_window() -> None:
    record = effect_record(SURGE, (1.8,), (0.1,))
    assert record.place == "S_C"
    assert record.window == (300.0, 900.0)
    assert set(record.parameters) == {"factor"}


def test_a_fixed_number_is_given_without_an_interval() -> None:
    parameters = effect_record(PARKING, (25.0,), (2.0,)).parameters
    assert parameters["dwell_s"] == Parameter(40.0, None, None, "s")
    assert parameters["per_hour"].value == 25.0


def test_two_places_are_joined() -> None:
    assert place_and_window(TURNING) == ("a>b", None)


def test_intervals_stay_in_range() -> None:
    parameters = effect_record(TURNING, (0.05,), (1.0,)).parameters
    assert parameters["share"].low == 0.0
    assert parameters["share"].high == 1.0


@pytest.mark.parametrize(
    ("hypothesis", "values"),
    [(HEADWAY, (1.4,)), (SURGE, (2.0,)), (TURNING, (0.2,)), (PARKING, (9.0,)), (MODEL, ()),
     (LATE, (1.5,))],
)  # fmt: skip
def test_records_can_be_written(hypothesis: Hypothesis, values: tuple[float, ...]) -> None:
    record = effect_record(hypothesis, values, (0.1,) * len(values))
    written = json.dumps(asdict(record), allow_nan=False)
    assert TypeAdapter(EffectRecord).validate_json(written) == record


def test_effects_in_words() -> None:
    assert describe_effect(HEADWAY, (1.45,)) == "headway of 1.45 s (scenario: 1)"
    assert describe_effect(SURGE, (1.8,)) == "demand surge at S_C from 0:05:00 to 0:15:00 × 1.8"
    assert describe_effect(TURNING, (0.125,)) == "turning at a → b of 12.5 %"
    assert describe_effect(LATE, (2.0,)) == "late green of 2 s"
    assert describe_effect(MODEL, ()) == "driver model IDM"
    swapped = Hypothesis("swapped", (("one", "a"), ("other", "b")), (), ((),), None)
    assert describe_effect(swapped, ()) == "swapped detectors at a → b"
    assert describe_members(((HEADWAY, (1.4,)), (LATE, (2.0,)))) == (
        "headway of 1.4 s (scenario: 1) and late green of 2 s"
    )
    three = ((HEADWAY, (1.4,)), (LATE, (2.0,)), (SURGE, (2.0,)))
    assert describe_members(three).count(" and ") == 1
    assert "(scenario: 1), late green of 2 s and demand surge" in describe_members(three)


def test_units_are_written_as_people_write_them() -> None:
    slow = Hypothesis("acceleration", (), ("mps2",), ((1.6,),), (2.6,))
    assert describe_effect(slow, (0.497,)) == "acceleration of 0.497 m/s² (scenario: 2.6)"
    mixed = replace(slow, neutral=False)
    assert describe_effect(mixed, (0.497,)) == "acceleration of 0.497 m/s²"


def test_what_to_measure_next_is_said_in_words() -> None:
    z = np.zeros((1, len(FEATURES)))
    z[0, [name for name, *_ in FEATURES].index("over2-3")] = 9.0
    model = SimpleNamespace(
        members=((HEADWAY, (1.4,)),), distance=SimpleNamespace(z={"network": z})
    )
    best: Any = SimpleNamespace(model=model, residual=SimpleNamespace(p=0.0, distance=90.0))
    won: Any = SimpleNamespace(
        before=SimpleNamespace(p=0.0), after=best.residual, shrink=0.9, gain=900.0
    )
    selector: Any = None
    found = conclude(
        located(best),
        selected(best),
        selector,
        won,
        DiagnosisConfig(alpha=0.05),
        SITE,
    )
    assert found.verdict == "partially_explained"
    assert found.next_measurement is not None
    assert "time over detector, 2nd and 3rd (discharge)" in found.next_measurement


@pytest.mark.parametrize(
    ("heldout_p", "complete", "verdict", "said"),
    [
        (0.5, True, "no_discrepancy", "Nothing in the data contradicts"),
        (0.5, False, "provisional", "Run the same command again"),
        (0.001, True, "unknown", "but not with the held-out ones (p = 0.001)"),
    ],
)
def test_nothing_is_found_where_held_out_periods_say_so_too(
    heldout_p: float, complete: bool, verdict: str, said: str
) -> None:
    agrees: Any = SimpleNamespace(residual=SimpleNamespace(p=0.6))
    verified: Any = SimpleNamespace(before=SimpleNamespace(p=heldout_p))
    here = Located(agrees, (), complete=complete, examined=frozenset())

    def told(heldout: list[str]) -> Conclusion:
        study: Any = SimpleNamespace(
            measured=SimpleNamespace(of=lambda _: heldout), config=DiagnosisConfig(),
            ruled_out=(), detection=(),
        )  # fmt: skip
        return unchallenged(study, here, verified, ())

    assert (found := told(["day4"])).verdict == verdict
    assert said in found.sentence
    assert told([]).verdict != "unknown", "none is held out"


@pytest.mark.parametrize("shrink", [0.3, -0.42])
def test_an_explanation_that_makes_it_worse_takes_nothing_off(shrink: float) -> None:
    best: Any = SimpleNamespace(model=SimpleNamespace(members=((HEADWAY, (1.4,)),)))
    verified: Any = SimpleNamespace(shrink=shrink)
    said = unverified(selected(best, False), verified).sentence
    assert ("takes off 30 % of the gap" in said) == (shrink > 0)
    assert ("brings the held-out periods no nearer" in said) == (shrink < 0)


@pytest.mark.parametrize("complete", [True, False])
@pytest.mark.parametrize("tried", [(), ((HEADWAY, (1.4,)),)])
def test_only_a_search_that_ended_says_that_the_library_lacks_it(
    complete: bool, tried: Any
) -> None:
    distance = SimpleNamespace(z={"network": np.eye(1, len(FEATURES))})
    residual = SimpleNamespace(p=0.0, distance=900.0)
    best: Any = SimpleNamespace(
        model=SimpleNamespace(members=tried, distance=distance), residual=residual
    )
    nothing_won: Any = SimpleNamespace(
        before=SimpleNamespace(p=0.0), after=residual, shrink=0.1, gain=100.0
    )
    selector: Any = None
    contradicted: Any = SimpleNamespace(residual=SimpleNamespace(p=0.0))
    found = conclude(
        located(contradicted),
        selected(best, complete),
        selector,
        nothing_won,
        DiagnosisConfig(alpha=0.05),
        SITE,
    )
    assert found.verdict == ("unknown" if complete else "provisional")
    assert ("no effect of the library explains it" in found.sentence) == complete
    assert ("the budget ended" in found.sentence) != complete
    assert (found.next_measurement is not None) == complete


@pytest.mark.parametrize(
    ("hypothesis", "value", "verdict"),
    [
        (HEADWAY, 10.0, "partially_explained"),
        (HEADWAY, 9.9, "explained"),
        (TURNING, 1.0, "explained"),  # all of them turn: an end of what there is, not of the search
    ],
)
def test_the_end_of_a_range_is_no_answer(
    hypothesis: Hypothesis, value: float, verdict: str
) -> None:
    distance = SimpleNamespace(z={"network": np.zeros((1, len(FEATURES)))})
    residual = SimpleNamespace(p=0.6, distance=100.0)
    best: Any = SimpleNamespace(
        model=SimpleNamespace(members=((hypothesis, (value,)),), distance=distance),
        residual=residual,
    )
    won: Any = SimpleNamespace(
        before=SimpleNamespace(p=0.0), after=residual, shrink=1.0, gain=900.0
    )
    selector: Any = None
    contradicted: Any = SimpleNamespace(residual=SimpleNamespace(p=0.0))
    found = conclude(
        located(contradicted),
        selected(best),
        selector,
        won,
        DiagnosisConfig(alpha=0.05),
        SITE,
    )
    assert found.verdict == verdict
    assert ("as far as the effect goes" in found.sentence) == (verdict != "explained")


def short(place: str) -> tuple[Hypothesis, tuple[float, ...]]:
    return Hypothesis("undercount", (("place", place),), ("share",), ((0.2,),), (0.0,)), (0.2,)


@pytest.mark.parametrize(
    ("places", "between"),
    [
        (("line", "out"), ("line", "out")),
        (("out", "line"), ("line", "out")),
        (("out", "east"), ("east", "out")),
        (("line", "east"), ("east", "line")),
        (("away", "out", "beside"), ("beside", "away")),
        (("east", "from"), ("from", "east")),
        (("line", "from"), ("from", "line")),
        (("line", "away"), ("line", "away")),  # vehicles of the other lane may leave from this one
        (("line", "beside"), None),
        (("out", "away"), None),
        (("line",), None),
    ],
)
def test_vehicles_that_leave_are_not_taken_for_counters_that_miss_them(
    places: tuple[str, ...], between: tuple[str, str] | None
) -> None:
    members = tuple(map(short, places))
    assert one_behind_the_other(members, SITE) == between
    distance = SimpleNamespace(z={"network": np.zeros((1, len(FEATURES)))})
    residual = SimpleNamespace(p=0.6, distance=100.0)
    model = SimpleNamespace(members=members, distance=distance)
    best: Any = SimpleNamespace(model=model, residual=residual)
    won: Any = SimpleNamespace(
        before=SimpleNamespace(p=0.0), after=residual, shrink=1.0, gain=900.0
    )
    selector: Any = None
    contradicted: Any = SimpleNamespace(residual=SimpleNamespace(p=0.0))
    found = conclude(
        located(contradicted),
        selected(best),
        selector,
        won,
        DiagnosisConfig(alpha=0.05),
        SITE,
    )
    assert found.verdict == ("not_identifiable" if between else "explained")
    assert all(name in (found.next_measurement or "") for name in between or ())


@pytest.mark.parametrize(
    ("fitted", "heldout", "verdict"),
    [
        (0.03, 0.5, "no_discrepancy"),  # 0.015 by chance: 0.08
        (0.03, 0.01, "unknown"),
        (1e-6, 0.5, "unknown"),
    ],
)
def test_a_hint_that_is_not_confirmed_is_weighed_with_the_other_periods(
    fitted: float, heldout: float, verdict: str
) -> None:
    distance = SimpleNamespace(z={"network": np.zeros((1, len(FEATURES)))})
    best: Any = SimpleNamespace(
        model=SimpleNamespace(members=(), distance=distance),
        residual=SimpleNamespace(p=fitted, distance=900.0),
    )
    before = SimpleNamespace(p=heldout)
    verification: Any = SimpleNamespace(before=before, after=before, shrink=None, gain=0.0)
    selector: Any = None
    found = conclude(
        located(best),
        selected(best),
        selector,
        verification,
        DiagnosisConfig(alpha=0.05),
        SITE,
    )
    assert found.verdict == verdict


@pytest.mark.slow
def test_two_tests_as_a_whole() -> None:
    assert combined(0.03, 0.5) == pytest.approx(0.015 * (1 - np.log(0.015)))
    assert combined(1.0, 1.0) == 1.0
    product = np.random.default_rng(1).random((2, 100_000)).prod(axis=0)
    assert np.mean([combined(p, 1.0) < 0.05 for p in product]) == pytest.approx(0.05, abs=0.003)


def worse_by(rival: Any, best: Any) -> float:
    return rival.cost - best.cost


@pytest.mark.parametrize(("settled", "named"), [(110.0, 1), (140.0, 0)])
def test_a_rival_is_as_near_after_as_many_days(settled: float, named: int) -> None:
    best: Any = SimpleNamespace(model=SimpleNamespace(members=((HEADWAY, (1.5,)),), cost=100.0))
    rival: Any = SimpleNamespace(members=((PARKING, (20.0,)),), cost=105.0)  # of few days
    again = SimpleNamespace(members=rival.members, cost=settled)
    tested = SimpleNamespace(model=again, residual=SimpleNamespace(p=0.5))
    selector: Any = SimpleNamespace(test=lambda _model: tested, worse_by=worse_by)
    selection = Selected(best, (rival,), True, examined=frozenset())
    assert len(_rivals(selection, selector, DiagnosisConfig())) == named


@pytest.mark.parametrize(("edge", "named"), [("E_C", 1), ("S_C", 0)])
def test_the_same_effect_elsewhere_is_a_rival(edge: str, named: int) -> None:
    def slow(edge: str, cost: float) -> Any:
        hypothesis = Hypothesis("local_speed", (("edge", edge),), ("factor",), ((0.8,),), (1.0,))
        return SimpleNamespace(members=((hypothesis, (0.8,)),), cost=cost)

    best: Any = SimpleNamespace(model=slow("S_C", 100.0))
    other = slow(edge, 100.1)
    selector: Any = SimpleNamespace(
        test=lambda model: SimpleNamespace(model=model, residual=SimpleNamespace(p=0.5)),
        worse_by=worse_by,
    )
    selection = Selected(best, (other,), True, examined=frozenset())
    assert len(_rivals(selection, selector, DiagnosisConfig())) == named


def test_a_set_of_effects_is_told_once_among_the_alternatives() -> None:
    """A model that fits as well was simulated again, with more days, and is another object."""

    def model(seconds: float) -> Any:
        distance = SimpleNamespace(total=1.0)
        return SimpleNamespace(members=((LATE, (seconds,)),), distance=distance, cost=seconds)

    best = SimpleNamespace(model=SimpleNamespace(members=((HEADWAY, (1.5,)),)))
    conclusion: Any = SimpleNamespace(best=best, indistinct=(model(2.0),))
    worse = SimpleNamespace(members=((MODEL, ()),), distance=SimpleNamespace(total=1.0), cost=90.0)
    rivals: Any = (model(2.5), best.model, worse)
    told = _alternatives(conclusion, Selected(best, rivals, True, examined=frozenset()))  # pyright: ignore[reportArgumentType]
    assert [(one.cost, one.indistinct) for one in told] == [(2.0, True), (90.0, False)]
