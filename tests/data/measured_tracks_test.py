"""Passages read off trajectories: closed forms, and those of the loops of the same simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import Finding, MeasuredData, read_measured, traffic_of_lanes, write_measured
from ugat_marl.data.measured.tracks import passages_of_tracks
from ugat_marl.data.row_hashes import CSV_HASHES
from ugat_marl.errors import MeasuredDataError
from ugat_marl.experiments import policy_factory, record
from ugat_marl.scenarios import Detector, Network, Passages, Period, read_scenario

DAY = Period("day", 0.0, 100.0, "fit", {}, {})


def track(lanes: list[str], positions: list[float], speed: float, **more: object) -> pl.DataFrame:
    count = len(lanes)
    return pl.DataFrame(
        {
            "period_id": ["day"] * count,
            "vehicle_id": ["v"] * count,
            "time_s": np.arange(10.0, 10.0 + count),
            "lane_id": lanes,
            "position_m": positions,
            "speed_mps": [speed] * count,
            **more,
        }
    )


def passages(rows: pl.DataFrame, *detectors: Detector) -> dict[str, Passages]:
    (found,) = passages_of_tracks(Path("t"), rows, [DAY], detectors, [])
    return found


def test_times_are_interpolated_and_the_rear_leaves_behind_the_zone() -> None:
    rows = track(["a_0"] * 5, [0.0, 10.0, 20.0, 30.0, 40.0], 10.0, length_m=[4.0] * 5)
    seen = passages(rows, Detector("d", "a_0", 15.0, 6.0, "advance"))["d"]
    assert seen.on_s.tolist() == [11.5]
    assert seen.off_s.tolist() == [12.5]  # 15 + 6 + 4 = 25 m
    assert seen.speed_mps.tolist() == [10.0]
    assert seen.length_m.tolist() == [4.0]


@pytest.mark.parametrize("first", [20.0, 20.01])
def test_a_vehicle_at_the_begin_of_a_zone_is_on_it(first: float) -> None:
    rows = track(["a_0"] * 4, [first, first, 30.0, 40.0], 10.0)
    seen = passages(rows, Detector("z", "a_0", 20.0, 4.0, "stop"))["z"]
    assert np.isnan(seen.on_s).all() and np.isfinite(seen.off_s).all() and len(seen) == 1


def test_an_id_that_is_given_again_is_another_vehicle() -> None:
    """Cars 20 s apart at 10 m/s with two ids in turn, as in clips that number anew."""
    rows = pl.concat(
        track(["a_0"] * 5, [10.0 * n for n in range(5)], 10.0).with_columns(
            pl.col("time_s") + 20.0 * car, vehicle_id=pl.lit(f"v{car % 2}")
        )
        for car in range(4)
    )
    findings: list[Finding] = []
    (found,) = passages_of_tracks(
        Path("t"), rows, [DAY], [Detector("d", "a_0", 15.0, 6.0, "advance")], findings
    )
    assert found["d"].on_s.tolist() == [11.5, 31.5, 51.5, 71.5]
    assert found["d"].off_s.tolist() == pytest.approx([12.6, 32.6, 52.6, 72.6])
    assert "2 times a vehicle_id comes back" in findings[-1].text


def test_an_id_that_drives_back_is_another_vehicle() -> None:
    rows = track(["a_0"] * 6, [0.0, 20.0, 40.0, 0.0, 20.0, 40.0], 20.0)
    seen = passages(rows, Detector("d", "a_0", 10.0, 1.0, "advance"))["d"]
    assert seen.on_s.tolist() == [10.5, 13.5]


@pytest.mark.parametrize(
    ("times", "positions", "speeds", "expected"),
    [
        ([3.0, 9.0], [30.0, 90.0], [10.0, 10.0], (5.0, 5.7)),  # every 6 s
        ([0.0, 3.0, 33.0, 36.0], [20.0, 50.0, 50.0, 80.0], [10.0, 0.0, 0.0, 10.0], (3.0, 33.7)),
    ],
)
def test_a_vehicle_that_comes_as_far_as_its_speeds_tell_is_the_same(
    times: list[float], positions: list[float], speeds: list[float], expected: tuple[float, float]
) -> None:
    rows = track(["a_0"] * len(times), positions, 10.0).with_columns(
        time_s=pl.Series(times), speed_mps=pl.Series(speeds)
    )
    usual = track(["b_0"] * 20, [float(n) for n in range(20)], 1.0, vehicle_id=["w"] * 20)
    seen = passages(pl.concat([rows, usual]), Detector("d", "a_0", 50.0, 2.0, "advance"))["d"]
    assert (*seen.on_s, *seen.off_s) == pytest.approx(expected)


def test_nothing_is_made_up_while_a_vehicle_is_out_of_sight() -> None:
    rows = track(["a_0"] * 4, [200.0, 210.0, 220.0, 260.0], 10.0).with_columns(
        time_s=pl.Series([0.0, 1.0, 2.0, 60.0])
    )
    with pytest.raises(MeasuredDataError, match="no vehicle comes over a detector"):
        passages(rows, Detector("d", "a_0", 236.0, 2.0, "advance"))


def test_a_vehicle_may_leave_a_zone_before_its_first_position_on_the_lane() -> None:
    """It is 3 m before lane b at 10 s and 12 m on it at 11 s, at 15 m/s."""
    rows = track(["a_0", "b_0", "b_0"], [25.0, 12.0, 27.0], 15.0, length_m=[5.0] * 3)
    seen = passages(rows, Detector("exit", "b_0", 2.0, 0.0, "exit"))["exit"]
    assert seen.on_s.tolist() == pytest.approx([11.0 - 10.0 / 15.0], abs=1e-3)
    assert seen.off_s.tolist() == pytest.approx([11.0 - 5.0 / 15.0], abs=1e-3)


def test_a_stop_line_between_two_positions_is_crossed_though_the_road_ends() -> None:
    # The lane ends at 28 m; the junction is 12 m long. Speeds tell the way between the lanes.
    rows = track(["a_0", "a_0", "a_0", ":j_0", "b_0"], [5.0, 15.0, 25.0, 7.0, 5.0], 10.0)
    found = passages(
        rows, Detector("stop", "a_0", 26.0, 0.0, "stop"), Detector("exit", "b_0", 2.0, 0.0, "exit")
    )
    assert found["stop"].on_s.tolist() == [12.1]
    assert found["stop"].off_s.tolist() == [12.6]  # 5 m later
    assert found["exit"].on_s.tolist() == [13.7]
    assert np.isnan(found["exit"].off_s[0]), "the track ends before"


@pytest.mark.parametrize(
    ("speeds", "on_s"),
    [
        ([10.0, 0.0, 1.5, 10.0], 12.0),  # it stood at 25 m, and SUMO's cars start at 1.5 m/s
        ([10.0, 0.0, 0.0, 10.0], 12.0),  # speeds without decimals
        ([10.0, 10.0, 10.0, 10.0], 11.1),
    ],
)
def test_a_start_from_standing_is_a_passage_though_speeds_tell_less(
    speeds: list[float], on_s: float
) -> None:
    rows = track(["a_0", "a_0", ":j_0", "b_0"], [15.0, 25.0, 7.0, 5.0], 0.0, speed_mps=speeds)
    assert passages(rows, Detector("d", "a_0", 26.0, 0.0, "stop"))["d"].on_s.tolist() == [on_s]


def test_a_vehicle_that_changes_lanes_behind_a_detector_was_not_on_it() -> None:
    rows = track(["a_0", "a_0", "a_1", "a_1"], [0.0, 10.0, 20.0, 30.0], 10.0)
    detectors = [Detector(f"{x}", f"a_{x}", 5.0, 0.0, "advance") for x in (0, 1)]
    assert set(passages(rows, *detectors)) == {"0"}


@pytest.mark.parametrize("speed", [8.0, 10.0, 12.0])
@pytest.mark.parametrize(
    ("at_m", "lane"), [(12.0, "0"), (15.0, "0"), (18.0, "0"), (19.0, "0"), (21.0, "1")]
)
def test_a_vehicle_that_changes_lanes_over_a_detector_is_seen_once(
    at_m: float, lane: str, speed: float
) -> None:
    """It is on the first lane until 20 m; positions tell that, and speeds are less exact."""
    rows = track(["a_0", "a_0", "a_1", "a_1"], [0.0, 10.0, 20.0, 30.0], speed)
    detectors = [Detector(f"{x}", f"a_{x}", at_m, 0.0, "advance") for x in (0, 1)]
    seen = passages(rows, *detectors)
    assert set(seen) == {lane}
    assert seen[lane].on_s.tolist() == pytest.approx([10.0 + at_m / 10.0])


def test_a_vehicle_that_changes_lanes_while_its_position_jitters_is_seen_once() -> None:
    rows = track(["a_0", "a_0", "a_1", "a_1"], [0.0, 10.4, 10.0, 20.0], 0.2)
    for at_m in (10.2, 10.4, 10.6):
        detectors = [Detector(f"{x}", f"a_{x}", at_m, 0.0, "advance") for x in (0, 1)]
        assert len(passages(rows, *detectors)) == 1


def test_a_vehicle_that_stands_on_a_zone_at_the_begin_is_seen_to_leave() -> None:
    rows = track(["a_0"] * 4, [28.0, 28.0, 38.0, 48.0], 10.0, length_m=[5.0] * 4)
    zone, behind = (
        Detector(x, "a_0", at, 10.0, "stop") for x, at in (("zone", 20.0), ("far", 30.0))
    )
    seen = passages(rows, zone, behind)
    assert np.isnan(seen["zone"].on_s).all() and seen["zone"].off_s.tolist() == [11.7]
    assert seen["far"].on_s.tolist() == [11.2], "it was not on that one"


def test_positions_that_jitter_do_not_move_a_standing_vehicle() -> None:
    """Ten positions a second with an error of 0.3 m: a minute of standing would add 200 m."""
    time = np.arange(0.0, 90.0, 0.1)
    true = np.where(time < 15.0, 10.0 * time, np.where(time < 75.0, 150.0, 10.0 * (time - 60.0)))
    position = true + np.random.default_rng(0).normal(0.0, 0.3, len(time))
    rows = track(["a_0"] * len(time), position.tolist(), 10.0).with_columns(time_s=pl.Series(time))
    seen = passages(rows, Detector("d", "a_0", 170.0, 0.0, "stop"))["d"]
    assert seen.on_s.tolist() == pytest.approx([77.0], abs=0.2)


def test_passages_over_a_long_zone_follow_each_other_as_in_a_log() -> None:
    first = track(["a_0"] * 6, [0.0, 10.0, 20.0, 30.0, 40.0, 50.0], 10.0)
    second = first.with_columns(
        pl.lit("w").alias("vehicle_id"), (pl.col("time_s") + 1.5).alias("time_s")
    )
    seen = passages(pl.concat((first, second)), Detector("d", "a_0", 15.0, 15.0, "stop"))["d"]
    assert seen.on_s.tolist() == [11.5, 13.0]
    assert seen.off_s.tolist() == [13.0, 15.0], "the first one's rear leaves at 13.5 s"


def test_a_vehicle_that_drove_farther_than_its_speeds_tell_is_seen_all_the_same() -> None:
    """It is 12 m on lane b a second after it was on lane a, and its speed says 5 m."""
    rows = track(["a_0", "b_0", "b_0", "b_0"], [25.0, 12.0, 27.0, 42.0], 5.0)
    seen = passages(rows, Detector("exit", "b_0", 2.0, 0.0, "exit"))["exit"]
    assert seen.on_s.tolist() == [10.0]


def test_a_standing_vehicle_is_on_until_it_drives() -> None:
    rows = track(["a_0"] * 6, [0.0, 10.0, 10.0, 10.0, 20.0, 30.0], 0.0)
    seen = passages(rows, Detector("d", "a_0", 8.0, 0.0, "stop"))["d"]
    assert seen.on_s.tolist() == [10.8]
    assert seen.off_s.tolist() == [13.3]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (track(["a_0"] * 3, [0.0, 9.0, 18.0], 9.0), "no vehicle comes over a detector"),
        (
            track(["a_0"] * 3, [0.0, 9.0, 18.0], 9.0, time_s=[0.0, 5.0, 10.0]),
            "positions every 5 s, and no detections; passages",
        ),
    ],
)
def test_what_cannot_give_passages_is_refused(rows: pl.DataFrame, message: str) -> None:
    with pytest.raises(MeasuredDataError, match=message):
        passages(rows, Detector("d", "b_0", 5.0, 0.0, "stop"))


def test_tracks_give_what_loops_give(data: Path, tmp_path: Path) -> None:
    scenario = read_scenario(data / "crossing")
    network = Network.read(scenario)
    whole = record(
        scenario, "sim", policy_factory("fixed-time:30"), periods=1, seed=3, trajectories=True
    )
    assert whole.trajectories is not None
    lengths = whole.trajectories.with_columns(pl.lit(5.0).alias("length_m"))
    alone = replace(
        whole,
        trajectories=lengths,
        periods=tuple(replace(period, passages={}) for period in whole.periods),
    )
    written = write_measured(alone, tmp_path / "street", csv=True)
    (written / "detections.csv").unlink()
    read = read_measured(written, scenario, network)
    assert any("read off the trajectories" in finding.text for finding in read.findings)
    assert isinstance(read, MeasuredData) and read.has_events
    for name, loop in whole.periods[0].passages.items():
        seen = read.periods[0].passages[name]
        assert len(seen) == len(loop), name
        assert np.nanmax(np.abs(seen.on_s - loop.on_s)) < 0.1, name
        # SUMO changes speeds at once, and tracks between two positions: half a second's worth.
        assert np.nanmax(np.abs(seen.off_s - loop.off_s)) < 0.5, name
        assert np.nanmedian(np.abs(seen.speed_mps - loop.speed_mps)) < 1.5, name
    (written / CSV_HASHES).unlink()  # the table is edited by hand
    rows = pl.read_csv(written / "trajectories.csv")
    pl.concat((rows, rows.head(7))).write_csv(written / "trajectories.csv")
    twice = read_measured(written, scenario, network)
    assert twice.trajectories is not None and twice.trajectories.height == rows.height
    assert any("7 rows are there twice" in finding.text for finding in twice.findings)
    elsewhere = pl.col("lane_id").replace("W_C_0", "W_C_7")
    rows.with_columns(elsewhere).write_csv(written / "trajectories.csv")
    with pytest.raises(MeasuredDataError, match="'W_C_7', which the network does not have"):
        read_measured(written, scenario, network)


# --- vehicles on lanes ----------------------------------------------------------------------------


def crowd(step_s: float, offset_s: float) -> pl.DataFrame:
    """Positions of 30 vehicles at 10 m/s on three lanes of 100 m, the first from 5 s on."""
    begins = np.linspace(5.0, 80.0, 30)
    rows = [
        ("day", f"v{number}", time, f"l_{int(driven // 100)}", driven % 100, 10.0)
        for number, begin in enumerate(begins.tolist())
        for time in np.arange(offset_s, 100.0, step_s).tolist()
        if 0.0 <= (driven := 10.0 * (time - begin)) < 300.0
    ]
    names = ("period_id", "vehicle_id", "time_s", "lane_id", "position_m", "speed_mps")
    return pl.DataFrame(rows, schema=names, orient="row")


def on_lanes(rows: pl.DataFrame) -> dict[str, list[float | None]]:
    """Return the vehicles on each lane in every second."""
    table = traffic_of_lanes(rows, ["l_0", "l_1", "l_2", "l_9"], DAY)
    assert table["vehicles"].is_null().to_list() == table["halting"].is_null().to_list()
    return {str(lane): part["vehicles"].to_list() for (lane,), part in table.group_by("lane_id")}


def test_vehicles_on_lanes_are_those_of_the_last_moment() -> None:
    whole = on_lanes(crowd(1.0, 0.0))
    assert whole["l_9"] == [None] * 5 + [0.0] * 95, "nobody was seen anywhere before 5 s"
    assert whole["l_0"][30] == 4.0  # began within the last 10 s: at 20.5, 23.1, 25.7 and 28.3 s
    shifted = on_lanes(crowd(1.0, 0.0).with_columns(pl.col("time_s") + 0.5))
    for lane, counts in whole.items():  # the state half a second ago, of a whole second before
        assert shifted[lane][1:] == counts[:-1]


def test_vehicles_below_a_tenth_of_a_metre_per_second_halt() -> None:
    rows = crowd(1.0, 0.0).head(3).with_columns(time_s=20.0, lane_id=pl.lit("l_0"))
    rows = rows.with_columns(speed_mps=pl.Series([0.0, 0.09, 0.1]))
    (row,) = traffic_of_lanes(rows, ["l_0"], DAY).filter(pl.col("time_s") == 20.0).rows(named=True)
    assert (row["vehicles"], row["halting"]) == (3.0, 2.0)
    assert row["mean_speed_mps"] == pytest.approx(0.19 / 3, abs=1e-3)


@pytest.mark.parametrize(("step_s", "offset_s"), [(1.0, 0.5), (2.0, 1.0), (0.04, 0.017)])
def test_other_moments_change_vehicles_on_lanes_by_those_who_cross(
    step_s: float, offset_s: float
) -> None:
    whole, other = on_lanes(crowd(1.0, 0.0)), on_lanes(crowd(step_s, offset_s))
    begins = np.linspace(5.0, 80.0, 30)
    for number in range(3):
        edges = np.concatenate((begins + 10.0 * number, begins + 10.0 * (number + 1)))
        for second in range(8, 100):
            now, then = whole[f"l_{number}"][second], other[f"l_{number}"][second]
            assert now is not None and then is not None
            crossed = ((edges > second - step_s - 1e-6) & (edges <= second + 1e-6)).sum()
            assert abs(now - then) <= crossed


def test_of_seconds_long_after_the_last_moment_nothing_is_known() -> None:
    rows = crowd(1.0, 0.0).filter(~pl.col("time_s").is_between(40.0, 49.0))
    known = on_lanes(rows)["l_0"]
    assert [second for second in range(10, 100) if known[second] is None] == list(range(42, 50))
    moments = np.arange(100.0)
    table = traffic_of_lanes(rows, ["l_0"], DAY, moments)
    assert not table["vehicles"].null_count()
    assert table["vehicles"][40:50].sum() == 0.0, "observed, and empty"


def test_vehicles_that_are_lost_from_sight_on_a_zone_are_counted_all_the_same() -> None:
    """The view ends at 40 m, in the zone; cars of 5 m follow each other after 3 s."""
    rows = pl.concat(
        track(["a_0"] * 5, [0.0, 10.0, 20.0, 30.0, 40.0], 10.0).with_columns(
            pl.col("time_s") + 3.0 * number, vehicle_id=pl.lit(f"v{number}")
        )
        for number in range(4)
    )
    seen = passages(rows, Detector("d", "a_0", 38.0, 2.0, "exit"))["d"]
    assert seen.on_s.tolist() == [13.8, 16.8, 19.8, 22.8]
    assert seen.off_s[:3].tolist() == [14.0, 17.0, 20.0]
    assert np.isnan(seen.off_s[3]), "it is there at the end of all positions"
