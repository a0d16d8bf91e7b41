"""Grades of the first stage by hand, and the stage itself on a street whose loops stay on."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.blind.cases import Case, Hidden, Label, write_label
from studies.blind.detectors import FirstStage, first_stages, graded, markdown
from studies.blind.generate import Blueprint, generate
from ugat_marl.diagnosis import DetectorError
from ugat_marl.effects import DetectorExtension, DetectorZone, Effect, Headway

LONGER, ON = DetectorZone("advance", 2.0), DetectorExtension("advance", 0.2, "unknown")
CASE = Case("case001", "single-v1")


def label(*effects: Effect) -> Label:
    return Label(
        case=CASE.case, scenario=CASE.scenario, group="pair", hidden="planted",
        strength="medium", effects=tuple(map(Hidden.of, effects)), leave_out=(), lights=("A1",),
        begin_s=0.0, end_s=3600.0, periods=5, speeds=True, policy="fixed-time:30", seed=1,
        measured="0" * 64,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("hidden", "errors", "outcome"),
    [
        ((Headway(1.4),), (), "right"),
        ((Headway(1.4),), (DetectorError(LONGER),), "invented"),
        ((Headway(1.4), LONGER), (DetectorError(LONGER),), "right"),
        ((LONGER,), (), "missed"),
        ((LONGER,), (DetectorError(ON),), "wrong"),
        ((LONGER,), (DetectorError(ON, rival=DetectorZone("advance", 2.1)),), "one of two"),
        ((LONGER,), (DetectorError(ON, rival=DetectorZone("stop", 2.1)),), "wrong"),
        ((LONGER,), (DetectorError(LONGER), DetectorError(DetectorZone("stop", 1.0))), "wrong"),
    ],
)
def test_outcomes(
    tmp_path: Path, hidden: tuple[Effect, ...], errors: tuple[DetectorError, ...], outcome: str
) -> None:
    write_label(tmp_path, label(*hidden))
    assert graded(tmp_path, CASE, errors).outcome == outcome


@pytest.mark.parametrize(("value", "inside"), [(2.2, True), (2.4, False)])
def test_intervals(tmp_path: Path, value: float, inside: bool) -> None:
    write_label(tmp_path, label(LONGER))
    error = DetectorError(DetectorZone("advance", value), margin=0.3)
    assert graded(tmp_path, CASE, [error]).inside == (inside,)


def test_the_bad_ones_are_listed_first() -> None:
    some = [
        FirstStage("c1", "n", "a", True, (), "missed"),
        FirstStage("c2", "n", "b", False, ("x",), "invented"),
        FirstStage("c3", "n", "c", True, ("x",), "right", (True,)),
        FirstStage("c4", "n", "d", True, ("x",), "right", (False,)),
    ]
    text = markdown(some)
    assert "| detectors as stated, yet an error named | 1 of 1 |" in text
    assert "| error named, at the right place | 2 of 3 |" in text
    assert "| 95 % intervals that hold the value | 1 of 2 |" in text
    cases = [line[2:4] for line in text.splitlines() if line.startswith("| c") and "|" in line]
    assert [case for case in cases if case != "ca"] == ["c2", "c1", "c4"]


@pytest.mark.slow
def test_a_planted_error_is_read_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    blueprint = Blueprint(("single-v1",), ("detector_extension",), ("large",), 1, seed=2, periods=3)
    generate(tmp_path / "blind", blueprint)
    (grade,) = first_stages(tmp_path / "blind")
    assert grade.erring
    assert grade.outcome == "right"
