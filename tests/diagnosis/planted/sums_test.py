"""Counts, occupancies and mean speeds of intervals, and no single vehicle: are effects found?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ugat_marl.data import as_counts
from ugat_marl.data.measured.coverage import COUNTABLE, SUMMED
from ugat_marl.diagnosis.thresholds import Effort

AMONG = {
    "acceleration", "headway", "startup_delay", "desired_speed", "heavy_share", "late_green",
    "undercount", "demand_level", "demand_surge", "lane_closure", "local_speed",
} & {*COUNTABLE, *SUMMED}  # fmt: skip
"""Rivals of all families that sums can show."""
FEW = Effort(base=24, bank=2, fit=5, test=16)


def of_sums(street, domain: str, length_s: float, out: Path, **options: Any) -> dict[str, Any]:
    return street.diagnose(as_counts(street.measure(domain), length_s), out, among=AMONG, **options)


def test_a_long_headway_is_found_without_a_single_vehicle(street, tmp_path: Path) -> None:
    found = of_sums(street, "headway=1.45", 300.0, tmp_path, effort=FEW)
    assert found["verdict"] == "explained", found["sentence"]
    (effect,) = found["effects"]
    assert effect["name"] == "headway"
    seconds = effect["parameters"]["seconds"]
    assert seconds["low"] < 1.45 < seconds["high"]
    assert seconds["high"] - seconds["low"] < 0.4
    assert found["traffic_check"]["measure"] == "speed and occupancy"
    assert found["corrected"] == "corrected"


@pytest.mark.slow
@pytest.mark.parametrize("length_s", [60.0, 300.0])
def test_a_slow_road_is_found_with_its_place(street, tmp_path: Path, length_s: float) -> None:
    found = of_sums(street, "local_speed=S_C,0.8", length_s, tmp_path)
    assert found["verdict"] == "explained", found["sentence"]
    (effect,) = found["effects"]
    assert (effect["name"], effect["place"]) == ("local_speed", "S_C")
    factor = effect["parameters"]["factor"]
    assert factor["low"] <= 0.8 <= factor["high"]


@pytest.mark.slow
@pytest.mark.parametrize("length_s", [60.0, 300.0])
def test_sums_of_the_scenario_itself_do_not_contradict_it(
    street, tmp_path: Path, length_s: float
) -> None:
    found = of_sums(street, "sim", length_s, tmp_path)
    assert found["verdict"] == "no_discrepancy", found["sentence"]
