"""The tutorial on a real log: its files, and what is imported against counts of the log itself."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import MeasuredData, read_measured
from ugat_marl.scenarios import Network, read_scenario

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "tutorials" / "real-street.md").read_text(encoding="utf-8")
SPEC = importlib.util.find_spec("atspm")  # found, and never imported: it would load a database
BEGIN_S = 300.0

absent = pytest.mark.skipif(SPEC is None, reason="needs the extra street: atspm has the log")


def commands(title: str) -> str:
    """Return the commands of a section of the page."""
    section = re.search(rf"^## {title}.*?(?=^## |\Z)", PAGE, flags=re.MULTILINE | re.DOTALL)
    assert section is not None
    return "".join(re.findall(r"```sh\n(.*?)```", section[0], flags=re.DOTALL))


def play(block: str, folder: Path) -> str:
    """Run commands of the page in a folder with the documents of the clone."""
    programs = folder / "bin"
    if not programs.exists():
        programs.mkdir()
        (programs / "ugat-marl").write_text(f'#!/bin/sh\nexec {sys.executable} -m ugat_marl "$@"\n')
        (programs / "python").write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
        for program in programs.iterdir():
            program.chmod(0o755)
        (folder / "docs").symlink_to(ROOT / "docs")
    path = [str(programs), str(Path(sys.executable).parent), os.environ["PATH"]]
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", block],
        cwd=folder, env={**os.environ, "PATH": os.pathsep.join(path)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{block}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the drawn intersection."""
    place = tmp_path_factory.mktemp("street")
    play(commands("2. The intersection"), place)
    return place


@pytest.fixture(scope="module")
def measured(folder: Path) -> MeasuredData:
    play(commands("3. The log"), folder)
    scenario = read_scenario(folder / "street1136")
    return read_measured(folder / "street1136-measured", scenario, Network.read(scenario))


def log() -> pl.DataFrame:
    """The rows of the log, with seconds since noon."""
    assert SPEC is not None and SPEC.submodule_search_locations is not None
    file = Path(SPEC.submodule_search_locations[0]) / "data" / "sample_raw_data.parquet"
    noon = pl.datetime(2024, 4, 15, 12)
    return pl.read_parquet(file).with_columns(
        s=(pl.col("TimeStamp") - noon).dt.total_microseconds() / 1e6
    )


def test_the_drawn_intersection_has_the_phases_of_the_street(folder: Path) -> None:
    (light,) = Network.read(read_scenario(folder / "street1136")).intersections
    assert light.phases == ("GrsrGGG", "GGsrsrr", "rrGGsrr")
    assert {(link.from_lane, link.to_edge) for link in light.links} == {
        ("from_east_0", "to_west"), ("from_east_1", "to_south"), ("from_south_0", "to_east"),
        ("from_south_1", "to_west"), ("from_west_0", "to_south"), ("from_west_0", "to_east"),
        ("from_west_1", "to_east"),
    }  # fmt: skip


@absent
def test_the_demand_is_that_of_the_first_hour_alone(folder: Path) -> None:
    given = pl.read_csv(ROOT / "docs" / "tutorials" / "real-street" / "turns.csv")
    turns = {(a, b): count for a, b, count in given.select("from", "to", "count").iter_rows()}
    rows = log().filter((pl.col("EventId") == 82) & (pl.col("s") < 3600))
    seen = {
        channel: rows.filter(pl.col("Parameter") == channel).height * 2100 / 3600
        for channel in (3, 9, 19, 20, 25, 27)
    }
    right = 0.25 * seen[20]
    for turn, count in (
        (("from_west", "to_south"), right),
        (("from_west", "to_east"), seen[19] + seen[20] - right),
        (("from_east", "to_west"), seen[3]),
        (("from_east", "to_south"), seen[27]),
        (("from_south", "to_west"), seen[9]),
        (("from_south", "to_east"), seen[25]),
    ):
        assert turns[turn] == pytest.approx(count, abs=1.0), turn


@absent
def test_two_of_the_four_half_hours_are_held_out(measured: MeasuredData) -> None:
    assert [(p.id, p.begin_s, p.end_s, p.split) for p in measured.periods] == [
        ("12:00", BEGIN_S, 2100.0, "fit"), ("12:30", BEGIN_S, 2100.0, "fit"),
        ("13:00", BEGIN_S, 2100.0, "heldout"), ("13:30", BEGIN_S, 2100.0, "heldout"),
    ]  # fmt: skip


@absent
def test_signals_and_vehicles_are_those_of_the_log(measured: MeasuredData) -> None:
    rows = log()
    for half, period in enumerate(measured.periods):
        begin = 1800.0 * half
        inside = rows.filter(pl.col("s").is_between(begin, begin + 1800.0, closed="left"))
        for phase, link in ((2, 0), (5, 1), (6, 6), (8, 3)):
            of_phase = inside.filter(pl.col("Parameter") == phase)
            for event, letter in ((1, "G"), (8, "y")):
                wanted = of_phase.filter((pl.col("EventId") == event) & (pl.col("s") > begin))
                states = period.signals["light"]
                found = [
                    since
                    for (_, before), (since, state) in zip(states, states[1:], strict=False)
                    if state[link] == letter != before[link] and since < period.end_s
                ]
                times = wanted["s"].to_numpy() - begin + BEGIN_S
                np.testing.assert_allclose(found, times, atol=1e-6)
        count = inside.filter((pl.col("EventId") == 82) & (pl.col("Parameter") == 4)).height
        assert abs(len(period.passages["east stop"]) - count) <= 1
    assert {detector.clock for detector in measured.detectors} == {"signals"}
