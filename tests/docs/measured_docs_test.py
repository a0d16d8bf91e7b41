"""The page on measured data: its example loads, its tables are those of the code."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np

from ugat_marl.data import read_measured
from ugat_marl.data.measured import atspm, coverage
from ugat_marl.data.measured.atspm_mapping import AtspmMapping, read_mapping
from ugat_marl.data.measured.tables import TABLES
from ugat_marl.scenarios import Network, read_scenario, signal_widths

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "measured-data.md").read_text(
    encoding="utf-8"
)


def test_the_example_is_measured_data(tmp_path: Path) -> None:
    files = re.findall(r"```csv (\S+)\n(.*?)```", PAGE, flags=re.DOTALL)
    assert sum(text.count("\n") for _, text in files) <= 20
    for name, text in files:
        (tmp_path / name).write_text(text)
    scenario = read_scenario("single-v1")
    read = read_measured(tmp_path, scenario, Network.read(scenario))
    assert [(period.id, period.split) for period in read.periods] == [
        ("monday", "fit"),
        ("tuesday", "heldout"),
    ]
    vehicle = read.periods[0].passages["a12"]
    assert (vehicle.on_s[0], vehicle.off_s[0], vehicle.speed_mps[0]) == (3.1, 3.6, 13.2)
    assert np.isnan(read.periods[1].passages["s12"].speed_mps[0])
    assert read.periods[1].signals["A1"] == ((-4.5, "GGGGrrrrrrGGGGrrrrrr"),)


def test_every_column_of_every_file_is_described() -> None:
    described = re.findall(r"\| column \| unit \| meaning \|\n\|[-|]+\|\n((?:\|.*\n)+)", PAGE)
    columns = [tuple(re.findall(r"^\| `(\w+)` ", table, flags=re.MULTILINE)) for table in described]
    known = {table.stem: (*table.columns, *table.optional) for table in TABLES}
    order = (
        "periods", "detectors", "signals", "detections", "counts", "turning", "travel_times",
        "lanes", "trajectories",
    )  # fmt: skip
    assert columns == [known[name] for name in order]
    for table in TABLES:
        assert all(f"`{name}`" in PAGE for name in table.names())


def ruled_out(missing: str) -> set[str]:
    row = re.search(rf"^\| {missing} \|(.*)\|$", PAGE, flags=re.MULTILINE)
    assert row is not None, missing
    return set(re.findall(r"`(\w+)`", row[1]))


def test_what_is_ruled_out_is_what_the_code_rules_out() -> None:
    assert ruled_out(r"detections \(counts only\)") == set(coverage.COUNTABLE)
    assert ruled_out("detections, with .*?") == set(coverage.SUMMED)
    assert ruled_out("signals") == set(coverage.NEEDS_SIGNALS)
    assert ruled_out("yellow") == set(coverage.NEEDS_YELLOW)
    assert ruled_out("`stop` detectors") == set(coverage.NEEDS_STOP)
    assert ruled_out("`advance` detectors") == set(coverage.NEEDS_ADVANCE)
    assert ruled_out("a second kind of detectors") == set(coverage.NEEDS_TWO_KINDS)
    assert ruled_out("speeds") == {*coverage.NEEDS_SPEEDS, "desired_speed"}


def test_the_events_are_those_of_the_importer() -> None:
    table = PAGE.partition("| event | meaning |")[2].partition("\nSource")[0]
    listed = {
        int(code)
        for row in re.findall(r"^\| ([\d, ]+) \|", table, flags=re.MULTILINE)
        for code in row.split(",")
    }
    assert listed == {
        *atspm.PHASE_EVENTS,
        *atspm.OVERLAP_EVENTS,
        *atspm.ARROW_EVENTS,
        *atspm.DETECTOR_FAULTS,
        atspm.DETECTOR_OFF,
        atspm.DETECTOR_ON,
        atspm.CLOCK_UPDATED,
    }


def test_the_mapping_on_the_page_is_one(tmp_path: Path) -> None:
    example = re.search(r"```toml\n(.*?)```", PAGE, flags=re.DOTALL)
    assert example is not None
    assert AtspmMapping.model_validate(tomllib.loads(example[1])).devices[0].id == "1136"
    (tmp_path / "mapping.toml").write_text(example[1])
    scenario = read_scenario("single-v1")
    driven = {
        item.id: {link.index for link in item.links}
        for item in Network.read(scenario).intersections
    }
    mapping = read_mapping(tmp_path / "mapping.toml", signal_widths(scenario), driven)
    assert [span.id for span in mapping.spans()] == ["2024-03-05T0700", "2024-03-06T0700"]
    assert mapping.devices[0].detectors[0].latency_s == 0.3
