"""What is softer than an error: findings on planted faults of a recording, and what they rule out.

The recordings are made by hand on the crossing of tests/data, two hours long.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import (
    CSV_HASHES,
    Finding,
    MeasuredData,
    is_actuated,
    read_measured,
    split_periods,
    write_measured,
)
from ugat_marl.data.measured import coverage
from ugat_marl.data.measured.tables import read_raw
from ugat_marl.effects import known_effects
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import (
    Detector,
    Network,
    Passages,
    Period,
    Scenario,
    SignalLog,
    read_scenario,
)

END = 7200.0
DETECTORS = (
    Detector("a", "S_C_0", 440.0, 0.0, "advance", clock="signals"),
    Detector("s", "S_C_0", 487.0, 0.0, "stop", clock="signals"),
    Detector("w", "W_C_0", 487.0, 0.0, "stop", clock="signals"),
    Detector("x", "C_N_0", 5.0, 0.0, "exit", clock="signals"),
)
Rows = Callable[[pl.DataFrame], pl.DataFrame]


@pytest.fixture(scope="module")
def scenario(data: Path) -> Scenario:
    return read_scenario(data / "crossing").with_duration(END)


def vehicles(seed: int, every: float = 20.0) -> Passages:
    """A vehicle about every 20 s, each on the detector for a second."""
    rng = np.random.default_rng(seed)
    on = np.round(
        np.arange(1, END - 3, every) + rng.uniform(0, every - 4, len(np.arange(1, END - 3, every))),
        3,
    )
    on = on[on < END - 2]
    return Passages(on, np.round(on + 1, 3), np.full(len(on), 8.0), np.full(len(on), 5.0))


def recording(periods: int = 3, **changes: object) -> MeasuredData:
    signals = {"C": tuple((20.0 * i, ("Gr", "rG")[i % 2]) for i in range(int(END / 20)))}
    days = tuple(
        Period(
            f"day{i}",
            0.0,
            END,
            split,
            signals,
            {d.id: vehicles(10 * i + j) for j, d in enumerate(DETECTORS)},
        )
        for i, split in enumerate(split_periods(periods))
    )
    return replace(MeasuredData(DETECTORS, days), **changes)  # pyright: ignore[reportArgumentType]


def passages(
    measured: MeasuredData, detector: str, change: Callable[[Passages], Passages]
) -> MeasuredData:
    """The recording with other vehicles over a detector."""
    days = tuple(
        replace(p, passages={**p.passages, detector: change(p.passages[detector])})
        for p in measured.periods
    )
    return replace(measured, periods=days)


def without(measured: MeasuredData, kind: str) -> MeasuredData:
    """The recording without the detectors of a kind."""
    kept = tuple(item for item in measured.detectors if item.kind != kind)
    names = {item.id for item in kept}
    days = tuple(
        replace(p, passages={n: v for n, v in p.passages.items() if n in names})
        for p in measured.periods
    )
    return replace(measured, detectors=kept, periods=days)


@pytest.fixture
def read(
    tmp_path: Path, scenario: Scenario, network: Network
) -> Callable[..., tuple[MeasuredData, dict[str, tuple[str, ...]]]]:
    """Writes a recording, changes the rows of its files, reads it: data, and findings by text."""

    def reading(
        given: MeasuredData | None = None, changes: Mapping[str, Rows] | None = None
    ) -> tuple[MeasuredData, dict[str, tuple[str, ...]]]:
        shutil.rmtree(tmp_path / "street", ignore_errors=True)  # changed below, and not replaced
        directory = write_measured(given or recording(), tmp_path / "street")
        for name, change in (changes or {}).items():
            file = directory / f"{name}.parquet"
            change(pl.read_parquet(file)).write_parquet(file)
        found = read_measured(directory, scenario, network)
        return found, {item.text: item.rules_out for item in found.findings}

    return reading


def only(findings: Mapping[str, tuple[str, ...]], *words: str) -> tuple[str, ...]:
    """What the one finding with these words rules out; there must be no other."""
    assert len(findings) == 1, list(findings)
    text = next(iter(findings))
    assert all(word in text for word in words), text
    return findings[text]


Read = Callable[..., tuple[MeasuredData, dict[str, tuple[str, ...]]]]


def test_a_whole_recording_has_no_findings(read: Read) -> None:
    assert read()[1] == {}


def of(detector: str, day: str = "day0") -> pl.Expr:
    return (pl.col("detector_id") == detector) & (pl.col("period_id") == day)


def numbered(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.with_row_index("n")


def test_rows_in_any_order_are_sorted(read: Read) -> None:
    found, findings = read(
        changes={"detections": lambda f: f.sample(fraction=1, shuffle=True, seed=1)}
    )
    assert found.hash == recording().hash
    only(findings, "detections.parquet", "are earlier than the row before them; they were sorted")


def test_detectors_one_after_the_other_are_in_order(read: Read) -> None:
    found, findings = read(
        changes={"detections": lambda f: f.sort("detector_id", "period_id", maintain_order=True)}
    )
    assert found.hash == recording().hash
    assert findings == {}


def test_ons_and_offs_may_be_exported_one_after_the_other(read: Read) -> None:
    ons = pl.col("event") == "on"
    found, findings = read(
        changes={"detections": lambda f: pl.concat([f.filter(ons), f.filter(~ons)])}
    )
    assert found.hash == recording().hash
    only(findings, "sorted")


def test_rows_that_are_there_twice_count_once(read: Read) -> None:
    found, findings = read(changes={"detections": lambda f: pl.concat([f, f.head(100)])})
    assert found.hash == recording().hash
    assert any("100 of" in text and "twice" in text for text in findings)


@pytest.mark.parametrize("jump", [3600.0, 600.0])
def test_a_clock_set_back_is_an_error(read: Read, jump: float) -> None:
    def back(frame: pl.DataFrame) -> pl.DataFrame:
        late = pl.col("time_s") > 5000
        return frame.with_columns(
            pl.when(late).then(pl.col("time_s") - jump).otherwise("time_s").alias("time_s")
        )

    with pytest.raises(MeasuredDataError, match=r"steps back by [\d.]+ s.*occur twice"):
        read(changes={"detections": back})
    with pytest.raises(MeasuredDataError, match=r"traffic light 'C'.* steps back"):
        read(changes={"signals": back})


def test_a_clock_set_back_is_an_error_beside_late_rows(read: Read) -> None:
    """Each stream has a row that was delivered late, before its clock was set back."""

    def back(frame: pl.DataFrame) -> pl.DataFrame:
        late = pl.col("time_s") > 5000
        frame = frame.with_columns(
            pl.when(late).then(pl.col("time_s") - 3600).otherwise("time_s").alias("time_s")
        )
        order = pl.int_range(pl.len()) + 1.5 * (pl.int_range(pl.len()) == 4)
        return frame.sort(order.over("detector_id", "event"), maintain_order=True)

    with pytest.raises(MeasuredDataError, match=r"steps back by [\d.]+ s.*occur twice"):
        read(changes={"detections": back})


def moved(frame: pl.DataFrame, choice: pl.Expr, later_s: float) -> pl.DataFrame:
    """The rows as a logger writes them that delivers the chosen ones late."""
    return frame.sort(
        "period_id", pl.col("time_s") + later_s * choice.cast(pl.Float64), maintain_order=True
    )


@pytest.mark.parametrize("rows", [[40], [40, 200]])
def test_rows_that_are_delivered_late_are_sorted(rows: list[int], read: Read) -> None:
    ons = of("s") & (pl.col("event") == "on")
    choice = ons & (ons.cum_sum().over("period_id")).is_in(rows)
    found, findings = read(changes={"detections": lambda f: moved(f, choice, 75.0)})
    assert found.hash == recording().hash
    only(findings, f"{len(rows)} rows are earlier than the row before them; they were sorted")


@pytest.mark.parametrize("packets", [[(40, 45)], [(40, 45), (200, 230)]])
def test_packets_that_are_delivered_late_are_sorted(
    packets: list[tuple[int, int]], read: Read
) -> None:
    ons = of("s") & (pl.col("event") == "on")
    number = ons.cum_sum().over("period_id")
    delivered_s = pl.col("time_s")
    for ends in packets:
        packet = ons & number.is_between(*ends)
        end_s = pl.col("time_s").filter(packet).max().over("period_id")
        delivered_s = pl.when(packet).then(end_s + 75.0).otherwise(delivered_s)
    found, findings = read(
        changes={"detections": lambda f: f.sort("period_id", delivered_s, maintain_order=True)}
    )
    assert found.hash == recording().hash
    only(findings, f"{len(packets)} rows are earlier than the row before them; they were sorted")


def test_a_clock_set_back_shortly_before_the_end_is_an_error(read: Read) -> None:
    """Two rows of each stream follow."""

    def back(frame: pl.DataFrame) -> pl.DataFrame:
        left = pl.int_range(pl.len(), 0, -1).over("period_id", "detector_id", "event")
        moved = pl.when(left <= 2).then(pl.col("time_s") - 1800).otherwise("time_s")
        return frame.with_columns(moved.alias("time_s"))

    with pytest.raises(MeasuredDataError, match=r"steps back by [\d.]+ s.*occur twice"):
        read(changes={"detections": back})


def test_a_header_that_is_too_long_is_no_table(tmp_path: Path) -> None:
    path = tmp_path / "periods.csv"
    path.write_text("x" * 140_000 + ",b\n1,2\n")
    with pytest.raises(MeasuredDataError, match="not a table"):
        read_raw(path, [])


def test_columns_of_lists_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "signals.parquet"
    pl.DataFrame({"time_s": [1.0], "other": [[0] * 10]}).write_parquet(path)
    with pytest.raises(MeasuredDataError, match="column 'other' holds lists"):
        read_raw(path, [])


def test_a_pipe_is_no_table(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "periods.csv")
    with pytest.raises(MeasuredDataError, match="is a pipe"):
        read_raw(tmp_path / "periods.csv", [])


def test_a_clock_that_starts_again_from_zero_is_an_error(read: Read) -> None:
    zero = pl.when(pl.col("time_s") > 4000).then(pl.col("time_s") - 4000).otherwise("time_s")
    with pytest.raises(MeasuredDataError, match="steps back by"):
        read(changes={"detections": lambda f: f.with_columns(zero.alias("time_s"))})


def test_two_pieces_in_the_wrong_order_are_put_right(read: Read) -> None:
    late = pl.col("time_s") > 3000
    found, findings = read(
        changes={"detections": lambda f: pl.concat([f.filter(late), f.filter(~late)])}
    )
    assert found.hash == recording().hash
    only(findings, "sorted")


def test_a_clock_set_ahead_leaves_a_hole(read: Read) -> None:
    hole = (pl.col("time_s") > 3000) & (pl.col("time_s") < 4800)
    _, findings = read(changes={"detections": lambda f: f.filter(~hole)})
    assert len(findings) == 3
    assert all("no detector says anything for 30 min" in text for text in findings)


def test_a_short_hole_shows_where_it_was_busy(read: Read) -> None:
    def without(begin: float, end: float) -> list[str]:
        hole = (pl.col("time_s") > begin) & (pl.col("time_s") < end)
        found = read(changes={"detections": lambda f: f.filter(~hole)})[1]
        return [text for text in found if "no detector says anything" in text]

    assert len(found := without(3000, 3300)) == 3
    assert all(text.endswith("A diagnosis leaves this time out of all periods") for text in found)
    assert not without(3000, 3120), "a red may last that long"
    twice = without(3000, 3300), without(4500, 4900)
    both = read(
        changes={
            "detections": lambda f: f.filter(
                ~((pl.col("time_s") > 3000) & (pl.col("time_s") < 3300))
                & ~((pl.col("time_s") > 4500) & (pl.col("time_s") < 4900))
            )
        }
    )[1]
    assert len([text for text in both if "no detector says anything" in text]) == sum(
        map(len, twice)
    )
    assert not without(0, 300), "the streets may have been empty before"


def test_a_few_rows_outside_of_their_period_are_left_out(read: Read) -> None:
    def outside(frame: pl.DataFrame) -> pl.DataFrame:
        extra = frame.head(4).with_columns(pl.col("time_s") + END)
        return pl.concat([frame, extra])

    found, findings = read(changes={"detections": outside})
    assert found.hash == recording().hash
    only(findings, "4 of", "outside of their periods ('day0')")
    with pytest.raises(MeasuredDataError, match="rows of period 'day0' lie outside"):
        read(changes={"detections": lambda f: f.with_columns(pl.col("time_s") + END)})


@pytest.mark.parametrize(
    ("moved_s", "told"),
    [
        (5 * 3600.0, "seems to be 5 hours late: is it in another time zone, such as UTC"),
        (-3 * 3600.0, "seems to be 3 hours early"),
        (20 * 3600.0, "or is the period too short"),
        (-24 * 3600.0, "seems to be 1 day early: is the date of the period's zero right"),
        (7 * 24 * 3600.0, "seems to be 7 days late"),
    ],
)
def test_a_log_on_another_clock_is_refused_with_a_guess(
    read: Read, moved_s: float, told: str
) -> None:
    with pytest.raises(MeasuredDataError, match=told):
        read(changes={"detections": lambda f: f.with_columns(pl.col("time_s") + moved_s)})


def test_a_log_longer_than_its_period_is_cut(read: Read) -> None:
    def longer(frame: pl.DataFrame) -> pl.DataFrame:
        day = [frame.with_columns(pl.col("time_s") + k * END) for k in (-2, -1, 0, 1)]
        return pl.concat(day)

    found, findings = read(changes={"detections": longer})
    assert found.hash == recording().hash
    assert any("lie outside of their periods" in text for text in findings)


def test_rows_of_other_periods_and_detectors_are_left_out(read: Read) -> None:
    def more(frame: pl.DataFrame) -> pl.DataFrame:
        other = frame.head(6).with_columns(pl.lit("day9").alias("period_id"))
        stray = frame.head(8).with_columns(pl.lit("spare").alias("detector_id"))
        return pl.concat([frame, other, stray])

    found, findings = read(changes={"detections": more})
    assert found.hash == recording().hash
    assert any("6 rows are of periods" in text and "'day9'" in text for text in findings)
    assert any("8 rows are of detectors" in text and "'spare'" in text for text in findings)


def test_two_ons_within_two_seconds_are_two_vehicles(read: Read) -> None:
    # 10.0 on, (off lost), 11.5 on, 12.0 off: the first vehicle ends where the second begins.
    rows = Passages(
        np.array([10.0, 11.5, 30.0]), np.array([11.0, 12.0, 31.0]), np.full(3, 8.0), np.full(3, 5.0)
    )
    given = passages(recording(), "s", lambda _: rows)
    lost = of("s") & (pl.col("time_s") == 11.0)
    found, findings = read(given, {"detections": lambda f: f.filter(~lost)})
    first = found.periods[0].passages["s"]
    np.testing.assert_array_equal(first.on_s, [10, 11.5, 30])
    np.testing.assert_array_equal(first.off_s, [11.5, 12, 31])
    assert any("1 times on follows on within 2 s" in text for text in findings)


def test_pulses_shorter_than_the_tick_of_the_clock(read: Read) -> None:
    """A count detector in pulse mode: every off has the time of its on, and stands before it."""
    times = np.arange(5.0, 7000.0, 10.0)
    pulses = pl.DataFrame(
        {
            "period_id": "day0",
            "time_s": np.repeat(times, 2),
            "detector_id": "s",
            "event": ["off", "on"] * len(times),
            "speed_mps": None,
            "length_m": None,
        },
        schema_overrides={"speed_mps": pl.Float64, "length_m": pl.Float64},
    )
    found, findings = read(
        changes={"detections": lambda f: pl.concat([f.filter(~of("s")), pulses])}
    )
    seen = found.periods[0].passages["s"]
    np.testing.assert_array_equal(seen.on_s, times)
    np.testing.assert_array_equal(seen.off_s, times)
    assert not any("without" in text for text in findings)


def test_a_lost_on_and_a_lost_off_are_counted(read: Read) -> None:
    times = np.arange(10.0, 110.0, 10.0)
    rows = Passages(times, times + 1, np.full(10, 8.0), np.full(10, 5.0))
    given = passages(recording(), "s", lambda _: rows)
    lost = of("s") & pl.col("time_s").is_in(
        [31.0, 60.0]
    )  # the off of the third, the on of the sixth
    found, findings = read(given, {"detections": lambda f: f.filter(~lost)})
    np.testing.assert_array_equal(found.periods[0].passages["s"].on_s, np.delete(times, [2, 5]))
    assert any("1 ons without off and 1 offs without on" in text for text in findings)


def test_a_detector_without_partners_is_not_used(read: Read) -> None:
    found, findings = read(
        changes={
            "detections": lambda f: f.filter(
                ~((pl.col("detector_id") == "s") & (pl.col("event") == "off"))
            )
        }
    )
    assert [item.id for item in found.detectors] == ["a", "w", "x"]
    assert all("s" not in period.passages for period in found.periods)
    assert any("'s' has no partner" in text and "not used" in text for text in findings)


def test_impossible_speeds(read: Read) -> None:
    def with_speed(value: float, count: int) -> Rows:
        def change(frame: pl.DataFrame) -> pl.DataFrame:
            chosen = (pl.col("n") < count) & pl.col("speed_mps").is_not_null()
            return (
                frame.sort("speed_mps", nulls_last=True, maintain_order=True)
                .with_row_index("n")
                .with_columns(pl.when(chosen).then(value).otherwise("speed_mps").alias("speed_mps"))
                .drop("n")
                .sort("period_id", "time_s", maintain_order=True)
            )

        return change

    found, findings = read(changes={"detections": with_speed(120.0, 3)})
    assert any("3 impossible speed_mps taken as not measured" in text for text in findings)
    assert any("no speed for 3 of" in text for text in findings)
    assert found.has_speeds
    with pytest.raises(MeasuredDataError, match=r"impossible; allowed: up to 70 m/s.*convert"):
        read(changes={"detections": with_speed(120.0, 1000)})
    with pytest.raises(MeasuredDataError, match=r"speed_mps '-8.0' is negative \(and 4"):
        read(changes={"detections": with_speed(-8.0, 5)})
    _, findings = read(changes={"detections": with_speed(float("nan"), 10**6)})
    assert only(findings, "no speeds") == ("speed_spread",)


def test_one_recording_in_two_periods_counts_twice(read: Read) -> None:
    base = recording(2)
    copy = replace(base.periods[1], passages=base.periods[0].passages)
    with pytest.raises(
        MeasuredDataError, match=r"100% of .* same in the periods 'day0' and 'day1'"
    ):
        read(replace(base, periods=(base.periods[0], copy)))
    one = base.periods[0]

    def within(begin: float, end: float, name: str) -> Period:
        return replace(one, id=name, begin_s=begin, end_s=end)

    with pytest.raises(MeasuredDataError, match="'early' and 'late'"):
        read(replace(base, periods=(within(0, 4000, "early"), within(3000, 7200, "late"))))
    _, findings = read(
        replace(base, periods=(within(0, 3600, "early"), within(3600, 7200, "late")))
    )
    assert not any("same" in text for text in findings)


def test_one_recording_of_lanes_or_vehicles_in_two_periods_counts_twice(read: Read) -> None:
    times = [60.0 * i for i in range(1, 40)]
    tables: dict[str, dict[str, Any]] = {
        "lanes": {"lane_id": "S_C_0", "vehicles": 4, "halting": 2, "mean_speed_mps": 3.0},
        "trajectories": {
            "vehicle_id": "a", "lane_id": "S_C_0", "position_m": 20.0, "speed_mps": 3.0,
        },
    }  # fmt: skip
    for name, values in tables.items():
        rows: list[dict[str, Any]] = [
            {"period_id": day, "time_s": time, **values}
            for day in ("day0", "day1")
            for time in times
        ]
        for change, complaint in ((0.0, "'day0' and 'day1' share 39 rows"), (1.0, None)):
            rows[0][("vehicles" if name == "lanes" else "position_m")] += change
            table = recording(2, **{name: pl.DataFrame(rows)})
            if complaint is None:
                read(table)
                continue
            with pytest.raises(MeasuredDataError, match=complaint):
                read(table)


def test_one_period_holds_nothing_out(read: Read) -> None:
    _, findings = read(recording(1))
    assert only(findings, "only one period", "judged on the data that were fitted") == ()


def test_signals_that_begin_late_stop_or_clash(read: Read) -> None:
    late = (pl.col("time_s") < 50) & (pl.col("period_id") == "day0")
    found, findings = read(changes={"signals": lambda f: f.filter(~late)})
    only(findings, "begins 60 s late")
    assert found.periods[0].signals["C"][0] == (0.0, "rG")
    with pytest.raises(MeasuredDataError, match="begins at 220 s, 220 s late"):
        read(changes={"signals": lambda f: f.filter(pl.col("time_s") > 200)})
    gap = (pl.col("time_s") > 1000) & (pl.col("time_s") < 2000) & (pl.col("period_id") == "day1")
    _, findings = read(changes={"signals": lambda f: f.filter(~gap)})
    only(findings, "'C' in period 'day1'", "one state for 17 min from 1000 s", "recorded?")
    clash = pl.DataFrame(
        {"period_id": ["day0"], "time_s": [40.0], "tls_id": ["C"], "state": ["rr"]}
    )
    found, findings = read(
        changes={
            "signals": lambda f: pl.concat([f, clash]).sort(
                "period_id", "time_s", maintain_order=True
            )
        }
    )
    only(findings, "1 moments with two states; the last one is taken")
    assert found.periods[0].signals["C"][2] == (40.0, "rr")


@pytest.mark.parametrize(("lengths", "adaptive"), [((20, 30), False), ((20, 30, 45), True)])
def test_greens_of_many_lengths_follow_the_traffic(
    read: Read, lengths: tuple[int, ...], adaptive: bool
) -> None:
    times = np.cumsum([0.0, *(lengths[i // 2 % len(lengths)] for i in range(1000))])
    signals = {"C": tuple((float(t), ("Gr", "rG")[i % 2]) for i, t in enumerate(times) if t < END)}
    whole = recording()
    days = tuple(replace(period, signals=signals) for period in whole.periods)
    _, findings = read(replace(whole, periods=days))
    if not adaptive:
        assert findings == {}
    else:
        assert only(findings, "('C') with greens of many lengths", "arrivals they answered") == ()


def fixed_plan(begin_s: float, end_s: float, green_s: float, cycle_s: float) -> list[Any]:
    starts = np.arange(begin_s, end_s, cycle_s).tolist()
    return [
        row for t in starts for row in ((t, "Gr"), (t + green_s, "yr"), (t + green_s + 3, "rG"))
    ]


@pytest.mark.parametrize("states", [4, 6, 9])
def test_a_fixed_plan_of_which_one_row_in_a_hundred_is_lost(states: int) -> None:
    shown = [f"G{'r' * n}{'y' * (states - n)}" for n in range(states)]
    for seed in range(20):
        kept = np.random.default_rng(seed).random(360) > 0.01
        rows = tuple((10.0 * n, shown[n % states]) for n in np.flatnonzero(kept).tolist())
        assert not is_actuated([Period("day", 0.0, 3600.0, "fit", {"A": rows}, {})], "A")


@pytest.mark.parametrize("log", ["of the night too", "with two losses of rows"])
def test_a_fixed_plan_does_not_follow_the_traffic(log: str) -> None:
    """One cycle between two plans, and lost rows, give a few greens of other lengths."""
    begin_s, end_s = 25200.0, 28800.0
    if log == "of the night too":
        night = fixed_plan(0.0, 21600.0, 20.0, 60.0)
        changing = [(21600.0, "Gr"), (21626.0, "yr"), (21629.0, "rG")]
        rows = [*night, *changing, *fixed_plan(21673.0, end_s, 35.0, 90.0)]
    else:
        lost = ((begin_s + 200, begin_s + 290), (begin_s + 820, begin_s + 860))
        rows = [
            row
            for row in fixed_plan(begin_s, end_s, 35.0, 90.0)
            if not any(first < row[0] < last for first, last in lost)
        ]
    signals = {"A": tuple(row for row in rows if row[0] <= end_s)}
    assert not is_actuated([Period("day", begin_s, end_s, "fit", signals, {})], "A")


@pytest.mark.parametrize(("share", "follows"), [(0.0, False), (0.15, True)])
def test_greens_of_one_length_whose_order_changes_follow_the_traffic(
    share: float, follows: bool
) -> None:
    """In heavy traffic every green lasts as long as it must, and a side street is seldom served."""
    generator = np.random.default_rng(5)
    rows: list[tuple[float, str]] = []
    for number, now in enumerate(np.arange(0.0, 3600.0, 20.0).tolist()):
        first, second = [("Grr", "yrr"), ("rGr", "ryr")][number % 2]
        if generator.random() < share:
            first, second = "rrG", "rry"
        rows += [(now, first), (now + 11.0, second), (now + 14.0, "rrr")]
    assert is_actuated([Period("day", 0.0, 3600.0, "fit", {"A": tuple(rows)}, {})], "A") == follows


@pytest.mark.parametrize("usual_s", [5.0, 50.0])
def test_a_controller_that_mostly_gives_one_length_follows_the_traffic(usual_s: float) -> None:
    """Nearly all greens are of the shortest length in light traffic, of the longest in heavy."""
    generator = np.random.default_rng(2)
    rows: list[tuple[float, str]] = []
    now = 0.0
    while now < 3600.0:
        odd = generator.random() < 0.15
        green_s = usual_s + odd * float(
            generator.choice([-10.0, -20.0] if usual_s > 9 else [10, 30])
        )
        rows += [(now, "Gr"), (now + green_s, "yr"), (now + green_s + 3, "rG")]
        now += green_s + 40.0
    signals = {"A": tuple(row for row in rows if row[0] <= 3600.0)}
    assert is_actuated([Period("day", 0.0, 3600.0, "fit", signals, {})], "A")


def test_a_state_every_second_is_the_log_of_its_changes(read: Read) -> None:
    lengths = np.random.default_rng(1).choice([14.0, 20.0, 30.0, 47.0], 400)
    times = np.cumsum([0.0, *lengths])
    changes = tuple((float(t), ("Gr", "rG")[i % 2]) for i, t in enumerate(times) if t < END)
    every = tuple(
        (second, changes[np.searchsorted(times, second, side="right") - 1][1])
        for second in np.arange(END).tolist()
    )
    whole = recording()

    def read_of(log: SignalLog) -> tuple[MeasuredData, dict[str, tuple[str, ...]]]:
        days = tuple(replace(period, signals={"C": log}) for period in whole.periods)
        return read(replace(whole, periods=days))

    sparse, findings = read_of(changes)
    dense, dense_findings = read_of(every)
    assert dense.hash == sparse.hash
    assert dense.periods[0].signals == {"C": changes}
    assert dense_findings == findings
    only(findings, "('C') with greens of many lengths")


def test_a_log_without_yellow(tmp_path: Path, scenario: Scenario, network: Network) -> None:
    directory = write_measured(recording(), tmp_path / "street")
    yellow = scenario.with_control(yellow_s=3.0, decision_interval_s=10.0)
    read = read_measured(directory, yellow, Network.read(yellow))
    found = {item.text: item.rules_out for item in read.findings}
    assert only(found, "('C') never yellow", "3 s") == ("yellow_running", "yellow_time")


@pytest.mark.parametrize(
    ("kind", "ruled_out"),
    [
        ("stop", {"startup_delay", "late_green", "red_running"}),
        ("advance", {"deceleration", "min_gap"}),
        ("exit", set()),  # every lane of the crossing leads to one road: exits add nothing
    ],
)
def test_kinds_of_detectors_that_are_missing(kind: str, ruled_out: set[str], read: Read) -> None:
    _, findings = read(without(recording(), kind))
    text = next(text for text in findings if f"no {kind} detector counts" in text)
    assert ruled_out <= set(findings[text])
    assert bool(ruled_out) == bool(findings[text])


def test_detectors_that_never_say_anything(read: Read) -> None:
    base = recording()
    for name in ("w", "x"):
        base = passages(base, name, lambda _: Passages.none())
    _, findings = read(base)
    text = next(text for text in findings if "nothing of 2 detectors ('w', 'x'), of 4" in text)
    assert "dropout" in findings[text]


def test_a_single_silent_detector_is_told_with_what_to_do(read: Read) -> None:
    _, findings = read(passages(recording(), "w", lambda _: Passages.none()))
    text = next(text for text in findings if "nothing of 1 detector ('w'), of 4" in text)
    assert "compared like a count of 0: leave their rows in detectors.csv out" in text
    assert not findings[text]


def test_a_detector_that_is_silent_while_its_neighbour_counts(read: Read) -> None:
    base = recording()

    def silent(rows: Passages) -> Passages:
        return rows.at((rows.on_s < 2000) | (rows.on_s > 5000))

    day = base.periods[1]
    day = replace(day, passages={**day.passages, "s": silent(day.passages["s"])})
    _, findings = read(replace(base, periods=(base.periods[0], day, base.periods[2])))
    only(findings, "'s' says nothing for 50 min", "period 'day1'", "a neighbour counts 1")
    stuck = replace(
        base.periods[1],
        passages={**base.periods[1].passages, "s": silent(base.periods[1].passages["s"])},
    )
    rows = stuck.passages["s"]
    last = int(np.flatnonzero(rows.on_s < 2000)[-1])
    off = rows.off_s.copy()
    off[last] = 5000.0
    stuck = replace(stuck, passages={**stuck.passages, "s": replace(rows, off_s=off)})
    _, findings = read(replace(base, periods=(base.periods[0], stuck, base.periods[2])))
    only(findings, "'s' is on for", "period 'day1'")


def test_a_detector_that_is_silent_in_several_periods_is_one_finding(read: Read) -> None:
    base = recording()
    days = tuple(
        replace(
            day,
            passages={
                **day.passages,
                "s": day.passages["s"].at(
                    (day.passages["s"].on_s < 2000) | (day.passages["s"].on_s > end)
                ),
            },
        )
        for day, end in zip(base.periods, (5000, 4500, 4500), strict=True)
    )
    _, findings = read(replace(base, periods=days))
    only(findings, "'s' says nothing for 42 to 50 min in 3 periods ('day0', 'day1', 'day2')")


def test_whole_seconds_are_said(read: Read) -> None:
    def whole(rows: Passages) -> Passages:
        return replace(rows, on_s=np.floor(rows.on_s), off_s=np.floor(rows.on_s) + 1)

    base = recording()
    for item in DETECTORS:
        base = passages(base, item.id, whole)
    only(read(base)[1], "whole seconds")


def test_detectors_in_places_where_they_tell_nothing(read: Read) -> None:
    base = recording()
    wrong = tuple(replace(d, kind="stop") if d.id == "x" else d for d in base.detectors)
    _, findings = read(replace(base, detectors=wrong))
    assert any("1 detector ('x') not on a lane of that kind" in text for text in findings)
    fewer = replace(base, detectors=tuple(d for d in base.detectors if d.id != "w"))
    _, findings = read(fewer)
    assert any("no detector on 1 incoming lane ('W_C_0'), of 2" in text for text in findings)


def test_lanes_that_are_mixed_up_show_in_who_leaves_on_red(read: Read) -> None:
    # Link 0 is green in the first 20 s of every 40 s, link 1 in the second.
    def at(begin: float, seed: int) -> Passages:
        on = np.arange(begin, END - 40, 40) + np.random.default_rng(seed).uniform(0, 9, 179)
        on = np.round(on, 3)
        return Passages(on, np.round(on + 1, 3), np.full(179, 8.0), np.full(179, 5.0))

    base = recording()
    days = [
        replace(p, passages={**p.passages, "s": at(5.0, i), "w": at(25.0, 10 + i)})
        for i, p in enumerate(base.periods)
    ]
    right = replace(base, periods=tuple(days))
    assert read(right)[1] == {}
    lanes = {"s": "W_C_0", "w": "S_C_0"}
    mixed = tuple(replace(d, lane=lanes.get(d.id, d.lane)) for d in right.detectors)
    text = next(text for text in read(replace(right, detectors=mixed))[1] if "red" in text)
    assert "1074 of 1074 vehicles leave the stop detectors of traffic light 'C'" in text


@pytest.mark.parametrize("letter", ["r", "o", "O", "s"])
def test_lights_that_flash_or_are_off_are_not_red(letter: str, read: Read) -> None:
    days = tuple(replace(p, signals={"C": ((0.0, 2 * letter),)}) for p in recording().periods)
    findings = read(replace(recording(), periods=days))[1]
    assert any("while their lane has red" in text for text in findings) == (letter == "r")


def counts() -> pl.DataFrame:
    rows = [
        (f"day{i}", 900.0 * k, 900.0 * (k + 1), d.id, 40 + k + i)
        for i in range(3)
        for d in DETECTORS
        for k in range(8)
    ]
    names = ["period_id", "begin_s", "end_s", "detector_id", "count"]
    return pl.DataFrame(rows, schema=names, orient="row")


def counted(tmp_path: Path, **columns: float) -> Path:
    made = counts().with_columns(**{name: pl.lit(value) for name, value in columns.items()})
    base = recording(counts=made)
    days = tuple(replace(p, signals={}, passages={}) for p in base.periods)
    directory = write_measured(replace(base, periods=days), tmp_path / "street")
    assert not (directory / "detections.parquet").exists()
    assert not (directory / "signals.parquet").exists()
    (directory / CSV_HASHES).unlink()  # tests edit the tables by hand
    return directory


def test_what_a_log_of_signals_would_show_is_not_said_to_be_examined(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    read = read_measured(counted(tmp_path, occupancy=0.1), scenario, network)
    findings = {item.text: item.rules_out for item in read.findings}
    ruled_out = {name for names in findings.values() for name in names}
    text = next(text for text in findings if "sums of intervals" in text)
    examined = text.partition("examined are ")[2].partition(";")[0].split(", ")
    assert examined and not ruled_out & {*examined}
    assert "a log of signals would show acceleration" in text


def test_counts_alone_can_tell_a_few_things(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    read = read_measured(counted(tmp_path), scenario, network)
    assert read.counts is not None and read.counts.height == 96
    findings = {item.text: item.rules_out for item in read.findings}
    text = next(text for text in findings if text.startswith("counts only"))
    assert set(findings[text]) == set(known_effects()) - set(coverage.COUNTABLE)
    assert "startup_delay" in findings[text]
    assert any("no signals: the network's own programme" in text for text in findings)
    assert _said(text, "also") == set(coverage.SUMMED) - set(coverage.NEEDS_SIGNALS)
    again = read_measured(write_measured(read, tmp_path / "again"), scenario, network)
    assert [period.signals for period in again.periods] == [{}] * 3
    assert again.counts is not None and again.counts.equals(read.counts)


@pytest.mark.parametrize(
    ("count", "occupancy", "told"),
    [
        (None, None, "nothing of 1 detector ('w'), of 4; nothing is compared there: leave"),
        (0, 0.0, "no vehicle at 1 detector ('w'), of 4; that is compared as a count of 0: leave"),
        (0, 1.0, "no vehicle, and an occupancy of 1 throughout, at 1 detector ('w'), of 4; that"),
        (1, 1.0, None),
    ],
)
def test_a_detector_that_never_counts_is_told_with_what_to_do(
    count: int | None, occupancy: float | None, told: str | None,
    tmp_path: Path, scenario: Scenario, network: Network,
) -> None:  # fmt: skip
    directory = counted(tmp_path, occupancy=0.1)
    rows = pl.read_csv(directory / "counts.csv")
    dead = pl.col("detector_id") == "w"
    rows = rows.filter(~dead) if count is None else rows.with_columns(
        pl.when(dead).then(count).otherwise("count").alias("count"),
        pl.when(dead).then(occupancy).otherwise("occupancy").alias("occupancy"),
    )  # fmt: skip
    rows.write_csv(directory / "counts.csv")
    read = read_measured(directory, scenario, network)
    assert len(read.detectors) == 4
    found = [item for item in read.findings if "('w'), of 4" in item.text]
    assert [told in item.text for item in found] == [True] if told else not found
    assert not any(item.rules_out for item in found)


@pytest.mark.parametrize("logged", [True, False])
def test_counts_alone_are_said_to_show_what_they_show(
    logged: bool, tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    def findings(**columns: float) -> dict[str, tuple[str, ...]]:
        made = counts().with_columns(**{name: pl.lit(value) for name, value in columns.items()})
        base = recording(counts=made)
        days = tuple(
            replace(p, signals=p.signals if logged else {}, passages={}) for p in base.periods
        )
        street = write_measured(replace(base, periods=days), tmp_path / "street")
        found = read_measured(street, scenario, network).findings
        return {item.text: item.rules_out for item in found}

    alone = findings()
    text = next(text for text in alone if text.startswith("counts only"))
    assert _said(text, "only") == set(known_effects()) - set(alone[text])
    ruled_out = {name for names in findings(occupancy=0.1).values() for name in names}
    assert _said(text, "also") and not _said(text, "also") & ruled_out


def _said(text: str, word: str) -> set[str]:
    """Return the effects that a finding on counts lists behind a word."""
    return {*text.rpartition(f" {word} ")[2].partition(" can be")[0].split(", ")}


def test_counts_of_one_kind_of_detectors_show_no_undercount(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    directory = counted(tmp_path)
    assert not _ruled_out(directory, scenario, network) & {"undercount"}
    stops = [d.id for d in DETECTORS if d.kind == "stop"]
    rows = pl.read_csv(directory / "counts.csv").filter(pl.col("detector_id").is_in(stops))
    rows.write_csv(directory / "counts.csv")
    assert "undercount" in _ruled_out(directory, scenario, network)


def _ruled_out(directory: Path, scenario: Scenario, network: Network) -> set[str]:
    findings = read_measured(directory, scenario, network).findings
    return {name for finding in findings for name in finding.rules_out}


def test_counts_of_a_detector_with_broken_events_are_of_a_listed_detector(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    """A detector that only ever comes on is not used, but its counts are no fault of the table."""
    directory = write_measured(recording(counts=counts()), tmp_path / "street")
    path = directory / "detections.parquet"
    rows = pl.read_parquet(path)
    first = rows["detector_id"][0]
    kept = (pl.col("detector_id") != first) | (pl.col("event") == "on")
    rows.filter(kept).write_parquet(path)
    read = read_measured(directory, scenario, network)
    assert first not in [d.id for d in read.detectors]
    assert read.counts is not None and first not in read.counts["detector_id"]


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("detector_id", "z", "'z' is not listed in detectors.csv"),
        ("period_id", "day7", "'day7' is not listed in periods.csv"),
        ("count", "-1", "is negative"),
        ("count", "1.5", "not a whole number"),
        ("begin_s", "-900", "before the period's begin"),
        ("end_s", "9000", "after the period's end"),
        ("end_s", "0", "not after begin_s"),
        ("begin_s", "many", "begin_s is 'many'"),
    ],
)
def test_wrong_counts_are_refused(
    column: str, value: str, message: str, tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    directory = counted(tmp_path)
    frame = counts().cast(pl.String)
    frame = frame.with_columns(
        pl.when(pl.int_range(pl.len()) == 0).then(pl.lit(value)).otherwise(column).alias(column)
    )
    frame.write_csv(directory / "counts.csv")
    with pytest.raises(MeasuredDataError, match=rf"counts.csv, line 2: .*{message}"):
        read_measured(directory, scenario, network)


def test_intervals_outside_of_a_shortened_period_are_left_out(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    directory = counted(tmp_path)
    periods = pl.read_csv(directory / "periods.csv")
    length = 4500.0
    periods = periods.with_columns(end_s=pl.col("begin_s") + length)
    periods.write_csv(directory / "periods.csv")
    counts().write_csv(directory / "counts.csv")
    read = read_measured(directory, scenario, network)
    assert read.counts is not None
    assert read.counts["end_s"].max() == length
    assert any("rows lie outside of their periods" in finding.text for finding in read.findings)


def test_an_interval_partly_in_its_period_is_refused_with_the_way_out(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    directory = counted(tmp_path)
    periods = pl.read_csv(directory / "periods.csv")
    periods.with_columns(end_s=pl.col("begin_s") + 4000.0).write_csv(directory / "periods.csv")
    with pytest.raises(MeasuredDataError, match=r"begin and end the period in periods\.csv"):
        read_measured(directory, scenario, network)


def test_a_day_without_counts_is_no_day_without_vehicles(
    tmp_path: Path, scenario: Scenario, network: Network
) -> None:
    directory = counted(tmp_path)
    frame = counts()
    frame.filter(pl.col("period_id") != "day2").write_csv(directory / "counts.csv")
    with pytest.raises(MeasuredDataError, match="counts.csv: no counts in period 'day2'; was the"):
        read_measured(directory, scenario, network)


def test_every_name_that_is_ruled_out_is_an_effect() -> None:
    names = {
        name
        for key, value in vars(coverage).items()
        if key.startswith("NEEDS_") or key == "COUNTABLE"
        for name in value
    }
    assert names <= set(known_effects())


def test_a_finding_is_a_value() -> None:
    assert Finding("x") == Finding("x", ())


# --- likely mistakes of an export -----------------------------------------------------------------


def scaled(column: str, factor: float) -> Rows:
    return lambda frame: frame.with_columns(pl.col(column) * factor)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (scaled("speed_mps", 2.237), ("is it in km/h or mph",)),
        (scaled("speed_mps", 3.6), ("is it in km/h or mph",)),
        (scaled("speed_mps", 0.0), ("speed_mps is 0 everywhere",)),
        (scaled("length_m", 3.281), ("median of length_m is 16.4 m", "in feet")),
        (
            lambda f: f.with_columns(
                event=pl.when(pl.col("event") == "on").then(pl.lit("off")).otherwise(pl.lit("on"))
            ),
            ("are on and off swapped?",),
        ),
    ],
)
def test_units_and_events_that_cannot_be_meant_are_named(
    change: Rows, words: tuple[str, ...], read: Read
) -> None:
    days = tuple(
        replace(p, passages={name: fast(each) for name, each in p.passages.items()})
        for p in recording().periods
    )
    findings = read(replace(recording(), periods=days), {"detections": change})[1]
    assert [text for text in findings if all(word in text for word in words)], list(findings)


def fast(passages: Passages) -> Passages:
    """The vehicles at the speed limit of the crossing."""
    return replace(passages, speed_mps=np.full(len(passages), 13.0))


def test_zones_in_unusual_places_are_named(read: Read) -> None:
    a, s, w, x = DETECTORS
    swapped = (replace(a, kind="stop"), replace(s, kind="advance"), w, x)
    findings = read(recording(detectors=swapped))[1]
    assert any("'s') not upstream of the stop detector" in text for text in findings)
    assert any("'a') more than 30 m upstream of the end" in text for text in findings)
    turned = (replace(a, position_m=2.0, length_m=440.0), s, w, x)
    only(read(recording(detectors=turned))[1], "position_m and length_m swapped", "'a'")


def test_one_lane_on_red_is_named_though_the_others_are_right(read: Read) -> None:
    cycle = ((0.0, "Gr"), (20.0, "rG"))
    log = [(40.0 * i + begin, state) for i in range(180) for begin, state in cycle]
    begins = 40.0 * np.arange(179)

    def at(offset_s: float) -> Passages:
        on = begins + offset_s
        return Passages(on, on + 1, np.full(len(on), 8.0), np.full(len(on), 5.0))

    base = recording()
    days = tuple(
        replace(p, signals={"C": tuple(log)}, passages={**p.passages, "s": at(5.0), "w": at(6.0)})
        for p in base.periods
    )
    findings = read(replace(base, periods=days))[1]
    only(findings, "leave the stop detectors", "('W_C_0') of 2")


def test_a_clock_set_back_in_a_sorted_table_is_named(read: Read) -> None:
    def back(frame: pl.DataFrame) -> pl.DataFrame:
        late = pl.col("time_s") > 5000
        moved = pl.when(late).then(pl.col("time_s") - 1800).otherwise("time_s")
        return frame.with_columns(moved.alias("time_s")).sort("period_id", "time_s")

    findings = read(changes={"detections": back})[1]
    doubled = [text for text in findings if "two recordings lay on top" in text]
    assert doubled and all("from 3600 s" in t or "from 4500 s" in t for t in doubled), findings


@pytest.mark.parametrize("length_s", [300.0, 600.0])
def test_a_clock_set_back_is_an_error_in_a_short_period_too(length_s: float, read: Read) -> None:
    """The copy of the hour lies outside of the period, and must not be left out unseen."""
    begin_s, end_s = 5000 - length_s / 2, 5000 + length_s / 2

    def cut(passages: Passages) -> Passages:
        return passages.at(np.flatnonzero((passages.on_s > begin_s) & (passages.off_s < end_s)))

    days = tuple(
        replace(
            p, begin_s=begin_s, end_s=end_s,
            passages={name: cut(each) for name, each in p.passages.items()},
        )
        for p in recording().periods
    )  # fmt: skip

    def back(frame: pl.DataFrame) -> pl.DataFrame:
        late = pl.col("time_s") > 5000
        moved = pl.when(late).then(pl.col("time_s") - 3600).otherwise("time_s")
        return frame.with_columns(moved.alias("time_s"))

    with pytest.raises(MeasuredDataError, match=r"steps back by 3[56]\d\d.*daylight saving"):
        read(replace(recording(), periods=days), {"detections": back})
