"""Passages read off trajectories: closed forms, and those of the loops of the same simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import MeasuredData, read_measured, write_measured
from ugat_marl.data.measured.tracks import passages_of_tracks
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


def test_a_vehicle_that_changes_lanes_behind_a_detector_was_not_on_it() -> None:
    rows = track(["a_0", "a_0", "a_1", "a_1"], [0.0, 10.0, 20.0, 30.0], 10.0)
    detectors = [Detector(f"{x}", f"a_{x}", 5.0, 0.0, "advance") for x in (0, 1)]
    assert set(passages(rows, *detectors)) == {"0"}


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
