"""Sums of intervals, turning counts and travel times: read, or refused in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.data.measured_fuzz_test import recording
from ugat_marl.data import CSV_HASHES, MeasuredData, as_counts, read_measured, write_measured
from ugat_marl.data.measured.coverage import COUNTABLE, SUMMED
from ugat_marl.effects import known_effects
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import Detector, Network, Passages, Period, Scenario


def sums() -> MeasuredData:
    """Sums of 50 s of a recording, with a turn and a way of probes."""
    whole = as_counts(recording(), 50.0)
    assert whole.counts is not None
    turns = whole.counts.filter(pl.col("detector_id") == "a").select(
        "period_id", "begin_s", "end_s", pl.lit("S_C").alias("from_edge"),
        pl.lit("C_N").alias("to_edge"), "count",
    )  # fmt: skip
    times = turns.select(
        "period_id", pl.col("begin_s").alias("time_s"), "from_edge", pl.lit(5.0).alias("from_m"),
        "to_edge", pl.lit(90.0).alias("to_m"), pl.lit(40.0).alias("travel_s"),
    )  # fmt: skip
    return replace(whole, turning=turns, travel_times=times)


def test_sums_of_passages_by_hand() -> None:
    """A vehicle counts where its front arrives; one that was there before, where it leaves."""
    seen = Passages(
        np.array([np.nan, 10.0, 20.0, 39.0, 48.0]),
        np.array([3.0, 12.0, 21.0, 42.0, np.nan]),
        np.array([np.nan, 10.0, np.nan, 6.0, 8.0]),
        np.full(5, 4.0),
    )
    detectors = (Detector("a", "S_C_0", 440.0, 2.0, "advance"),)
    day = Period("day", 0.0, 50.0, "fit", {}, {"a": seen})
    counts = as_counts(MeasuredData(detectors, (day,)), 20.0).counts
    assert counts is not None
    assert counts.drop("period_id", "detector_id").rows() == [
        (0.0, 20.0, 2.0, 0.25, 10.0),
        (20.0, 40.0, 2.0, 0.1, 6.0),
        (40.0, 50.0, 1.0, 0.4, 8.0),
    ]


@pytest.fixture
def written(tmp_path: Path) -> Path:
    return write_measured(sums(), tmp_path / "street", csv=True)


def test_what_is_written_is_what_is_read(
    written: Path, scenario: Scenario, network: Network
) -> None:
    before, after = sums(), read_measured(written, scenario, network)
    assert after.hash == before.hash
    assert after.counts is not None and after.turning is not None
    assert after.counts.columns[-2:] == ["occupancy", "mean_speed_mps"]
    assert not after.has_events


def test_counts_without_speeds_keep_their_hash(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    given = sums()
    assert given.counts is not None
    bare = replace(given, counts=given.counts.with_columns(mean_speed_mps=pl.lit(None, pl.Float64)))
    after = read_measured(write_measured(bare, tmp_path / "bare", csv=True), scenario, network)
    assert after.hash == bare.hash != given.hash


def test_counts_without_the_new_columns_keep_their_hash(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    given = sums()
    assert given.counts is not None
    bare = replace(given, counts=given.counts.drop("occupancy", "mean_speed_mps"))
    after = read_measured(write_measured(bare, tmp_path / "bare", csv=True), scenario, network)
    assert after.counts is not None
    assert after.counts.columns == ["period_id", "begin_s", "end_s", "detector_id", "count"]
    assert after.hash == bare.hash


@pytest.mark.parametrize(
    ("file", "column", "value", "message"),
    [
        (
            "counts",
            "occupancy",
            "12.5",
            "occupancy '12.5' is not a share of time from 0 to 1; divide",
        ),
        (
            "counts",
            "count",
            "3e10",
            "more than one vehicle per second and lane; write the vehicles",
        ),
        ("counts", "count", "600", "not vehicles per hour"),
        ("counts", "occupancy", "-0.1", "is not a share of time"),
        ("counts", "occupancy", "many", "occupancy is 'many'"),
        ("counts", "mean_speed_mps", "88", "is not a speed from 0 to 70 m/s; multiply miles"),
        ("counts", "mean_speed_mps", "-1", "is not a speed"),
        ("turning", "from_edge", "S_X", "is not an edge of the network; did you mean 'S_C'"),
        ("turning", "to_edge", "C_E", "no vehicle can turn from 'S_C' to 'C_E' at a traffic light"),
        ("turning", "from_edge", "C_N", "'C_N' leads to no traffic light"),
        ("turning", "count", "1.5", "is not a whole number"),
        ("turning", "count", "9000", "is more than one vehicle per second and lane; write the"),
        ("turning", "period_id", "day9", "is not listed in periods.csv"),
        ("turning", "end_s", "0", "is not after begin_s"),
        ("travel_times", "to_edge", "X_Y", "is not an edge of the network"),
        ("travel_times", "from_m", "9000", "lies beyond its from_edge; write the distance"),
        ("travel_times", "to_m", "-1", "lies beyond its to_edge"),
        ("travel_times", "travel_s", "0", "is not above 0; write the time"),
        ("travel_times", "travel_s", "0.67", "is shorter than at 70 m/s; write seconds, not min"),
    ],
)
def test_impossible_rows_are_refused_with_their_place_and_the_way_out(
    file: str, column: str, value: str, message: str, written: Path, scenario: Scenario,
    network: Network,
) -> None:  # fmt: skip
    (written / CSV_HASHES).unlink()
    path = written / f"{file}.csv"
    frame = pl.read_csv(path, infer_schema=False).with_columns(
        pl.when(pl.int_range(pl.len()) == 2).then(pl.lit(value)).otherwise(column).alias(column)
    )
    frame.write_csv(path)
    with pytest.raises(MeasuredDataError) as refusal:
        read_measured(written, scenario, network)
    text = str(refusal.value)
    assert message in text
    assert f"{file}.csv, line 4" in text
    assert "\n" not in text


@pytest.mark.parametrize("column", ["occupancy", "mean_speed_mps"])
def test_a_column_of_zeros_was_not_measured(
    column: str, written: Path, scenario: Scenario, network: Network
) -> None:
    (written / CSV_HASHES).unlink()
    path = written / "counts.csv"
    whole = pl.read_csv(path)
    whole.with_columns(pl.lit(0.0).alias(column)).write_csv(path)
    with pytest.raises(MeasuredDataError, match=f"{column} '0.0' is 0 wherever vehicles were"):
        read_measured(written, scenario, network)
    quiet = whole.with_columns(pl.lit(0.0).alias("occupancy"), count=1)
    quiet.write_csv(path)  # a vehicle in five minutes occupies no whole percent of them
    read_measured(written, scenario, network)
    number = pl.int_range(pl.len())
    few = pl.when(number % 2 == 0).then(0.0).otherwise(column)
    whole.with_columns(few.alias(column)).write_csv(path)
    read_measured(written, scenario, network)
    one = pl.when(number == pl.col("count").arg_max()).then(0.0)  # all others are empty
    rare = pl.when(number == pl.col("count").arg_max()).then(1).otherwise("count")
    whole.with_columns(one.alias(column), rare.alias("count")).write_csv(path)
    read_measured(written, scenario, network)


def test_a_turn_that_is_there_twice_is_refused(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    given = sums()
    assert given.turning is not None
    twice = replace(given, turning=pl.concat([given.turning, given.turning.head(1)]))
    with pytest.raises(MeasuredDataError, match="is there twice for its turn"):
        read_measured(write_measured(twice, tmp_path / "twice", csv=True), scenario, network)


@pytest.mark.parametrize(("file", "owner"), [("counts", "detector"), ("turning", "turn")])
def test_intervals_that_overlap_are_refused(
    file: str, owner: str, tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    given = sums()
    table: pl.DataFrame = getattr(given, file)
    first = table.row(0, named=True)
    begin, end = first["begin_s"], first["end_s"]
    third = (end - begin) / 3
    within = table.head(1).with_columns(begin_s=begin + third, end_s=begin + 2 * third)
    wrong = replace(given, **{file: pl.concat([table, within])})
    message = (
        rf"{file}\.csv, line {table.height + 2}: begin_s '[\d.]+' is before the end of an earlier "
        rf"interval of its {owner}, {end:g} s; write intervals that do not overlap"
    )
    with pytest.raises(MeasuredDataError, match=message):
        read_measured(write_measured(wrong, tmp_path / "wrong", csv=True), scenario, network)
    shuffled = replace(given, **{file: table.reverse()})
    read = read_measured(write_measured(shuffled, tmp_path / "right", csv=True), scenario, network)
    assert getattr(read, file).height == table.height


def ruled_out(measured: MeasuredData) -> set[str]:
    return {name for finding in measured.findings for name in finding.rules_out}


@pytest.mark.parametrize("missing", ["occupancy", "mean_speed_mps"])
def test_findings_say_what_one_more_kind_of_data_would_decide(
    missing: str, tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    given = replace(sums(), travel_times=None)
    assert given.counts is not None

    def read(measured: MeasuredData, name: str) -> MeasuredData:
        written = write_measured(measured, tmp_path / name, csv=True)
        return read_measured(written, scenario, network)

    bare = replace(given, counts=given.counts.drop("occupancy", "mean_speed_mps"))
    only = read(bare, "counts")
    assert not ruled_out(only) & set(COUNTABLE)
    assert set(SUMMED) <= ruled_out(only)
    text = next(x.text for x in only.findings if x.text.startswith("counts only"))
    assert "with occupancy or mean_speed_mps in counts.csv also" in text
    probes = sums().travel_times
    assert probes is not None
    columns = (
        pl.lit(None, pl.Float64).alias("occupancy"),
        pl.lit(None, pl.Float64).alias("mean_speed_mps"),
    )
    blank = replace(bare, counts=given.counts.with_columns(columns), travel_times=probes.clear())
    assert ruled_out(read(blank, "blank")) == ruled_out(only), "tables without a value tell nothing"
    half = read(replace(given, counts=given.counts.drop(missing)), "half")
    word = missing.removesuffix("_mps").replace("_", " ")
    assert any(f"counts.csv: no {word};" in x.text for x in half.findings)
    assert "desired_speed" not in ruled_out(half)
    assert "turning" not in ruled_out(half), "turning counts stand where exit detectors would"
    read_off_signals = {"yellow_time", "all_red_time"}
    examined = {*COUNTABLE, *SUMMED, *read_off_signals}
    assert set(known_effects()) - examined <= ruled_out(half)
    assert not read_off_signals & ruled_out(half)


def test_counts_of_a_longer_time_are_cut(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    given = sums()
    counts = given.counts
    assert counts is not None
    length = float(given.periods[0].length_s)
    moved = [
        counts.with_columns(pl.col("begin_s") + k * length, pl.col("end_s") + k * length)
        for k in range(4)
    ]
    longer = replace(given, counts=pl.concat(moved))
    read = read_measured(write_measured(longer, tmp_path / "long", csv=True), scenario, network)
    assert read.counts is not None and len(read.counts) == len(counts)
    assert any("lie outside of their periods" in finding.text for finding in read.findings)


def test_mistaken_hours_of_probes_are_seen(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    given = sums()
    assert given.travel_times is not None
    late = replace(given, travel_times=given.travel_times.with_columns(pl.col("time_s") + 3600.0))
    with pytest.raises(MeasuredDataError, match="lie outside of it"):
        read_measured(write_measured(late, tmp_path / "late", csv=True), scenario, network)


def test_mean_speeds_that_nobody_drives_are_named(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    given = as_counts(recording(), 10.0)
    assert given.counts is not None and given.counts.height > 60
    for speed_mps, named in ((9.0, False), (9.0 * 3.6, True)):
        counts = given.counts.with_columns(mean_speed_mps=pl.lit(speed_mps))
        data = replace(given, counts=counts)
        read = read_measured(write_measured(data, tmp_path / str(named)), scenario, network)
        texts = [finding.text for finding in read.findings]
        assert any("mean_speed_mps is above" in text for text in texts) == named, texts


@pytest.mark.parametrize(("factor", "named"), [(1, False), (3, True)])
def test_vehicles_per_hour_in_place_of_counts_are_named(
    tmp_path: Path, scenario: Scenario, network: Network, factor: int, named: bool
) -> None:
    given = as_counts(recording(), 10.0)
    assert given.counts is not None
    counts = given.counts.with_columns(count=pl.int_range(pl.len()) % 7 // 2 * factor)
    data = replace(given, counts=counts.with_columns(occupancy=None, mean_speed_mps=None))
    read = read_measured(write_measured(data, tmp_path / "street"), scenario, network)
    texts = [finding.text for finding in read.findings]
    assert any("every count is a multiple of 3;" in text for text in texts) == named, texts
