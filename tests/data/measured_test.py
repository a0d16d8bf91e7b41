"""Measured data: what was written is what is read, and every wrong file is named."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ugat_marl.data import (
    CSV_HASHES,
    MeasuredData,
    passages_as_written,
    read_measured,
    split_periods,
    write_measured,
)
from ugat_marl.data.measured import tables
from ugat_marl.data.measured.local_time import LocalClock
from ugat_marl.data.measured.reading import _of_moments
from ugat_marl.effects import load_scenario
from ugat_marl.errors import MeasuredDataError, OutputError
from ugat_marl.scenarios import (
    Detector,
    Network,
    Passages,
    Period,
    Scenario,
    read_scenario,
    signal_widths,
)

Change = Callable[[str], str]

DETECTORS = (
    Detector("a", "S_C_0", 40.0, 2.0, "advance", clock="signals"),
    Detector("s", "S_C_0", 90.0, 0.0, "stop", clock="signals"),
    Detector("w", "W_C_0", 90.0, 0.0, "stop", clock="signals"),
    Detector("x", "C_N_0", 5.0, 0.0, "exit", clock="signals"),
)
SIGNALS = {"C": tuple((20.0 * i, ("Gr", "rG")[i % 2]) for i in range(10))}


@pytest.fixture(scope="module")
def crossing_scenario(data: Path) -> Scenario:
    return read_scenario(data / "crossing")


@pytest.fixture(scope="module")
def network(crossing_scenario: Scenario) -> Network:
    return Network.read(crossing_scenario)


def vehicles(seed: int, count: int = 12, end: float = 200.0) -> Passages:
    rng = np.random.default_rng(seed)
    times = np.sort(rng.choice(int(1000 * end), 2 * count, replace=False)) / 1000
    return Passages(
        times[::2],
        times[1::2],
        np.round(rng.uniform(1, 15, count), 2),
        np.where(rng.random(count) < 0.5, np.nan, 5.0),
    )


def recording(periods: int = 3) -> MeasuredData:
    """Days of a few vehicles per detector on the crossing of tests/data."""
    days = [
        Period(
            f"day{i}",
            0.0,
            200.0,
            split,
            SIGNALS,
            {d.id: vehicles(10 * i + j) for j, d in enumerate(DETECTORS)},
        )
        for i, split in enumerate(split_periods(periods))
    ]
    return MeasuredData(DETECTORS, tuple(days))


def edit(file: Path, change: Change) -> None:
    before = file.read_text()
    after = change(before)
    assert after != before, f"the edit of {file.name} changed nothing"
    file.write_text(after)
    (file.parent / CSV_HASHES).unlink(missing_ok=True)  # as whoever edits by hand has to


@pytest.fixture
def reread(
    tmp_path: Path, crossing_scenario: Scenario, network: Network
) -> Callable[..., MeasuredData]:
    """Writes a recording as CSV, changes files, and reads it."""

    def read(
        changes: dict[str, Change] | None = None, given: MeasuredData | None = None
    ) -> MeasuredData:
        directory = write_measured(given or recording(), tmp_path / "street", csv=True)
        for name, change in (changes or {}).items():
            edit(directory / name, change)
        return read_measured(directory, crossing_scenario, network)

    return read


def texts(measured: MeasuredData) -> str:
    return "\n".join(finding.text for finding in measured.findings)


@pytest.mark.parametrize("csv", [False, True])
def test_what_is_read_is_what_was_written(
    csv: bool, tmp_path: Path, crossing_scenario: Scenario, network: Network
) -> None:
    before = recording()
    lanes = pl.DataFrame(
        {
            "period_id": ["day0", "day0"],
            "time_s": [0, 1],
            "lane_id": ["S_C_0", "S_C_0"],
            "vehicles": [0, 2],
            "halting": [0, 1],
            "mean_speed_mps": [float("nan"), 3.5],
        }
    )
    counts = pl.DataFrame(
        {
            "period_id": ["day0"],
            "begin_s": [0.0],
            "end_s": [200.0],
            "detector_id": ["s"],
            "count": [7],
        }
    )
    before = replace(before, lanes=lanes, counts=counts)
    write_measured(before, tmp_path / "street", csv=csv)
    after = read_measured(tmp_path / "street", crossing_scenario, network)
    assert after.hash == before.hash
    assert after.detectors == DETECTORS
    assert [period.split for period in after.periods] == ["fit", "fit", "heldout"]
    assert after.periods[1].signals == SIGNALS
    one, other = before.periods[2].passages["w"], after.periods[2].passages["w"]
    np.testing.assert_array_equal(one.on_s, other.on_s)
    np.testing.assert_array_equal(one.off_s, other.off_s)
    np.testing.assert_array_equal(one.speed_mps, other.speed_mps)
    np.testing.assert_array_equal(one.length_m, other.length_m)
    renamed = replace(before, lanes=lanes.with_columns(lane_id=pl.lit("S_C_7")))
    write_measured(renamed, tmp_path / "wrong", csv=csv)
    with pytest.raises(MeasuredDataError, match=r"lanes\..*'S_C_7', .* did you mean 'S_C_0'"):
        read_measured(tmp_path / "wrong", crossing_scenario, network)
    assert after.lanes is not None and after.lanes["mean_speed_mps"].to_list() == [None, 3.5]
    assert [finding.text.split(" (")[0] for finding in after.findings] == [
        "detectors.csv: 2 stop detectors",  # 400 m upstream
        "periods.csv: 3 periods",  # of 200 s
    ]


def test_the_hash_counts_milliseconds_and_every_passage() -> None:
    base = recording()
    day = base.periods[0]

    def with_first(passages: Passages) -> str:
        changed = replace(day, passages={**day.passages, "s": passages})
        return replace(base, periods=(changed, *base.periods[1:])).hash

    first = day.passages["s"]
    assert with_first(replace(first, on_s=first.on_s + 1e-5)) == base.hash
    assert with_first(replace(first, on_s=first.on_s + 1e-3)) != base.hash
    assert with_first(first.at(np.arange(len(first) - 1))) != base.hash


def test_times_of_tables_are_rounded_too(reread: Callable[..., MeasuredData]) -> None:
    moment = {"period_id": ["day0"], "time_s": [0.1 + 0.2]}
    before = replace(
        recording(),
        lanes=pl.DataFrame(
            {
                **moment, "lane_id": ["S_C_0"], "vehicles": [2.0], "halting": [1.0],
                "mean_speed_mps": [3.5],
            }
        ),
        trajectories=pl.DataFrame(
            {
                **moment, "vehicle_id": ["v"], "lane_id": ["S_C_0"], "position_m": [1.0],
                "speed_mps": [2.0],
            }
        ).select("period_id", "vehicle_id", "time_s", "lane_id", "position_m", "speed_mps"),
        travel_times=pl.DataFrame(
            {
                **moment, "from_edge": ["S_C"], "from_m": [5.0], "to_edge": ["C_N"], "to_m": [9.0],
                "travel_s": [40.0],
            }
        ),
    )  # fmt: skip
    assert reread(given=before).hash == before.hash
    assert before.trajectories is not None
    other = before.trajectories.with_columns(pl.col("time_s") + 1e-3)
    assert replace(before, trajectories=other).hash != before.hash


def test_a_vehicle_that_stands_on_the_detector_when_the_period_begins_or_ends(
    reread: Callable[..., MeasuredData],
) -> None:
    nan = np.nan
    passages = Passages(
        np.array([nan, 50.0, 180.0]),
        np.array([12.0, 51.0, nan]),
        np.array([nan, 9.0, nan]),
        np.array([nan, nan, nan]),
    )
    base = recording(1)
    before = replace(base, periods=(replace(base.periods[0], passages={"s": passages}),))
    after = reread(given=before)
    assert after.hash == before.hash
    assert np.isnan(after.periods[0].passages["s"].on_s[0])
    assert np.isnan(after.periods[0].passages["s"].off_s[2])


def test_what_lies_outside_of_the_period_is_not_written(
    reread: Callable[..., MeasuredData],
) -> None:
    passages = Passages(
        np.array([-3.0, -1.0, 50.0, 199.5, 201.0]),
        np.array([-2.0, 1.0, 51.0, 200.5, 202.0]),
        np.array([1.0, 2.0, 3.0, 4.0, 5.0]),
        np.full(5, np.nan),
    )
    base = recording(1)
    read = reread(
        given=replace(base, periods=(replace(base.periods[0], passages={"s": passages}),))
    ).periods[0]
    np.testing.assert_array_equal(read.passages["s"].on_s, [np.nan, 50, 199.5])
    np.testing.assert_array_equal(read.passages["s"].off_s, [1, 51, np.nan])
    np.testing.assert_array_equal(read.passages["s"].speed_mps, [2, 3, 4])


def test_a_detector_is_on_or_off(reread: Callable[..., MeasuredData]) -> None:
    passages = Passages(
        np.array([10.0, 11.0]), np.array([11.4, 12.0]), np.array([1.0, 2.0]), np.full(2, np.nan)
    )
    base = recording(1)
    read = reread(
        given=replace(base, periods=(replace(base.periods[0], passages={"s": passages}),))
    ).periods[0]
    np.testing.assert_array_equal(read.passages["s"].on_s, [10, 11])
    np.testing.assert_array_equal(read.passages["s"].off_s, [11, 12])
    np.testing.assert_array_equal(read.passages["s"].speed_mps, [1, 2])


def test_what_only_a_simulation_knows_is_not_logged(reread: Callable[..., MeasuredData]) -> None:
    """Ends that are unknown in the middle: a vehicle that changed lanes on the zone."""
    nan = np.nan
    passages = Passages(
        #         first  lost   whole  filled  next  stray  end
        np.array([nan, 20.0, 40.0, 60.0, 61.5, nan, 190.0]),
        np.array([3.0, nan, 41.0, nan, 62.0, 70.0, nan]),
        np.arange(7.0),
        np.full(7, nan),
    )
    expected = Passages(
        np.array([nan, 40.0, 60.0, 61.5, 190.0]),
        np.array([3.0, 41.0, 61.5, 62.0, nan]),
        np.array([0.0, 2.0, 3.0, 4.0, 6.0]),
        np.full(5, nan),
    )
    logged = passages_as_written(passages.at(np.array([6, 5, 4, 3, 2, 1, 0])), 0.0, 200.0)
    base = recording(1)
    read = reread(
        given=replace(base, periods=(replace(base.periods[0], passages={"s": passages}),))
    )
    assert not [f.text for f in read.findings if "without" in f.text or "follows" in f.text]
    for found in (logged, read.periods[0].passages["s"]):
        np.testing.assert_array_equal(found.on_s, expected.on_s)
        np.testing.assert_array_equal(found.off_s, expected.off_s)
        np.testing.assert_array_equal(found.speed_mps, expected.speed_mps)


def test_a_detector_that_is_on_all_the_time(reread: Callable[..., MeasuredData]) -> None:
    stuck = Passages(np.array([-5.0]), np.array([300.0]), np.full(1, np.nan), np.full(1, np.nan))
    base = recording(1)
    read = reread(given=replace(base, periods=(replace(base.periods[0], passages={"s": stuck}),)))
    np.testing.assert_array_equal(read.periods[0].passages["s"].on_s, [0.0])
    np.testing.assert_array_equal(read.periods[0].passages["s"].off_s, [np.nan])


times = st.one_of(
    st.just(float("nan")), st.floats(-20, 220), st.integers(-2, 9).map(float), st.just(200.0)
)


@settings(max_examples=100)
@given(rows=st.lists(st.tuples(times, times), max_size=12))
def test_what_is_logged_is_what_is_read(
    rows: list[tuple[float, float]], crossing_scenario: Scenario, network: Network
) -> None:
    """A simulation's data, written and read, are `passages_as_written`; nothing is lost."""
    table = np.array([row for row in rows if not row[1] < row[0]], np.float64).reshape(-1, 2)
    table = table[~np.isnan(table).all(1)]
    nothing = np.full(len(table), np.nan)
    logged = passages_as_written(Passages(table[:, 0], table[:, 1], nothing, nothing), 0.0, 200.0)
    again = passages_as_written(logged, 0.0, 200.0)
    np.testing.assert_array_equal(logged.on_s, again.on_s)
    np.testing.assert_array_equal(logged.off_s, again.off_s)
    # An off and an on at the very first moment could be a pulse just as well.
    assume(len(logged) < 2 or np.isfinite(logged.on_s[0]) or logged.off_s[0] < logged.on_s[1])
    base = recording(1)
    before = replace(base, periods=(replace(base.periods[0], passages={"s": logged}),))
    with tempfile.TemporaryDirectory() as directory:
        street = write_measured(before, Path(directory) / "street")
        if not len(logged):
            return
        read = read_measured(street, crossing_scenario, network)
    assert read.hash == before.hash
    assert not [f.text for f in read.findings if "without" in f.text or "follows" in f.text]


def test_writing_replaces_measured_data_and_nothing_else(tmp_path: Path) -> None:
    directory = tmp_path / "street"
    write_measured(recording(3), directory)
    write_measured(recording(2), directory, csv=True)
    names = {path.name for path in directory.iterdir()}
    tables = {"periods.csv", "detectors.csv", "signals.csv", "detections.csv"}
    assert names == tables | {CSV_HASHES}
    assert (directory / "periods.csv").read_text().count("day") == 2
    (directory / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="notes.txt"):
        write_measured(recording(), directory)
    assert (directory / "notes.txt").read_text() == "mine"
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="is a file"):
        write_measured(recording(), tmp_path / "file")
    (tmp_path / "empty").mkdir()
    write_measured(recording(), tmp_path / "empty")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "file", "street"]


@pytest.mark.parametrize("there", [True, False])
def test_a_link_to_a_folder_stays_one(there: bool, tmp_path: Path) -> None:
    link, target = tmp_path / "links" / "street", tmp_path / "disk" / "data"
    if there:
        write_measured(recording(3), target)
    link.parent.mkdir()
    link.symlink_to(target)
    assert write_measured(recording(2), link) == link
    assert link.is_symlink()
    assert (target / "periods.csv").read_text().count("day") == 2
    assert [*link.parent.iterdir()] == [link]
    assert [*target.parent.iterdir()] == [target]


@pytest.mark.parametrize(("name", "lose"), [("periods.csv", False), ("detectors.csv", True)])
def test_data_that_somebody_else_measured_or_changed_are_kept(
    tmp_path: Path, name: str, lose: bool
) -> None:
    directory = write_measured(recording(), tmp_path / "street")
    if lose:  # as in a folder made by hand
        (directory / CSV_HASHES).unlink()
    else:
        table = (directory / name).read_text()
        (directory / name).write_text(table.replace("0.0", "1.0", 1))
    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    with pytest.raises(OutputError, match=f"{name} was not written by record or import-atspm"):
        write_measured(recording(3), directory)
    assert {path.name: path.read_bytes() for path in directory.iterdir()} == before


@pytest.mark.parametrize("name", ["detections.parquet", "trajectories.parquet"])
def test_so_are_parquet_tables(tmp_path: Path, name: str) -> None:
    directory = write_measured(recording(), tmp_path / "street")
    pl.DataFrame({"time_s": [1.0]}).write_parquet(directory / name)
    with pytest.raises(OutputError, match=f"{name} was not written by record or import-atspm"):
        write_measured(recording(3), directory)
    assert pl.read_parquet(directory / name)["time_s"].to_list() == [1.0]


def test_a_write_that_fails_leaves_the_old_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = write_measured(recording(2), tmp_path / "street")
    before = {path.name: path.read_bytes() for path in directory.iterdir()}

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pl.DataFrame, "write_parquet", full)
    with pytest.raises(OutputError, match="No space left"):
        write_measured(recording(3), directory)
    assert {path.name: path.read_bytes() for path in directory.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["street"]


def test_reading_leaves_the_files_alone(
    reread: Callable[..., MeasuredData], tmp_path: Path
) -> None:
    reread()
    before = {
        p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in (tmp_path / "street").iterdir()
    }
    scenario = read_scenario(Path(__file__).parents[1] / "fixtures" / "crossing")
    read_measured(tmp_path / "street", scenario, Network.read(scenario))
    after = {
        p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in (tmp_path / "street").iterdir()
    }
    assert after == before


def test_five_busy_periods_are_read_whole(
    tmp_path: Path, crossing_scenario: Scenario, network: Network
) -> None:
    base = recording(5)
    days = tuple(
        replace(p, passages={d.id: vehicles(10 * i + j, 3750) for j, d in enumerate(DETECTORS)})
        for i, p in enumerate(base.periods)
    )
    directory = write_measured(replace(base, periods=days), tmp_path / "street")
    read = read_measured(directory, crossing_scenario, network)
    assert sum(len(p) for day in read.periods for p in day.passages.values()) == 5 * 4 * 3750


def test_the_letters_of_every_traffic_light(crossing_scenario: Scenario) -> None:
    assert signal_widths(crossing_scenario) == {"C": 2}
    assert signal_widths(read_scenario("grid2x2-v1")).keys() == {
        item.id for item in Network.read(read_scenario("grid2x2-v1")).intersections
    }


def replaced(old: str, new: str, count: int = 1) -> Change:
    return lambda text: text.replace(old, new, count)


def added(row: str) -> Change:
    return lambda text: f"{text}{row}\n"


@pytest.mark.parametrize("mark", [";", "\t"])
def test_spreadsheets_of_other_countries(reread: Any, mark: str) -> None:
    """Semicolons or tabs between columns, and commas before decimals."""

    def spreadsheet(text: str) -> str:
        return text.replace(",", mark).replace(".", ",")

    tables = ("detectors", "periods", "signals", "detections")
    changes = {f"{name}.csv": spreadsheet for name in tables}
    assert reread(changes).hash == recording().hash


WRONG: dict[str, tuple[dict[str, Change], str]] = {
    "lane that is not there": (
        {"detectors.csv": replaced("S_C_0", "S_C_1")},
        r"S_C_1.*mean 'S_C_0'",
    ),
    "detector twice": (
        {"detectors.csv": added("a,S_C_0,10,0,stop")},
        r"line 2.*'a' occurs twice .and 1 row more.",
    ),
    "a name no effect can have": (
        {"detectors.csv": added('"a,b",S_C_0,10,0,stop,signals')},
        r"line 6: detector_id 'a,b' has characters that no effect .*leave out commas",
    ),
    **{
        f"the name of a group: {name}": (
            {"detectors.csv": added(f"{name},S_C_0,10,0,stop,signals")},
            rf"line 6: detector_id '{re.escape(name)}' would mean several detectors.*rename it",
        )
        for name in ("*", "stop", "stop@S_C")
    },
    "detector beyond the lane": ({"detectors.csv": replaced("90.0", "900")}, r"position_m 900"),
    "zone beyond the lane": ({"detectors.csv": replaced("40.0,2.0", "40,460")}, r"at most"),
    "unknown kind": ({"detectors.csv": replaced("advance", "advanced")}, r"advance, stop, exit"),
    "text in a number": (
        {"detectors.csv": replaced("40.0", "forty")},
        r"line 2: position_m.*forty",
    ),
    "decimal comma": ({"detectors.csv": replaced("40.0", '"40,5"')}, r"point, not a comma"),
    "decimal commas": (
        {"detectors.csv": lambda text: text.replace(".0,", ",0,")},
        r"line 2: \d+ cells.*decimal",
    ),
    "semicolons and a cell too many": (
        {"detectors.csv": lambda text: text.replace(",", ";").replace("40.0", "40.0;7")},
        r"line 2: \d+ cells",
    ),
    "semicolons under commas": (
        {"signals.csv": lambda text: text.replace(",", ";").replace(";", ",", 3)},
        r"line 2: its cells are separated by ';', and the names in line 1 by ','",
    ),
    "decimal commas under commas": (
        {"signals.csv": lambda text: text.replace(",", ";").replace(".", ",").replace(";", ",", 3)},
        r"line 2: its cells are separated by ';', and the names in line 1 by ','",
    ),
    "commas under semicolons": (
        {"signals.csv": replaced(",", ";", 3)},
        r"line 2: its cells are separated by ',', and the names in line 1 by ';'",
    ),
    "a line for Excel": ({"detectors.csv": lambda text: "sep=,\n" + text}, r"remove it"),
    "no detectors": ({"detectors.csv": lambda text: text.split("\n")[0] + "\n"}, r"no detectors"),
    "column twice": (
        {"detectors.csv": lambda text: text.replace("length_m", "lane_id ", 1)},
        r"column 'lane_id' is there twice",
    ),
    "column twice by one name": (
        {"detectors.csv": lambda text: text.replace("length_m", "lane_id", 1)},
        r"column 'lane_id' is there twice",
    ),
    "column missing": (
        {"periods.csv": replaced("begin_s", "begins")},
        r"'begin_s' \(is it 'begins'",
    ),
    "period twice": ({"periods.csv": added("day0,0,200,fit")}, r"'day0' occurs twice"),
    "period backwards": ({"periods.csv": replaced("0.0,200.0", "200,100")}, r"not after begin_s"),
    "period of another clock": (
        {"periods.csv": replaced("0.0,200.0", "25200,25400")},
        r"begin_s '25200.0' is after the end of the scenario .*--begin-s at that time",
    ),
    "period without demand": ({"periods.csv": replaced("200.0", "900")}, r"demand from 0 s to 200"),
    "unknown split": ({"periods.csv": replaced("heldout", "test")}, r"'test' is unknown"),
    "split for some": ({"periods.csv": replaced("heldout", "")}, r"no split, though others"),
    "all held out": ({"periods.csv": replaced("fit", "heldout", 9)}, r"every period is held out"),
    "no periods": ({"periods.csv": lambda text: text.split("\n")[0] + "\n"}, r"no periods"),
    "empty file": ({"periods.csv": lambda _: ""}, r"empty"),
    "unknown traffic light": (
        {"signals.csv": replaced(",C,", ",D,")},
        r"'D' is not a traffic light",
    ),
    "state of another length": (
        {"signals.csv": replaced("Gr", "Grr")},
        r"3 letters, but.* 2 links",
    ),
    "letters SUMO does not know": ({"signals.csv": replaced("Gr", "GX")}, r"does not know \(X\)"),
    "no signals in a period": (
        {"signals.csv": lambda text: "\n".join(x for x in text.split("\n") if "day1" not in x)},
        r"no signals .* period 'day1'",
    ),
    "no detections in a period": (
        {"detections.csv": lambda text: text[: text.index("day1")]},  # cut short, at a row's end
        r"no detections in period 'day1', 'day2'.*cut short.*leave the period out",
    ),
    "ons alone": (
        {
            "detections.csv": lambda text: "".join(
                line for line in text.splitlines(keepends=True) if ",off," not in line
            )
        },
        r"no detector can be used: of each, more than 50%.*every on and for every off",
    ),
    "unknown event": ({"detections.csv": replaced(",on,", ",enter,")}, r"'enter' is unknown"),
    "negative speed": ({"detections.csv": added("day0,199,s,off,-3,")}, r"-3.0' is negative"),
    "no time": ({"detections.csv": added("day0,,s,off,,")}, r"time_s is empty"),
    "infinite time": ({"detections.csv": added("day0,1e999,s,off,,")}, r"time_s is '1e999'"),
    "no known detector": (
        {"detectors.csv": lambda text: text.replace("\n", "\n9", 4)},
        r"no row is of a detector in detectors.csv.*is",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_with_its_place(
    case: str, reread: Callable[..., MeasuredData]
) -> None:
    changes, message = WRONG[case]
    name = next(iter(changes)) if case != "no known detector" else "detections.csv"
    with pytest.raises(MeasuredDataError, match=f"(?s){name}.*{message}"):
        reread(changes)


@pytest.mark.parametrize("name", ["periods", "detectors", "signals", "detections"])
def test_a_missing_file_is_named(
    name: str, tmp_path: Path, crossing_scenario: Scenario, network: Network
) -> None:
    directory = write_measured(recording(), tmp_path / "street", csv=True)
    (directory / f"{name}.csv").unlink()
    with pytest.raises(MeasuredDataError, match=rf"no {name}\..*there is"):
        read_measured(directory, crossing_scenario, network)


def test_a_directory_that_is_none(
    tmp_path: Path, crossing_scenario: Scenario, network: Network
) -> None:
    with pytest.raises(MeasuredDataError, match="no such directory"):
        read_measured(tmp_path / "nothing", crossing_scenario, network)
    directory = write_measured(recording(), tmp_path / "street")
    (directory / "signals.csv").write_text("period_id\n")
    with pytest.raises(MeasuredDataError, match="both signals.parquet and signals.csv"):
        read_measured(directory, crossing_scenario, network)


def test_damaged_bytes_are_named(
    tmp_path: Path, crossing_scenario: Scenario, network: Network
) -> None:
    directory = write_measured(recording(), tmp_path / "street")
    whole = (directory / "detections.parquet").read_bytes()
    for content, message in (
        (whole[: len(whole) // 2], "cut short"),
        (b"PAR1" + whole[4:-8] + b"\0\0\0\0PAR1", "damaged Parquet"),
        (b"PAR1PAR1", "cut short"),
        (b"something else", "not a Parquet file"),
        (b"", "not a Parquet file"),
    ):
        (directory / "detections.parquet").write_bytes(content)
        with pytest.raises(MeasuredDataError, match=message):
            read_measured(directory, crossing_scenario, network)
    (directory / "detections.parquet").write_bytes(whole)
    for content, message in ((b"a,b\n\0,1\n", "line 2: a NUL"), (b"a,b\n\xff,1\n", "not UTF-8")):
        (directory / "periods.csv").write_bytes(content)
        with pytest.raises(MeasuredDataError, match=message):
            read_measured(directory, crossing_scenario, network)


def test_dates_are_not_seconds_of_the_scenario(
    tmp_path: Path, crossing_scenario: Scenario, network: Network
) -> None:
    directory = write_measured(recording(), tmp_path / "street")
    file = directory / "detections.parquet"
    frame = pl.read_parquet(file)
    frame.with_columns(pl.col("time_s") + 1.7e9).write_parquet(file)
    with pytest.raises(MeasuredDataError, match=r"these are dates; subtract the moment"):
        read_measured(directory, crossing_scenario, network)
    frame.with_columns(pl.from_epoch(pl.col("time_s").cast(pl.Int64))).write_parquet(file)
    with pytest.raises(MeasuredDataError, match="'time_s' has the type Datetime"):
        read_measured(directory, crossing_scenario, network)


def test_numbers_as_names_and_other_column_types_are_understood(
    tmp_path: Path, crossing_scenario: Scenario, network: Network
) -> None:
    base = recording()
    digits = {"a": "11", "s": "12", "w": "13", "x": "14"}
    renamed = replace(
        base,
        detectors=tuple(replace(d, id=digits[d.id]) for d in base.detectors),
        periods=tuple(
            replace(p, passages={digits[d]: v for d, v in p.passages.items()}) for p in base.periods
        ),
    )
    directory = write_measured(renamed, tmp_path / "street")
    file = directory / "detections.parquet"
    frame = pl.read_parquet(file)
    frame.with_columns(
        pl.col("detector_id").cast(pl.Int16),
        pl.col("event").cast(pl.Categorical),
        pl.col("length_m").cast(pl.Float32),
    ).write_parquet(file)
    assert read_measured(directory, crossing_scenario, network).hash == renamed.hash


def test_columns_that_nobody_reads_are_said(reread: Callable[..., MeasuredData]) -> None:
    read = reread({"detections.csv": replaced("speed_mps", "speed_ms")})
    assert "'speed_ms' is not read; if it means 'speed_mps', rename it" in texts(read)
    assert "no speeds" in texts(read)


def in_local_time(zone: str = "") -> dict[str, Change]:
    """Turn the files of a recording to local times; the scenario's clock is 0 at 07:00."""
    offset = "-06:00" if zone else ""

    def stamp(day: str, seconds: str) -> str:
        at = datetime(2024, 3, 5 + int(day[-1]), 7) + timedelta(seconds=float(seconds))
        return at.isoformat(timespec="milliseconds") + offset

    def periods(text: str) -> str:
        head, *rows = text.split()
        ends = [f"2024-03-{5 + i:02d}T07:00:00,{zone}" for i in range(len(rows))]
        return (
            "\n".join([f"{head},zero,time_zone", *map(",".join, zip(rows, ends, strict=True))])
            + "\n"
        )

    def table(text: str) -> str:
        head, *rows = text.split()
        cells = [row.split(",") for row in rows]
        at = head.split(",").index("time_s")
        for row in cells:
            row[at] = stamp(row[0], row[at])
        return "\n".join([head.replace("time_s", "time"), *map(",".join, cells)]) + "\n"

    return {"periods.csv": periods, "signals.csv": table, "detections.csv": table}


@pytest.mark.parametrize("zone", ["", "America/Chicago"])
def test_local_times_become_seconds_of_the_scenario(
    zone: str, reread: Callable[..., MeasuredData]
) -> None:
    assert reread(in_local_time(zone)).hash == recording().hash


@pytest.mark.parametrize(
    ("begin_s", "zero", "way_out"),
    [
        (0.0, ",2024-03-05T07:00:00", "clock is 0: write 2024-03-05 00:00:00, with begin_s 25200 "
         "and end_s 25400"),
        (-60.0, ",2024-03-05T07:00:00", "shorten the period"),
        (0.0, "", "shorten the period"),
    ],
)  # fmt: skip
def test_a_clock_that_is_0_where_the_scenario_begins_is_told(
    begin_s: float, zero: str, way_out: str, tmp_path: Path, crossing_scenario: Scenario,
    network: Network,
) -> None:  # fmt: skip
    times = {"begin_s": 25200.0, "duration_s": 200.0}
    settings = crossing_scenario.settings.model_copy(update=times)
    later = replace(crossing_scenario, settings=settings)
    street = write_measured(recording(1), tmp_path / "street", csv=True)
    head = f"period_id,begin_s,end_s{',zero' if zero else ''}"
    edit(street / "periods.csv", lambda _: f"{head}\nday0,{begin_s},200{zero}\n")
    with pytest.raises(MeasuredDataError, match=f"lies outside the scenario .*{way_out}"):
        read_measured(street, later, network)


@pytest.mark.parametrize(
    ("begin", "end"),
    [
        ("2024-03-05 07:00:00", "2024-03-05 07:01:00"),
        ("2024-03-05 07:00", "2024-03-05 07:01"),
        ("2024-03-05T07:00", "2024-03-05T07:01"),
        ("03/05/2024 07:00", "03/05/2024 07:01"),
        ("05.03.2024 07:00", "05.03.2024 07:01"),
        ("5.3.2024 7:00:00.000", "5.3.2024 7:01:00.000"),
        ('"05.03.2024 07:00:00,000"', '"05.03.2024 07:01:00,000"'),
    ],
)
def test_local_counts_become_seconds(
    reread: Callable[..., MeasuredData], begin: str, end: str
) -> None:
    counts = pl.DataFrame(
        {"period_id": ["day0"], "begin_s": [0.0], "end_s": [60.0], "detector_id": ["s"],
         "count": [7]}
    )  # fmt: skip
    given = replace(recording(), counts=counts)
    local = f"period_id,begin,end,detector_id,count\nday0,{begin},{end},s,7\n"
    changes = {**in_local_time(), "counts.csv": lambda _: local}
    read = reread(changes, given)
    assert read.counts is not None
    assert read.counts.row(0) == ("day0", 0.0, 60.0, "s", 7.0)


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (
            "2024-03-05 07:00,2024-03-05 07:02,s,7",
            "line 3: begin '2024-03-05 07:00' is there twice for its detector; delete the copy",
        ),
        (
            "2024-03-05 07:00,2024-03-05 07:02,s,8",
            "line 2: begin '2024-03-05 07:00' is there twice for its detector (and 1 row more); "
            "correct the row",
        ),
        (
            "2024-03-05 07:01,2024-03-05 07:03,s,7",
            "line 3: begin '2024-03-05 07:01' is before the end of an earlier interval of its "
            "detector, 2024-03-05 07:02; write",
        ),
        (
            "2024-03-05 07:02,2024-03-05 07:01,s,7",
            "line 3: end '2024-03-05 07:01' is not after begin; correct",
        ),
        (
            "2024-03-05 06:59,2024-03-05 07:01,s,7",
            "line 3: begin '2024-03-05 06:59' is before the period's begin; begin and end",
        ),
    ],
)
def test_wrong_local_counts_are_quoted_as_in_the_file(
    reread: Callable[..., MeasuredData], second: str, words: str
) -> None:
    counts = pl.DataFrame(
        {"period_id": ["day0"], "begin_s": [0.0], "end_s": [60.0], "detector_id": ["s"],
         "count": [7]}
    )  # fmt: skip
    head, first = "period_id,begin,end,detector_id,count", "2024-03-05 07:00,2024-03-05 07:02,s,7"
    local = f"{head}\nday0,{first}\nday0,{second}\n"
    changes = {**in_local_time(), "counts.csv": lambda _: local}
    with pytest.raises(MeasuredDataError, match=re.escape(words)):
        reread(changes, replace(recording(), counts=counts))


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("periods.csv", None, "periods.csv does not say when the scenario's clock is"),
        (
            "detections.csv",
            lambda text: in_local_time()["detections.csv"](text).replace("T07:00", " soon", 1),
            r"detections.csv, line \d+: time is '2024-03-05 soon.*; write it in a form such as",
        ),
        (
            "periods.csv",
            lambda text: in_local_time("Chicago")["periods.csv"](text),
            "unknown time_zone 'Chicago'",
        ),
        (
            "periods.csv",
            lambda text: in_local_time()["periods.csv"](text).replace("2024-03-06T07:00:00", ""),
            "line 3: period_id 'day1' has no zero, though others have",
        ),
        (
            "detections.csv",
            lambda text: in_local_time("America/Chicago")["detections.csv"](text),
            r"such as Z or \+01:00; write the street's own time_zone in periods.csv",
        ),
    ],
)
def test_wrong_local_times_are_named(
    name: str, change: Change | None, words: str, reread: Callable[..., MeasuredData]
) -> None:
    changes = in_local_time()
    del changes[name]
    if change is not None:
        changes[name] = change
    with pytest.raises(MeasuredDataError, match=words):
        reread(changes)


@pytest.mark.parametrize(
    "texts",
    [
        ("2024-11-03T06:30:00Z", "2024-11-03T09:30:00Z"),
        ("2024-11-03T00:30:00-06:00", "2024-11-03T02:30:00-07:00"),
    ],
)
def test_times_with_an_offset_lose_no_hour_where_the_clock_is_changed(
    texts: tuple[str, str],
) -> None:
    cells = pl.Series("time", [*texts, ""])
    seconds = clock_from("2024-11-03").seconds(Path("t.csv"), cells, pl.Series(["night"] * 3), 2)
    assert seconds.to_list() == [1800.0, 12600.0, None]


@pytest.mark.parametrize(
    ("texts", "seconds"),
    [
        (["2024-03-04", "2024-03-04 00:00:07.5"], [0.0, 7.5]),  # pandas leaves midnight out
        (["2024-03-04 00:00:07+00", "2024-03-04 01:00:08 +0100"], [7.0, 8.0]),
        (["2024-03-04", "2024-03-04T00:00:09"], [0.0, 9.0]),
        (["2024-03-04T00:01Z", "2024-03-03T17:02-07:00"], [60.0, 120.0]),
        (["3/4/2024 12:03 AM", "3/4/2024 1:00 PM"], [180.0, 46800.0]),
        (["2024-03-04 7:00 AM", "2024-03-04 12:01am"], [25200.0, 60.0]),
        (["4.3.2024 7:00:00.5 AM", "4.3.2024 12:00:01 PM", ""], [25200.5, 43201.0, None]),
    ],
)
def test_forms_of_other_programs_are_read(texts: list[str], seconds: list[float | None]) -> None:
    zero = pl.Series("zero", ["2024-03-04 00:00:00"])
    clock = LocalClock.of(Path("periods.csv"), pl.Series(["day"]), pl.Series([0.0]), zero, "UTC")
    cells, periods = pl.Series("time", texts), pl.Series(["day"] * len(texts))
    assert clock.seconds(Path("t.csv"), cells, periods, 2).to_list() == seconds


def test_a_column_of_dates_alone_has_no_times() -> None:
    cells = pl.Series("time", ["2024-03-04", "2024-03-05"])
    with pytest.raises(MeasuredDataError, match="line 2: time is '2024-03-04'; write it in"):
        clock_from("2024-03-04").seconds(Path("t.csv"), cells, pl.Series(["night"] * 2), 2)


def test_a_second_column_of_times_is_named(reread: Callable[..., MeasuredData]) -> None:
    def twice(text: str) -> str:
        head, *rows = text.splitlines()
        return "\n".join([f"{head},time", *(f"{row},x" for row in rows)]) + "\n"

    read = reread({"detections.csv": twice})
    assert any("column 'time' is not read" in finding.text for finding in read.findings)


def test_a_column_in_which_some_times_have_offsets_is_told() -> None:
    cells = pl.Series("time", ["2024-03-04 07:00:03.6+01:00", "2024-03-04 07:00:03.6"])
    with pytest.raises(MeasuredDataError, match=r"line 3: .*; other times of the column have an"):
        clock_from("2024-03-04").seconds(Path("t.csv"), cells, pl.Series(["night"] * 2), 2)


def clock_from(*zeros: str, begin_s: float = 0.0) -> LocalClock:
    """The clock of nights in Denver that is 0 at these times; one of them is called night."""
    names = ["night", "next"][: len(zeros)]
    times = [zero + " 00:00:00" * (len(zero) == 10) for zero in zeros]
    path, begins_s = Path("periods.csv"), pl.Series([begin_s] * len(zeros))
    return LocalClock.of(
        path, pl.Series(names), begins_s, pl.Series("zero", times), "America/Denver"
    )


@pytest.mark.parametrize(("offset", "second"), [("-06:00", 10.0), ("-07:00", 10.0)])
def test_a_zero_within_the_hour_that_comes_twice_keeps_its_offset(
    offset: str, second: float
) -> None:
    clock = clock_from(f"2024-11-03T01:30:00{offset}")
    cells = pl.Series("time", [f"2024-11-03T01:30:10{offset}"])
    assert clock.seconds(Path("t.csv"), cells, pl.Series(["night"]), 2).to_list() == [second]


@pytest.mark.parametrize(
    ("day", "offset"),
    [("2024-03-09", "-07:00"), ("2024-03-10", "-06:00"), ("2024-11-03", "-07:00")],
)
@pytest.mark.parametrize("begin_s", [5 * 3600.0, 7 * 3600.0])
def test_a_day_is_that_of_the_local_clock_also_where_it_was_changed(
    day: str, offset: str, begin_s: float
) -> None:
    """The clock was set forward on 10 March and back on 3 November, at two."""
    for text in (f"{day} 07:30:00", f"{day} 07:30:00{offset}"):
        cells, night = pl.Series("time", [text]), pl.Series(["night"])
        seconds = clock_from(day, begin_s=begin_s).seconds(Path("t.csv"), cells, night, 2)
        assert seconds.to_list() == [27000.0]


def test_each_zero_may_have_an_offset_or_none() -> None:
    clock = clock_from("2024-11-03T01:30:00-07:00", "2024-11-04")
    cells = pl.Series("time", ["2024-11-03T08:30:10Z", "2024-11-04T07:00:10Z"])
    nights = pl.Series(["night", "next"])
    assert clock.seconds(Path("t.csv"), cells, nights, 2).to_list() == [10.0, 10.0]


@pytest.mark.parametrize(
    ("zero", "begin_s", "says"),
    [
        ("2024-11-03T01:30:00", 0.0, "showed twice, as they were set back; write zero with its"),
        ("2024-11-03", 5400.0, "2024-11-03 01:30:00, which clocks in America/Denver showed twice"),
        ("2024-03-10 02:30:00", 0.0, "csv, line 2: zero is 2024-03-10 02:30:00.* did not show"),
    ],
)
def test_a_begin_that_clocks_showed_twice_or_never_needs_an_offset_if_times_have_one(
    zero: str, begin_s: float, says: str
) -> None:
    clock, night = clock_from(zero, begin_s=begin_s), pl.Series(["night"])
    local = pl.Series("time", [zero + " 00:00:00" * (len(zero) == 10)])
    assert clock.seconds(Path("t.csv"), local, night, 2).to_list() == [0.0]
    with pytest.raises(MeasuredDataError, match=says):
        clock.seconds(Path("t.csv"), pl.Series("time", ["2024-11-03T08:30:10Z"]), night, 2)


def test_a_zero_before_all_dates_is_an_error() -> None:
    with pytest.raises(MeasuredDataError, match="line 2: zero is too early or too late for a date"):
        clock_from("0001-01-01T00:00:00+07:00")


@pytest.mark.parametrize(
    ("name", "row", "says"),
    [
        ("lanes", "10,{lane},2,9", "halting '9.0' is more than there are vehicles"),
        ("lanes", "10,{lane},5000,0", "vehicles '5000.0' is more than the lane has room for"),
        ("lanes with speeds", "10,{lane},2,1,80", "mean_speed_mps '80.0' is more than 70 m/s"),
        ("trajectories", "v,10,{lane},99999,5", "position_m '99999.0' is beyond the end of"),
        ("trajectories", "v,10,{lane},50,900", "speed_mps '900.0' is more than 70 m/s"),
        ("tracks with lengths", "v,10,{lane},50,9,450", "length_m '450.0' is not above 0 and up"),
        ("tracks with lengths", "v,10,{lane},50,9,0", "length_m '0.0' is not above 0 and up to"),
    ],
)
def test_moments_that_no_street_shows_are_refused(
    name: str, row: str, says: str, tmp_path: Path
) -> None:
    scenario = load_scenario("single-v1")
    network = Network.read(scenario)
    lane = network.intersections[0].incoming_lanes[0]
    columns = {
        "lanes": "period_id,time_s,lane_id,vehicles,halting",
        "lanes with speeds": "period_id,time_s,lane_id,vehicles,halting,mean_speed_mps",
        "trajectories": "period_id,vehicle_id,time_s,lane_id,position_m,speed_mps",
        "tracks with lengths": "period_id,vehicle_id,time_s,lane_id,position_m,speed_mps,length_m",
    }
    table = tables.LANES if name.startswith("lanes") else tables.TRAJECTORIES
    path = tmp_path / f"{name}.csv"
    path.write_text(f"{columns[name]}\np,{row.format(lane=lane)}\n")
    files: Any = SimpleNamespace(
        has=lambda _: True, findings=[], rows=lambda _: (path, tables.read_table(path, table, []))
    )
    with pytest.raises(MeasuredDataError, match=rf"line 2: {re.escape(says)}"):
        _of_moments(files, table, (Period("p", 0.0, 600.0, "fit", {}, {}),), network)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("timestamp", r"no column 'time' \(is it 'timestamp'\?\); it has .*, and needs .*, time, "),
        ("time_s", "time_s holds local times, such as '2024-03-05T07:00:.*'; name the column time"),
    ],
)
def test_a_column_of_local_times_is_called_time(
    name: str, says: str, reread: Callable[..., MeasuredData]
) -> None:
    changes = in_local_time()
    local = changes["detections.csv"]
    changes["detections.csv"] = lambda text: local(text).replace("time", name, 1)
    with pytest.raises(MeasuredDataError, match=says):
        reread(changes)


def test_decimal_commas_before_an_offset_are_read(
    reread: Callable[..., MeasuredData], tmp_path: Path
) -> None:
    def comma(text: str) -> str:
        return re.sub(r"\.(\d+)(?=-06:00)", r",\1", text.replace(",", ";"))

    changes = in_local_time("America/Chicago")
    plain = reread(changes)
    shutil.rmtree(tmp_path / "street")
    tables = {
        name: (lambda text, name=name: comma(changes[name](text)))
        for name in ("detections.csv", "signals.csv")
    }
    again = reread({**changes, **tables})
    assert again.hash == plain.hash
