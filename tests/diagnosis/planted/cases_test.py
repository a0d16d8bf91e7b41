"""One hidden effect of every family is named, with its place, strength and window; and no other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from ugat_marl.effects import load_scenario


@dataclass(frozen=True)
class Case:
    """What is hidden.

    Attributes:
        domain: The effect.
        name: As it has to be named.
        place: Where, or None for the whole network.
        values: Its numbers, which have to be met to within `error`.
        error: Share of the value, or of 1 where a factor changes nothing at 1.
    """

    domain: str
    name: str
    place: str | None = None
    values: dict[str, float] | None = None
    error: float = 0.15


CASES = {
    "vehicles": Case("headway=1.4", "headway", None, {"seconds": 1.4}, error=0.05),
    "fleet": Case("heavy_share=0.25", "heavy_share", None, {"share": 0.25}, error=0.2),
    "signals": Case("late_green=*,2", "late_green", "*", {"seconds": 2.0}, error=0.1),
    "detectors": Case(
        "undercount=stop:S_C_0,0.25", "undercount", "stop:S_C_0", {"share": 0.25}, error=0.2
    ),
    "demand": Case(
        "demand_level=S_C,1.4", "demand_level", "S_C", {"factor": 1.4}, error=0.1
    ),
    "roads": Case("local_speed=S_C,0.8", "local_speed", "S_C", {"factor": 0.8}, error=0.05),
}  # fmt: skip


def overlap(window: list[float], truth: tuple[float, float]) -> float:
    """Intersection over union of two windows."""
    both = max(0.0, min(window[1], truth[1]) - max(window[0], truth[0]))
    return both / (max(window[1], truth[1]) - min(window[0], truth[0]))


@pytest.mark.slow  # a quicker one is in tests/cli/diagnose_command_test.py
@pytest.mark.parametrize("family", CASES)
def test_a_hidden_effect_is_named(street, tmp_path: Path, family: str) -> None:
    case = CASES[family]
    found = street.diagnose(street.measure(case.domain), tmp_path)
    assert found["verdict"] == "explained", found["sentence"]
    (effect,) = found["effects"]
    assert effect["name"] == case.name
    assert effect["place"] == case.place
    for key, value in (case.values or {}).items():
        assert effect["parameters"][key]["value"] == pytest.approx(value, rel=case.error)
    assert effect["window"] is None
    heldout = found["heldout"]
    assert heldout["shrink"] >= 0.8
    assert heldout["p_before"] < 0.05 < heldout["p_after"]
    assert heldout["after"] < heldout["floor"]
    assert found["where"], "nothing was located"
    # The corrected scenario is a domain like any other; faults of detectors are none of its own.
    corrected = load_scenario(tmp_path / found["corrected"])
    assert (corrected.hash == street.scenario.hash) == (family == "detectors")


@pytest.mark.slow
def test_a_closed_lane_is_named_with_its_window(street, tmp_path: Path) -> None:
    # Windows are known to the minute and no better, which leaves part of so large a gap.
    found = street.diagnose(street.measure("lane_closure=S_C_0,300,780"), tmp_path)
    assert found["verdict"] in ("explained", "partially_explained"), found["sentence"]
    (effect,) = found["effects"]
    assert (effect["name"], effect["place"]) == ("lane_closure", "S_C_0")
    assert overlap(effect["window"], (300.0, 780.0)) >= 0.6
    assert found["heldout"]["shrink"] >= 0.5


def test_where_nothing_is_hidden_nothing_is_named(street, tmp_path: Path) -> None:
    for seed in (5, 6, 7):
        found = street.diagnose(street.measure("sim", seed=seed), tmp_path)
        assert found["verdict"] == "no_discrepancy", found["sentence"]
        assert found["effects"] == []
        assert found["corrected"] is None
        assert found["heldout"]["before"] < found["heldout"]["floor"] * 1.2


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_effect_outside_the_library_is_not_explained_away(street, tmp_path: Path) -> None:
    # Drivers of another kind, and nothing but the old kind's numbers to explain them with.
    among = {"acceleration", "headway", "startup_delay", "late_green"}
    found = street.diagnose(street.measure("driver_model=EIDM"), tmp_path, among=among)
    assert found["verdict"] in ("unknown", "partially_explained"), found["sentence"]
    assert found["heldout"]["p_before"] < 0.05
    assert found["next_measurement"]
    assert found["where"]


def test_where_nothing_helps_the_answer_is_unknown(street, tmp_path: Path) -> None:
    # Drivers of another kind again, of whom faults of detectors are no description.
    among = {"undercount", "dropout", "stuck", "swapped"}
    found = street.diagnose(street.measure("driver_model=EIDM"), tmp_path, among=among)
    assert found["verdict"] == "unknown", found["sentence"]
    assert found["effects"] == []
    assert found["corrected"] is None
    assert found["where"]
    assert found["next_measurement"]
