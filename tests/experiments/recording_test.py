"""Recording against hand counts on two roads that cross, and against the vehicles' own tracks."""

from __future__ import annotations

import math
import shutil
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from ugat_marl.__main__ import main
from ugat_marl.data import MeasuredData, read_measured, write_measured
from ugat_marl.effects import load_scenario
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments import policy_factory, record
from ugat_marl.scenarios import Network

Crossing = Callable[..., Path]


def measure(
    directory: Path, domain: str = "sim", policy: str = "fixed-time:20", **more: Any
) -> MeasuredData:
    options: dict[str, Any] = {"periods": 1, "workers": 1, **more}
    return record(load_scenario(directory), domain, policy_factory(policy), **options)


@pytest.fixture(scope="module")
def by_hand(data: Path) -> MeasuredData:
    """A car every 20 s on each road, greens of 20 s in turn, and the tracks of all cars."""
    return measure(data / "crossing", same_demand=True, trajectories=True, lanes=True)


def passed(tracks: pl.DataFrame, lanes: tuple[str, ...], lane: str, position_m: float) -> set[str]:
    """Vehicles whose front has passed a point of their way."""
    start = dict.fromkeys(lanes, 0.0)
    start[lanes[1]], start[lanes[2]] = 1000.0, 2000.0  # the lanes one after the other
    point = start[lane] + position_m
    own = tracks.filter(pl.col("lane_id").is_in(lanes)).with_columns(
        (pl.col("lane_id").replace_strict(start) + pl.col("position_m")).alias("way_m")
    )
    ways = own.group_by("vehicle_id").agg(pl.col("way_m").max())
    return set(ways.filter(pl.col("way_m") >= point)["vehicle_id"])


def test_loops_count_the_cars_that_passed(by_hand: MeasuredData) -> None:
    assert by_hand.trajectories is not None
    period = by_hand.periods[0]
    # 440 m at 10 m/s: the cars of 0, 20, ..., 140 s reach the advance detector within 200 s.
    assert len(period.passages["advance:S_C_0"]) == 8
    roads = (("S_C_0", ":C_0_0", "C_N_0"), ("W_C_0", ":C_1_0", "C_E_0"))
    counted = 0
    for lanes in roads:
        for detector in by_hand.detectors:
            if detector.lane in lanes:
                tracks = passed(by_hand.trajectories, lanes, detector.lane, detector.position_m)
                seen = period.passages.get(detector.id)
                assert (0 if seen is None else len(seen)) == len(tracks), detector.id
                counted += len(tracks)
    assert counted > 40


@pytest.mark.parametrize("step_s", [0.4, 2.0])
def test_lanes_keep_their_state_until_the_next_step_that_is_seen(
    crossing: Crossing, step_s: float
) -> None:
    """Positions are written at whole seconds that end a step: every second one."""
    length = f"duration_s = 200\nstep_length_s = {step_s}"
    directory = crossing(toml=lambda text: text.replace("duration_s = 200", length))
    found = measure(directory, lanes=True, trajectories=True)
    assert found.lanes is not None and found.trajectories is not None
    there = found.trajectories.group_by("lane_id", "time_s").agg(pl.len().alias("seen"))
    step = (pl.col("time_s") - pl.col("time_s") % 2.0).alias("moment")
    both = found.lanes.with_columns(step).join(
        there, left_on=["lane_id", "moment"], right_on=["lane_id", "time_s"], how="left"
    )
    assert both["vehicles"].sum() > 20
    assert (both["vehicles"] == both["seen"].fill_null(0)).all()


def test_passages_have_times_speeds_and_lengths(by_hand: MeasuredData) -> None:
    seen = by_hand.periods[0].passages["advance:S_C_0"]
    # The car departs in the first step and is on the road, 5.1 m of it, at the end of the step.
    assert seen.on_s[0] == pytest.approx(1 + (440.0 - 5.1) / 10, abs=0.02)
    assert (seen.off_s - seen.on_s)[0] == pytest.approx(5.0 / 10, abs=0.05)
    assert seen.speed_mps[0] == pytest.approx(10.0)
    assert (seen.length_m == 5.0).all()


def test_the_first_of_a_queue_starts_when_its_light_turns_green(by_hand: MeasuredData) -> None:
    """A car of 5 m stands at 489 m from 52 s on; its light is green from 60 s on."""
    assert by_hand.trajectories is not None
    assert by_hand.periods[0].signals["C"][3] == (60.0, "rG")
    car = by_hand.trajectories.filter(pl.col("vehicle_id") == "east.0").sort("time_s")
    stood = car.filter(pl.col("speed_mps") == 0.0)
    assert stood["time_s"].to_list() == [52.0 + i for i in range(9)]
    assert stood["position_m"].unique().to_list() == [489.0]
    moving = car.filter(pl.col("time_s").is_between(61.0, 63.0))
    assert moving["speed_mps"].to_list() == [2.5, 5.0, 7.5]  # 2.5 m/s² from 60 s on
    # The rear is at 484 m and leaves the loop at 487.5 m: 2.5 m until 61 s, then 1 m at 5 m/s.
    assert by_hand.periods[0].passages["stop:W_C_0"].off_s[0] == pytest.approx(61.2, abs=0.005)


def test_the_clock_of_the_detectors_is_written(by_hand: MeasuredData, tmp_path: Path) -> None:
    assert {detector.clock for detector in by_hand.detectors} == {"signals"}
    directory = write_measured(by_hand, tmp_path / "measured")
    table = pl.read_csv(directory / "detectors.csv")
    assert table.columns[-1] == "clock" and set(table["clock"]) == {"signals"}


def test_the_plan_of_the_controller_is_logged(by_hand: MeasuredData) -> None:
    period = by_hand.periods[0]
    turns = tuple((20.0 * i, ("Gr", "rG")[i % 2]) for i in range(10))
    assert period.signals == {"C": turns}
    assert (period.begin_s, period.end_s, period.split) == (0.0, 200.0, "fit")


def test_lanes_sum_up_the_tracks(by_hand: MeasuredData) -> None:
    assert by_hand.lanes is not None
    assert by_hand.trajectories is not None
    assert by_hand.lanes.height == 4 * 200  # two roads before, two behind
    at = by_hand.lanes.filter((pl.col("lane_id") == "S_C_0") & (pl.col("time_s") == 30.0))
    # Cars of 0 and 20 s, both at 10 m/s.
    assert at.row(0, named=True) == {
        "period_id": "day1", "time_s": 30.0, "lane_id": "S_C_0",
        "vehicles": 2.0, "halting": 0.0, "mean_speed_mps": 10.0,
    }  # fmt: skip
    outside = by_hand.trajectories.filter(pl.col("lane_id").str.starts_with(":"))
    assert by_hand.lanes["vehicles"].sum() == by_hand.trajectories.height - outside.height
    assert by_hand.lanes["halting"].sum() > 0


def test_a_programme_is_logged_as_sumo_runs_it(data: Path) -> None:
    found = measure(data / "crossing", policy="programme")
    shown = found.periods[0].signals["C"]
    assert shown[:4] == ((0.0, "Gr"), (40.0, "rG"), (50.0, "Gr"), (90.0, "rG"))


def test_a_programme_is_logged_until_the_last_decision_ends(data: Path) -> None:
    (period,) = measure(data / "crossing", policy="programme", duration_s=95).periods
    assert period.end_s == 90.0
    assert period.signals["C"] == ((0.0, "Gr"), (40.0, "rG"), (50.0, "Gr"))


def test_an_offset_shifts_the_programme(crossing: Crossing) -> None:
    directory = crossing(edit=lambda text: text.replace('offset="0"', 'offset="7"'))
    shown = measure(directory, policy="programme").periods[0].signals["C"]
    assert shown[0] == (0.0, "rG")
    assert shown[1:3] == ((7.0, "Gr"), (47.0, "rG"))


def test_an_actuated_programme_is_logged_as_it_ran(crossing: Crossing) -> None:
    directory = crossing(
        edit=lambda text: text.replace('id="C" type="static"', 'id="C" type="actuated"').replace(
            'duration="40"', 'duration="40" minDur="5" maxDur="60"'
        )
    )
    shown = measure(directory, policy="programme").periods[0].signals["C"]
    assert shown[0] == (0.0, "Gr")
    assert len(shown) > 1
    assert shown[1][0] != 40.0


def test_the_same_arguments_give_the_same_data(crossing: Crossing) -> None:
    directory = crossing()
    first = measure(directory, periods=3)
    assert measure(directory, periods=3, workers=3).hash == first.hash
    assert measure(directory, periods=3, seed=1).hash != first.hash
    assert [period.split for period in first.periods] == ["fit", "fit", "heldout"]
    counts = {sum(map(len, period.passages.values())) for period in first.periods}
    assert len(counts) > 1, "days do not differ"


def test_an_effect_shows_in_what_is_measured(crossing: Crossing) -> None:
    directory = crossing()
    fast = measure(directory, same_demand=True)
    slow = measure(directory, "acceleration=0.5", same_demand=True)
    assert fast.periods[0].signals == slow.periods[0].signals
    before, after = (item.periods[0].passages["exit:C_N_0"] for item in (fast, slow))
    assert after.speed_mps.mean() < before.speed_mps.mean() - 1


def test_controllers_log_the_green_they_command_though_traffic_starts_late(data: Path) -> None:
    in_time = measure(data / "crossing", same_demand=True).periods[0]
    late = measure(data / "crossing", "late_green=*,4", same_demand=True).periods[0]
    assert late.signals == in_time.signals
    before, after = (item.passages["exit:C_E_0"] for item in (in_time, late))
    assert after.on_s[0] == pytest.approx(before.on_s[0] + 4, abs=1)
    own = measure(data / "crossing", "late_green=*,4", "programme", same_demand=True).periods[0]
    assert own.signals["C"][:2] == ((0.0, "Gr"), (40.0, "rG"))


def test_effects_on_detectors_show_in_what_is_measured(data: Path) -> None:
    true = measure(data / "crossing", same_demand=True).periods[0].passages
    shifted = measure(data / "crossing", "signal_clock=C,3", same_demand=True).periods[0].passages
    assert shifted["advance:S_C_0"].on_s == pytest.approx(true["advance:S_C_0"].on_s + 3)
    swapped = "swapped=advance:S_C_0,advance:W_C_0"
    seen = measure(data / "crossing", swapped, same_demand=True).periods[0].passages
    assert (seen["advance:S_C_0"].on_s == true["advance:W_C_0"].on_s).all()


def test_effects_on_detectors_may_stand_in_the_scenario_file(
    crossing: Crossing, tmp_path: Path
) -> None:
    plain = crossing()
    listed = tmp_path / "listed-v1"
    shutil.copytree(plain, listed)
    with (listed / "scenario.toml").open("a") as file:
        file.write('[[effects]]\nname = "undercount"\nplace = "*"\nshare = 0.4\n')
        file.write('[[effects]]\nname = "acceleration"\nmps2 = 1.0\n')
        file.write('[[effects]]\nname = "signal_clock"\nplace = "C"\nseconds = 3.0\n')
    given = "undercount=*,0.4+acceleration=1+signal_clock=C,3"
    seen = measure(plain, given, same_demand=True).hash
    assert measure(listed, same_demand=True).hash == seen
    assert measure(plain, str(listed), same_demand=True).hash == seen
    more = "stuck=stop:S_C_0,20,50"
    seen = measure(plain, f"{given}+{more}", same_demand=True).hash
    assert measure(listed, more, same_demand=True).hash == seen


@pytest.mark.parametrize(
    ("domain", "error", "says"),
    [
        ("undercount=stop:S_C_7,0.4", UnknownNameError, "'stop:S_C_7'"),
        ("meso", OptionError, "who comes over a detector.*leave out queue_model"),
    ],
)
def test_what_cannot_be_recorded_is_told_before_anything_is_simulated(
    data: Path, monkeypatch: pytest.MonkeyPatch, domain: str, error: type[Exception], says: str
) -> None:
    def simulated(*_: Any) -> None:
        pytest.fail("it was simulated")

    monkeypatch.setattr("ugat_marl.experiments.recording.days.own_programmes", simulated)
    monkeypatch.setattr("ugat_marl.experiments.recording.days.play", simulated)
    with pytest.raises(error, match=says):
        measure(data / "crossing", domain)


def test_no_vehicle_comes_on_two_days(data: Path) -> None:
    # Effects choose vehicles by name; the trucks of one day are not those of the next.
    days = measure(data / "crossing", periods=2, trajectories=True).trajectories
    assert days is not None
    one, two = (set(day["vehicle_id"]) for day in days.partition_by("period_id"))
    assert one
    assert two
    assert not one & two


def test_drivers_park_at_other_times_every_day(data: Path) -> None:
    days = measure(data / "crossing", "parking=S_C_0,60,5", periods=2, trajectories=True)
    assert days.trajectories is not None
    parked = days.trajectories.filter(pl.col("vehicle_id").str.starts_with("parking."))
    times = [set(day["time_s"]) for day in parked.partition_by("period_id")]
    assert len(times) == 2
    assert times[0] != times[1]


def test_another_scenario_can_be_the_world(crossing: Crossing) -> None:
    own = crossing()
    other = crossing(edit=lambda text: text.replace('speed="10', 'speed="5'))
    seen = measure(own, str(other)).periods[0].passages["advance:S_C_0"]
    assert seen.speed_mps.max() <= 5.01


def test_another_scenario_may_have_any_name(crossing: Crossing, tmp_path: Path) -> None:
    own = crossing()
    same = shutil.copytree(own, tmp_path / "headway=1.4")
    assert measure(own, str(same)).hash == measure(own).hash


def test_zones_end_where_the_points_are(data: Path) -> None:
    zones = measure(data / "crossing", same_demand=True, detector_length_m=6.0)
    points = measure(data / "crossing", same_demand=True)
    for zone, point in zip(zones.detectors, points.detectors, strict=True):
        assert (zone.id, zone.length_m) == (point.id, 6.0)
        assert zone.position_m + 6.0 == pytest.approx(point.position_m)
    wide, narrow = (item.periods[0].passages["advance:S_C_0"] for item in (zones, points))
    assert (narrow.on_s - wide.on_s)[0] == pytest.approx(0.6, abs=0.05)
    assert wide.off_s[0] == pytest.approx(narrow.off_s[0], abs=0.05)


def test_detectors_may_measure_no_speeds(data: Path) -> None:
    found = measure(data / "crossing", speeds=False)
    assert found.has_events
    assert not found.has_speeds
    lengths = [item.length_m for item in found.periods[0].passages.values()]
    assert np.isnan(np.concatenate(lengths)).all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"periods": 0},
        {"seed": -1},
        {"detector_length_m": -1.0},
        {"detector_length_m": math.nan},
        {"workers": 0},
        {"workers": -2},
    ],
)
def test_impossible_requests_are_refused(data: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match="must"):
        measure(data / "crossing", **wrong)


def test_what_is_written_is_read_again(data: Path, tmp_path: Path) -> None:
    scenario = load_scenario(data / "crossing")
    found = measure(data / "crossing", periods=3, lanes=True, trajectories=True)
    write_measured(found, tmp_path / "measured")
    again = read_measured(tmp_path / "measured", scenario, Network.read(scenario))
    assert again.hash == found.hash


def test_the_command_writes_a_directory(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "measured"
    call = ["record", str(data / "crossing"), "--periods", "2", "--no-speeds", "--out", str(out)]
    assert main(call) == 0
    assert "over 6 detectors in 2 period(s)" in capsys.readouterr().out
    tables = {"periods.csv", "detectors.csv", "signals.parquet", "detections.parquet"}
    assert {path.name for path in out.iterdir()} == {*tables, "row-hashes.json"}


def test_a_foreign_directory_is_refused_before_anything_is_measured(
    data: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def measured(*_: Any, **__: Any) -> None:
        pytest.fail("it was measured")

    monkeypatch.setattr("ugat_marl.cli.record.record", measured)
    (tmp_path / "thesis.tex").write_text("years of work")
    call = ["record", str(data / "crossing"), "--out", str(tmp_path)]
    assert main(call) == 2
    assert "'thesis.tex'" in capsys.readouterr().err
    for wrong in (["nowhere-v1"], [call[1], "--domain", "V9"], [call[1], "--policy", "nobody"]):
        assert main(["record", *wrong, "--out", str(tmp_path / "new")]) == 2
        assert not (tmp_path / "new").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"periods": 0}, "periods = 0: must be at least 1$"),
        ({"workers": 0}, "workers = 0: must be at least 1"),
        ({"duration_s": 9000.0}, "duration_s = 9000: scenario 'single-v1' lasts 3600 s"),
    ],
)
def test_impossible_days_are_refused(options: Mapping[str, Any], says: str) -> None:
    with pytest.raises(OptionError, match=says):
        record(load_scenario("single-v1"), "sim", policy_factory("fixed-time"), **options)


def test_days_of_the_same_demand_do_not_vary(data: Path) -> None:
    with pytest.raises(OptionError, match="leave day_to_day out"):
        measure(data / "crossing", same_demand=True, day_to_day=0.2)


@pytest.mark.parametrize(("metres", "warned"), [(2, False), (6, True)])
def test_a_zone_that_ends_with_its_lane_is_noted(data: Path, metres: int, warned: bool) -> None:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        record(
            load_scenario(data / "crossing"),
            f"detector_zone=stop,{metres}",
            policy_factory("fixed-time:20"),
            periods=1,
            workers=1,
            duration_s=60,
        )
    assert any("beyond the end of the lane" in str(one.message) for one in told) is warned
