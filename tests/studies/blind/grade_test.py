"""The rules of grading on diagnoses made by hand: right ones, wrong ones, and sly ones."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from studies.blind.cases import Case, Hidden, Label, write_label, write_plan
from studies.blind.grade import Grade, grade, grade_cases, read_grades
from studies.blind.strengths import ALL_KINDS, ERRORS, KINDS, nominal_of
from studies.blind.table import AIMS, confusion, markdown, rows_of, wilson, write_table
from studies.errors import BlindTestError
from tests.studies.blind.diagnoses import says
from ugat_marl.diagnosis import Diagnosis
from ugat_marl.effects import (
    PAPER_WORLDS,
    effect_from_record,
    known_effects,
    load_scenario,
    measurement_effects,
)


def hidden(**record: Any) -> Hidden:
    return Hidden.of(
        effect_from_record(record), {"seconds": 1.0} if record["name"] == "headway" else None
    )


def label(*effects: Hidden, group: str = "single", lights: tuple[str, ...] = ("C",)) -> Label:
    return Label(
        case="case001", scenario="single-v1", group=group,
        hidden="+".join(item.name for item in effects) or "none",
        strength="medium", effects=effects, leave_out=(), lights=lights, begin_s=0.0,
        end_s=3600.0, periods=5, speeds=True, policy="fixed-time:30", seed=1, measured="0" * 64,
    )  # fmt: skip


def alternative(*effects: Mapping[str, Any], as_good: bool = True) -> dict[str, Any]:
    return {"effects": list(effects), "distance": 1.0, "cost": 1.0, "indistinct": as_good}


def undecided(*alternatives: Mapping[str, Any]) -> Diagnosis | None:
    """Return a diagnosis that cannot tell these alternatives apart, if they fit as well."""
    return says("not_identifiable", alternatives=alternatives)


def gap(before: float, after: float) -> dict[str, Any]:
    mean = {"mean": 0.0, "low": 0.0, "high": 0.0}
    models = {"sim": mean, "corrected": mean, "real": mean}
    return {**models, "before": before, "after": after, "shrink": None}


def effect(
    name: str, place: str | None = None, window: Any = None, **values: Any
) -> dict[str, Any]:
    parameters = {
        key: {"value": value[1], "low": value[0], "high": value[2], "unit": "s"}
        for key, value in values.items()
    }
    return {"name": name, "place": place, "window": window, "parameters": parameters}


HEADWAY = label(hidden(name="headway", seconds=1.45))
CLOSURE = label(hidden(name="lane_closure", lane="e_1", begin_s=900, end_s=1800))
LATE = label(hidden(name="late_green", place="*", seconds=2.0))
PAIR = label(
    hidden(name="headway", seconds=1.45),
    hidden(name="turning", from_edge="a", to_edge="b", share=0.2),
    group="pair",
)
NONE = label(group="none")
OFFSET = label(hidden(name="detector_offset", place="advance", metres=-6.0), group="measurement")
SHIFTED = effect("detector_offset", "advance", metres=(-7.0, -6.1, -5.2))
OUTSIDE = replace(label(group="outside"), hidden="bus_stops")


def setting(name: str) -> Label:
    return replace(label(*map(Hidden.of, PAPER_WORLDS[name]), group="setting"), hidden=name)


THREE = (effect("acceleration"), effect("deceleration"), effect("startup_delay"))


@pytest.mark.parametrize(
    ("truth", "diagnosis", "outcome", "confident_wrong"),
    [
        (HEADWAY, says("explained", effect("headway")), "right", False),
        (HEADWAY, says("partially_explained", effect("headway")), "right", False),
        (HEADWAY, says("explained", effect("acceleration")), "wrong", True),
        (HEADWAY, says("partially_explained", effect("acceleration")), "wrong", False),
        (HEADWAY, says("explained", effect("headway"), effect("min_gap")), "wrong", True),
        (HEADWAY, says("explained"), "wrong", True),
        (HEADWAY, says("no_discrepancy"), "missed", False),
        (HEADWAY, says("unknown", effect("headway")), "abstained", False),
        (HEADWAY, says("not_identifiable", effect("headway")), "abstained", False),
        (HEADWAY, says("failed"), "failed", False),
        (NONE, says("no_discrepancy"), "right", False),
        (NONE, says("unknown"), "abstained", False),
        (NONE, says("explained", effect("headway")), "wrong", True),
        (NONE, says("partially_explained", effect("headway")), "wrong", False),
        (NONE, says("not_identifiable", effect("headway")), "wrong", False),
        (NONE, undecided(alternative(effect("headway"))), "wrong", False),
        (OFFSET, says("explained", SHIFTED), "right", False),
        (OFFSET, says("explained", effect("detector_offset", "stop")), "right", True),
        (OFFSET, says("no_discrepancy"), "missed", False),
        (OFFSET, says("explained", SHIFTED, effect("deceleration")), "wrong", True),
        (OUTSIDE, says("explained", effect("headway")), "wrong", True),
        (OUTSIDE, says("partially_explained", effect("headway")), "abstained", False),
        (OUTSIDE, says("unknown"), "abstained", False),
        (OUTSIDE, says("no_discrepancy"), "missed", False),
        (PAIR, says("explained", effect("headway"), effect("turning", "a>b")), "right", False),
        (PAIR, says("explained", effect("headway")), "wrong", True),
        # The right name at the wrong place is confident and wrong, too.
        (PAIR, says("explained", effect("headway"), effect("turning", "a>c")), "right", True),
        (CLOSURE, says("explained", effect("lane_closure", "e_0", (900, 1800))), "right", True),
        (setting("V4"), says("explained", *THREE), "right", False),
        (setting("V4"), says("explained", *THREE, effect("emergency_deceleration")), "right",
         False),
        (setting("V4"), says("explained", *THREE[:2]), "wrong", True),
        (setting("V3"), says("explained", *THREE[:2]), "right", False),
        (setting("V3"), says("explained", *THREE), "right", False),
        (setting("V3"), says("explained", *THREE, effect("headway")), "wrong", True),
    ],
)  # fmt: skip
def test_outcomes(
    truth: Label, diagnosis: Diagnosis | None, outcome: str, confident_wrong: bool
) -> None:
    found = grade(truth, diagnosis)
    assert found.outcome == outcome
    assert found.confident_wrong == confident_wrong


@pytest.mark.parametrize(
    ("diagnosis", "blamed"),
    [
        (says("explained", SHIFTED), ()),
        (says("unknown", SHIFTED), ()),
        (says("explained", effect("undercount", "advance:a")), ()),
        (says("partially_explained", SHIFTED, effect("deceleration")), ("deceleration",)),
        (says("provisional", effect("headway")), ("headway",)),
        (
            undecided(
                alternative(effect("min_gap")), alternative(effect("headway"), as_good=False)
            ),
            ("min_gap",),
        ),
    ],
)
def test_drivers_that_are_blamed_for_detectors(
    diagnosis: Diagnosis, blamed: tuple[str, ...]
) -> None:
    assert grade(OFFSET, diagnosis).blamed == blamed
    assert grade(HEADWAY, diagnosis).blamed == ()
    (row,) = (x for x in rows_of([grade(OFFSET, diagnosis)]) if "drivers' behaviour" in x.measure)
    assert row.count == bool(blamed)


def test_places_and_windows() -> None:
    found = grade(CLOSURE, says("explained", effect("lane_closure", "e_1", (1200, 2100))))
    assert found.place_right
    assert found.window_iou == pytest.approx(600 / 1200)
    found = grade(CLOSURE, says("explained", effect("lane_closure", "e_0", (900, 1800))))
    assert found.place_right is False
    assert found.window_iou == pytest.approx(1.0), "the time is right though the lane is not"
    found = grade(CLOSURE, says("explained", effect("lane_closure", "e_1", (2000, 2100))))
    assert found.window_iou == 0
    twice = [effect("lane_closure", lane, (900, 1800)) for lane in ("e_0", "e_1")]
    assert grade(CLOSURE, says("explained", *twice)).place_right is False, "one place too many"
    assert grade(HEADWAY, says("explained", effect("headway"))).place_right is None
    # Where the name is wrong a place says nothing.
    assert grade(CLOSURE, says("explained", effect("parking", "e_1"))).place_right is None


def test_a_form_that_is_said_to_be_unknown_is_not_wrong() -> None:
    longer = hidden(name="detector_extension", place="exit", seconds=0.6, overlap="merged")
    case = label(longer, group="measurement")

    def right(place: str) -> bool | None:
        named = effect("detector_extension", place, seconds=(0.58, 0.6, 0.62))
        found = grade(case, says("explained", named))
        assert len(found.estimates) == (found.place_right is True)
        return found.place_right

    assert right("exit>merged") and right("exit>unknown")
    assert right("exit>split") is right("stop>unknown") is right("exit@a>unknown") is False


def test_parameters_are_judged_by_value_by_effect_and_by_interval() -> None:
    found = grade(HEADWAY, says("explained", effect("headway", seconds=(1.4, 1.5, 1.6))))
    (estimate,) = found.estimates
    assert estimate.relative == pytest.approx(0.05 / 1.45)
    assert estimate.of_effect == pytest.approx(0.05 / 0.45)
    assert estimate.inside
    narrow = grade(HEADWAY, says("explained", effect("headway", seconds=(1.49, 1.5, 1.51))))
    assert narrow.estimates[0].inside is False
    wrong = grade(HEADWAY, says("explained", effect("acceleration", mps2=(1, 2, 3))))
    assert wrong.estimates == ()
    open_end = effect("headway")
    open_end["parameters"] = {"seconds": {"value": 1.45, "low": None, "high": 1.5, "unit": "s"}}
    assert grade(HEADWAY, says("explained", open_end)).estimates[0].inside is None


@pytest.mark.parametrize("place", [None, "*", "C"])
def test_the_only_traffic_light_is_everywhere(place: str | None) -> None:
    found = grade(LATE, says("explained", effect("late_green", place, seconds=(1.5, 2, 2.5))))
    assert found.place_right
    assert found.estimates[0].value == 2


def test_all_traffic_lights_are_everywhere_but_one_of_two_is_not() -> None:
    truth = replace(LATE, lights=("A", "B"))
    each = [effect("late_green", tls, seconds=(1, x, 3)) for tls, x in (("A", 1.8), ("B", 2.2))]
    assert grade(truth, says("explained", *each)).place_right
    one = grade(truth, says("explained", each[0]))
    assert one.outcome == "right"
    assert one.place_right is False


def test_a_surge_that_never_ends_is_a_level() -> None:
    truth = label(hidden(name="demand_level", edge="a", factor=1.3))
    always = effect("demand_surge", "a", (0, 3600), factor=(1.2, 1.3, 1.4))
    found = grade(truth, says("explained", always))
    assert (found.outcome, found.place_right) == ("right", True)
    assert found.estimates[0].inside
    half = effect("demand_surge", "a", (0, 1800), factor=(1.2, 1.3, 1.4))
    assert grade(truth, says("explained", half)).outcome == "wrong"


def test_swapped_detectors_are_swapped_either_way() -> None:
    truth = label(hidden(name="swapped", detector="x", other="y"))
    assert grade(truth, says("explained", effect("swapped", "y>x"))).place_right


def test_abstaining_between_right_and_wrong_is_noted() -> None:
    other = alternative(effect("headway"))
    found = grade(HEADWAY, says("not_identifiable", effect("min_gap"), alternatives=[other]))
    assert found.among
    assert not grade(HEADWAY, says("not_identifiable", effect("min_gap"))).among


@pytest.mark.parametrize(
    ("rival", "judged"),
    [
        ("detector_offset=advance,-6", ("abstained", True, False)),
        ("detector_extension=advance,0.2,unknown", ("wrong", False, True)),
        (None, ("wrong", False, True)),
    ],
)
def test_an_error_of_detectors_that_looks_the_same_is_listed(
    rival: str | None, judged: tuple[str, bool, bool]
) -> None:
    grounds = {"source": "detections of single vehicles", "rival": rival}
    zone = effect("detector_zone", "advance", metres=(1.0, 2.0, 3.0)) | {"evidence": grounds}
    graded = grade(OFFSET, says("explained", zone))
    assert (graded.outcome, graded.among, graded.confident_wrong) == judged
    assert not graded.blamed


def test_half_of_a_pair_is_half() -> None:
    assert grade(PAIR, says("explained", effect("headway"))).found == 0.5
    assert grade(PAIR, says("unknown", effect("headway"))).found == 0


def test_policy_gap_and_held_out_shrink() -> None:
    gaps = {"fixed-time:30": gap(10.0, 10.0), "a.pt": gap(-20.0, 5.0)}
    distances = dict.fromkeys(("before", "after", "floor", "expected", "p_before", "p_after"), 1.0)
    found = grade(
        setting("V4"),
        says("explained", *THREE, heldout={**distances, "shrink": 0.9}, policy_gap=gaps),
        wall_s=12.0,
    )
    assert (found.shrink, found.policy_shrink, found.wall_s) == (0.9, 0.75, 12.0)
    assert grade(HEADWAY, says("unknown", heldout=None, policy_gap=None)).shrink is None


def test_labels_of_undiagnosed_cases_stay_closed(tmp_path: Path) -> None:
    cases = tuple(Case(f"case00{i}", "single-v1") for i in (1, 2, 3))
    write_plan(tmp_path, cases)
    write_label(tmp_path, HEADWAY)
    (tmp_path / "labels" / "case002.json").write_text("not even JSON")
    write_label(tmp_path, replace(HEADWAY, case="case003"))
    for case, content in (("case001", says("explained", effect("headway"))),):
        assert content is not None
        (tmp_path / case).mkdir()
        content.write(tmp_path / case)
    (tmp_path / "case001" / "run.json").write_text('{"wall_s": 3.5, "error": null}')
    (tmp_path / "case003").mkdir()
    (tmp_path / "case003" / "run.json").write_text('{"wall_s": 1, "error": "ValueError: x"}')
    grades = grade_cases(tmp_path)
    assert [(x.case, x.outcome) for x in grades] == [("case001", "right"), ("case003", "failed")]
    assert read_grades(tmp_path) == grades
    (tmp_path / "case001" / "diagnosis.json").write_text('{"verdict": "sure"}')
    with pytest.raises(BlindTestError, match="case001.*not a diagnosis"):
        grade_cases(tmp_path)


def test_the_interval_of_a_share() -> None:
    # Newcombe (1998), table I: 81 of 263, and 0 of 20 and 1 of 29.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)


def some_grades() -> list[Grade]:
    right = grade(HEADWAY, says("explained", effect("headway", seconds=(1.4, 1.5, 1.6))), 20.0)
    wrong = grade(HEADWAY, says("explained", effect("acceleration")))
    quiet = grade(NONE, says("no_discrepancy"))
    single_day = replace(right, periods=1)
    small = replace(wrong, strength="small")
    return [right] * 9 + [wrong, quiet, quiet, single_day, small]


def test_the_table_counts() -> None:
    rows = {row.measure: row for row in rows_of(some_grades())}
    first = rows["single effect, medium or large, named (5 periods, speeds)"]
    assert (first.count, first.n, first.met) == (9, 10, True)
    assert rows["the same from one period"].n == 1
    assert rows["single effect, small, named"].count == 0
    assert rows["nothing hidden, yet something named"].count == 0
    sure = rows["confident and wrong"]
    assert (sure.count, sure.n, sure.met) == (2, 14, False)
    assert rows["both of a pair named"].met is None
    error = rows["parameter error, relative to the value (median)"]
    assert (error.n, error.met) == (10, True)
    assert rows["wall time, one intersection (median)"].value == 20
    assert confusion(some_grades())["headway"] == {"headway": 10, "acceleration": 2}


def test_every_aim_belongs_to_a_row() -> None:
    assert set(AIMS) <= {row.measure for row in rows_of([])}


def test_the_table_is_written(tmp_path: Path) -> None:
    write_table(some_grades(), tmp_path / "table.md", 40)
    text = (tmp_path / "table.md").read_text()
    assert text.startswith(f"{len(some_grades())} of 40 cases that were drawn are graded.\n")
    assert text.endswith(markdown(some_grades()))
    assert "| 10 | 9 of 10: 90.0 % | 59.6 % to 98.2 % | at least 90 % | yes | 98 % |" in text
    assert "| headway | 12 | 10 | headway (10), acceleration (2) |" in text
    write_table(some_grades(), tmp_path / "table.json", 40)
    content = json.loads((tmp_path / "table.json").read_text())
    assert content["confusion"]["none"] == {"nothing": 2}


def test_every_effect_of_the_library_can_be_hidden() -> None:
    assert set(KINDS) == set(known_effects()) - {"emergency_deceleration"}
    assert set(ERRORS) == set(measurement_effects())
    scenario = load_scenario("single-v1")
    for name, kind in ALL_KINDS.items():
        ranges = {**known_effects(), **measurement_effects()}[name].ranges
        if kind.parameter:
            for strength in kind.strengths:
                for side in (False, True):
                    value = kind.value(strength, side)
                    assert ranges[kind.parameter].low <= value <= ranges[kind.parameter].high
                    assert value != nominal_of(name, scenario)[kind.parameter]
