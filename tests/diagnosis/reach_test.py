"""A scenario whose vehicles do not come where vehicles were measured says so before it runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import MeasuredData
from ugat_marl.diagnosis import DiagnosisConfig, Study
from ugat_marl.diagnosis.compared_detectors import (
    missing_interval_findings,
    unreached_edge_findings,
)
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import load_scenario
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import Detector, Passages, Period, Scenario

SOUTH, WEST = Detector("s", "S_C_0", 90.0, 0.0, "stop"), Detector("w", "W_C_0", 90.0, 0.0, "stop")
TIMES = np.arange(5.0)
SEEN = Passages(TIMES, TIMES + 0.4, TIMES + 9, TIMES + 5)
DAY = Period("day1", 0.0, 200.0, "fit", {"C": ((0.0, "Gr"), (90.0, "rG"))}, {"s": SEEN, "w": SEEN})
BOTH = MeasuredData((SOUTH, WEST), (DAY,))


@pytest.fixture(scope="module")
def scenario(data: Path) -> Scenario:
    return load_scenario(data / "crossing")


@pytest.fixture(scope="module")
def northbound(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    """The crossing with cars from the south only."""
    directory = tmp_path_factory.mktemp("crossing") / "northbound"
    directory.mkdir()
    for file in (data / "crossing").iterdir():
        (directory / file.name).write_bytes(file.read_bytes())
    routes = '<routes><vType id="car"/><route id="north" edges="S_C C_N"/>'
    routes += '<vehicle id="n" type="car" route="north" depart="1"/></routes>'
    (directory / "demand.rou.xml").write_text(routes)
    return load_scenario(directory)


def test_where_demand_comes_everywhere_there_is_nothing_to_say(scenario: Scenario) -> None:
    assert unreached_edge_findings(scenario, BOTH, BOTH.detectors) == ()


def test_edges_without_demand_are_named_with_what_was_counted(northbound: Scenario) -> None:
    (finding,) = unreached_edge_findings(northbound, BOTH, BOTH.detectors)
    assert "no vehicle of its demand comes over W_C, where detectors counted 5" in finding.text
    assert not finding.rules_out
    study = Study.of(northbound, BOTH, DiagnosisConfig())
    assert study.measured.findings == (finding,)
    assert study.measured.hash == BOTH.hash


def test_changes_of_demand_are_proposed_from_flows_of_the_measured_time(
    scenario: Scenario,
) -> None:
    # A vehicle every 20 s on each of two roads, and none after 400 s.
    study = Study.of(scenario.with_duration(1600.0), BOTH, DiagnosisConfig())
    assert study.place_finder._routes.origins == pytest.approx({"S_C": 180.0, "W_C": 180.0})


def test_edges_on_which_nobody_was_counted_need_no_demand(northbound: Scenario) -> None:
    quiet = replace(BOTH, periods=(replace(DAY, passages={"s": SEEN}),))
    assert unreached_edge_findings(northbound, quiet, BOTH.detectors) == ()


def test_counts_in_intervals_count_as_well(northbound: Scenario) -> None:
    counts = pl.DataFrame(
        {"period_id": ["day1"] * 2, "detector_id": ["w", "s"], "count": [7.0, 3.0]}
    )
    alone = MeasuredData((SOUTH, WEST), (replace(DAY, passages={}),), counts=counts)
    (finding,) = unreached_edge_findings(northbound, alone, alone.detectors)
    assert "W_C, where detectors counted 7;" in finding.text


def test_demand_that_reaches_no_measured_lane_is_refused_before_anything_runs(
    northbound: Scenario,
) -> None:
    west = MeasuredData((WEST,), (replace(DAY, passages={"w": SEEN}),))
    with pytest.raises(MeasuredDataError, match=r"no vehicle .* \(W_C\); check lane_id"):
        Study.of(northbound, west, DiagnosisConfig())


def test_counts_with_missing_intervals_are_told() -> None:
    rows = [
        ("day1", begin, begin + 100.0, name, 5)
        for name in ("s", "w")
        for begin in (0.0, 100.0)
        if (name, begin) != ("w", 0.0)
    ]
    names = ("period_id", "begin_s", "end_s", "detector_id", "count")
    counts = pl.DataFrame(rows, schema=names, orient="row")
    some = replace(BOTH, counts=counts, periods=(replace(DAY, passages={}),))
    (finding,) = missing_interval_findings(some, some.detectors, Thresholds())
    assert "intervals are missing at 1 of 2 detectors (w);" in finding.text
    whole = replace(some, counts=counts.filter(pl.col("detector_id") == "s"))
    assert missing_interval_findings(whole, [SOUTH], Thresholds()) == ()
    assert missing_interval_findings(BOTH, BOTH.detectors, Thresholds()) == ()
