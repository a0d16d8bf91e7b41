"""Counts, occupancies and mean speeds of intervals, and no single vehicle: are effects found?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from ugat_marl.data import MeasuredData, as_counts
from ugat_marl.data.measured.coverage import COUNTABLE, SUMMED
from ugat_marl.diagnosis.thresholds import Effort
from ugat_marl.experiments import policy_factory, record
from ugat_marl.scenarios import Passages

AMONG = {
    "acceleration", "headway", "startup_delay", "desired_speed", "heavy_share", "late_green",
    "undercount", "demand_level", "demand_surge", "lane_closure", "local_speed",
} & {*COUNTABLE, *SUMMED}  # fmt: skip
"""Rivals of all families that sums can show."""
FEW = Effort(base=24, bank=2, fit=5, test=16)


def of_sums(street, domain: str, length_s: float, out: Path, **options: Any) -> dict[str, Any]:
    return street.diagnose(as_counts(street.measure(domain), length_s), out, among=AMONG, **options)


@pytest.mark.slow
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
@pytest.mark.parametrize("length_s", [pytest.param(60.0, marks=pytest.mark.slow), 300.0])
def test_a_slow_road_is_found_with_its_place(street, tmp_path: Path, length_s: float) -> None:
    found = of_sums(street, "local_speed=S_C,0.8", length_s, tmp_path)
    assert found["verdict"] == "explained", found["sentence"]
    (effect,) = found["effects"]
    assert (effect["name"], effect["place"]) == ("local_speed", "S_C")
    factor = effect["parameters"]["factor"]
    assert factor["low"] <= 0.8 <= factor["high"]


@pytest.mark.slow  # workflow_test.py has it with counts alone
@pytest.mark.parametrize("length_s", [60.0, 300.0])
def test_sums_of_the_scenario_itself_do_not_contradict_it(
    street, tmp_path: Path, length_s: float
) -> None:
    found = of_sums(street, "sim", length_s, tmp_path)
    assert found["verdict"] == "no_discrepancy", found["sentence"]


# --- vehicles at two places, told by their positions and not by the suite's own loops -------------

Mark = tuple[str, float]
"""Edge, and distance from its start in m."""


def reached(vehicles: pl.DataFrame, mark: Mark, name: str) -> pl.DataFrame:
    """When each vehicle first stands at a place or beyond it on the same edge."""
    edge = pl.col("lane_id").str.replace(r"_\d+$", "")
    there = vehicles.filter((edge == mark[0]) & (pl.col("position_m") >= mark[1]))
    return there.group_by("period_id", "vehicle_id").agg(pl.col("time_s").min().alias(name))


def probes(vehicles: pl.DataFrame, first: Mark, last: Mark) -> pl.DataFrame:
    """Travel times of every fifth vehicle."""
    both = reached(vehicles, first, "time_s").join(
        reached(vehicles, last, "end_s"), on=["period_id", "vehicle_id"]
    )
    some = both.sort("period_id", "time_s").gather_every(5)
    return some.select(
        "period_id",
        "time_s",
        pl.lit(first[0]).alias("from_edge"),
        pl.lit(first[1]).alias("from_m"),
        pl.lit(last[0]).alias("to_edge"),
        pl.lit(last[1]).alias("to_m"),
        (pl.col("end_s") - pl.col("time_s")).alias("travel_s"),
    )


def counted(whole: MeasuredData, length_s: float) -> MeasuredData:
    """The same data as bare counts."""
    sums = as_counts(whole, length_s)
    assert sums.counts is not None
    bare = sums.counts.drop("occupancy", "mean_speed_mps")
    return replace(sums, counts=bare, trajectories=None)


@pytest.mark.slow
def test_slow_drivers_are_found_from_counts_and_times_of_probes(street, tmp_path: Path) -> None:
    whole = record(
        street.scenario, "desired_speed=0.85", policy_factory("fixed-time:30"), periods=5, seed=5,
        trajectories=True,
    )  # fmt: skip
    assert whole.trajectories is not None
    ways = [((edge, 50.0), (edge, 350.0)) for edge in ("S_C", "W_C")]
    ways += [(("S_C", 350.0), ("C_N", 60.0)), (("W_C", 350.0), ("C_E", 60.0))]
    times = pl.concat([probes(whole.trajectories, *way) for way in ways])
    measured = replace(counted(whole, 300.0), travel_times=times)
    found = street.diagnose(measured, tmp_path, among=AMONG, effort=FEW)
    assert found["verdict"] == "explained", found["sentence"]
    (effect,) = found["effects"]
    assert effect["name"] == "desired_speed"
    factor = effect["parameters"]["factor"]
    assert factor["low"] <= 0.85 <= factor["high"] + 0.01
    assert found["traffic_check"]["measure"] == "travel times of probes"


def test_a_loop_that_stays_on_is_not_taken_for_drivers(street, tmp_path: Path) -> None:
    whole = street.measure("sim")

    def longer(name: str, seen: Passages) -> Passages:
        late = 0.8 if name.startswith("advance") else 0.0
        return replace(seen, off_s=seen.off_s + late)

    days = tuple(
        replace(day, passages={name: longer(name, x) for name, x in day.passages.items()})
        for day in whole.periods
    )
    measured = as_counts(replace(whole, periods=days), 300.0)
    found = street.diagnose(measured, tmp_path, among=AMONG, effort=FEW)
    assert found["verdict"] == "no_discrepancy", found["sentence"]
    assert any("at advance detectors" in text for text in found["findings"])
