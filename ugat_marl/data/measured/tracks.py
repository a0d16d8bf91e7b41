"""Passages of vehicles over detectors, read off trajectories of all vehicles.

Video and drones see positions, not detectors. The detectors of ``detectors.csv`` are then lines on
the street at which the passages are read off.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.measured.passages import passages_as_written
from ugat_marl.data.measured.values import Finding
from ugat_marl.errors import MeasuredDataError, counted
from ugat_marl.scenarios import Detector, Passages, Period, edge_of_lane

COARSEST_S = 2.0
"""Largest usual time between two positions of a vehicle. A vehicle is over a detector for less than
a second, so positions farther apart say little of the moment."""
LOST_S = 5.0
"""Time without a position after which a vehicle counts as another one, unless it came as far as its
speeds tell. By hand. Twice as long: places are guessed over 100 m of a street."""
USUAL_LENGTH_M = 5.0
"""Length of a vehicle whose length is not stated, m: that of a car in SUMO."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Track:
    """Positions of one vehicle in order of time; all arrays ``(positions,)``.

    Attributes:
        time_s: Time, s.
        lane: Lane of the front.
        position_m: Position of the front on its road, m. Without jitter: it never goes back.
        speed_mps: Speed, m/s.
        driven_m: Distance from the first position, m.
        length_m: Length of the vehicle, m.
    """

    time_s: Array
    lane: list[str]
    position_m: Array
    speed_mps: Array
    driven_m: Array
    length_m: float

    @classmethod
    def of(cls, rows: pl.DataFrame) -> _Track:
        """Make a track from the rows of one vehicle in one period, in order of time."""
        time, position, speed = (
            rows[name].to_numpy() for name in ("time_s", "position_m", "speed_mps")
        )
        lane = rows["lane_id"].to_list()
        # The lanes of a road count their metres alike.
        road = [edge_of_lane(name) for name in lane]
        same = np.array([a == b for a, b in zip(road, road[1:], strict=False)], np.bool_)
        # Positions of cameras jitter, and a vehicle that stands must not drive by that.
        ahead = position.copy()
        for part in np.split(ahead, np.flatnonzero(~same) + 1):
            np.maximum.accumulate(part, out=part)
        # Between two roads, and on the junction between them, only the speed tells the distance.
        driven = 0.5 * (speed[1:] + speed[:-1]) * np.diff(time)
        step = np.where(same, np.diff(ahead), driven)
        least = np.where(same, 0.0, 1e-6)  # on another road it has driven, even at a speed of 0
        total = np.concatenate(([0.0], np.cumsum(np.maximum(step, least))))
        return cls(time, lane, ahead, speed, total, _length_m(rows))

    def stays(self) -> Iterable[tuple[str, int, int]]:
        """Yield each lane with the first position on it and the first one behind it."""
        begin = 0
        for index in range(1, len(self.lane) + 1):
            if index == len(self.lane) or self.lane[index] != self.lane[begin]:
                yield self.lane[begin], begin, index
                begin = index

    def passage(
        self, detector: Detector, begin: int, end: int, until_s: float
    ) -> tuple[float, ...] | None:
        """Return on and off in s, speed in m/s and length in m; None if it does not come over.

        A vehicle that is on the zone when it is first seen has no on (NaN), and one that is there
        at the end of all positions no off (infinite). One that is lost from sight on the zone
        leaves it then.

        Args:
            detector: A detector on the lane.
            begin: Index of the first position on the lane.
            end: Index behind the last one.
            until_s: Time of the last position of any vehicle in the period, s.
        """
        start = self.driven_m[begin] - self.position_m[begin]  # distance at the start of the lane
        first, last = begin, end - 1
        # A vehicle that comes from another road entered the lane between two positions. One that
        # changes lanes is on the old one until its first position on the new one.
        if begin and self._turned(begin):
            first = begin - 1
            # The speed may tell less of the way than the place on the new lane does.
            start = max(start, self.driven_m[first] + 1e-6 - detector.position_m)
        at_m = start + detector.position_m
        if end < len(self.lane):
            last = end
            if self._turned(end):
                # On another road it has passed all of the lane, even if its speeds tell less.
                at_m = min(at_m, self.driven_m[end])
        on = self._when(at_m, first, last)
        off = self._when(at_m + detector.length_m + self.length_m, first, len(self.lane) - 1)
        on_it = at_m <= self.driven_m[0]
        if on is None and first == 0 and on_it and off is not None:
            on = np.nan
        if on is None:
            return None
        if off is None:
            off = np.inf if self.time_s[-1] >= until_s else float(self.time_s[-1])
        left_s = off if np.isfinite(off) else on
        at = {"front": (on,), "mean": (on, left_s)}.get(detector.speed_at or "rear", (left_s,))
        speed = float(np.mean(np.interp(at, self.time_s, self.speed_mps)))
        return on, off, speed, self.length_m

    def _turned(self, index: int) -> bool:
        """Return True if a position is on another road than the one before."""
        return edge_of_lane(self.lane[index]) != edge_of_lane(self.lane[index - 1])

    def _when(self, distance_m: float, first: int, last: int) -> float | None:
        """Return when the vehicle has driven a distance; None if not between two positions."""
        driven = self.driven_m[first : last + 1]
        index = int(np.searchsorted(driven, distance_m))
        if index == 0 or index == len(driven):
            return None
        low, high = driven[index - 1], driven[index]
        begin, end = self.time_s[first + index - 1], self.time_s[first + index]
        return float(begin + (end - begin) * (distance_m - low) / (high - low))


def step_of_tracks(vehicles: pl.DataFrame) -> float:
    """Return the usual time between two positions of a vehicle, s; 0 if no vehicle has two.

    Args:
        vehicles: Rows of trajectories: ``period_id, vehicle_id, time_s``.
    """
    steps = (
        vehicles.sort("time_s")
        .select(pl.col("time_s").diff().over("period_id", "vehicle_id"))["time_s"]
        .drop_nulls()
    )
    return float(steps.median() or 0.0) if len(steps) else 0.0  # pyright: ignore[reportArgumentType]


def passages_of_tracks(
    path: Path,
    vehicles: pl.DataFrame,
    periods: Sequence[Period],
    detectors: Sequence[Detector],
    findings: list[Finding],
) -> tuple[dict[str, Passages], ...]:
    """Read passages over detectors off the trajectories of all vehicles.

    Args:
        path: File of the trajectories.
        vehicles: Its rows: ``period_id, vehicle_id, time_s, lane_id, position_m, speed_mps``, and
            perhaps ``length_m``.
        periods: The periods.
        detectors: The detectors.
        findings: Findings; how the passages were made is added to them.

    Returns:
        For each period, detector to its passages.

    Raises:
        MeasuredDataError: Positions are too far apart in time, or no vehicle comes over a detector.
    """
    by_lane: dict[str, list[Detector]] = {}
    for detector in detectors:
        for lane in detector.lanes:
            by_lane.setdefault(lane, []).append(detector)
    step = step_of_tracks(vehicles)
    if step > COARSEST_S:
        raise MeasuredDataError(
            f"{path}: positions every {step:g} s, and no detections; passages over detectors need "
            f"positions at most {COARSEST_S:g} s apart. Add detections or counts, or write the "
            "times between two places as travel_times"
        )
    found: list[dict[str, Passages]] = []
    apart = 0
    for period in periods:
        rows, again = _crossings(vehicles.filter(pl.col("period_id") == period.id), by_lane)
        apart += again
        seen = {detector.id: _over(detector, rows) for detector in detectors}
        found.append(
            {
                name: passages_as_written(passages, period.begin_s, period.end_s)
                for name, passages in seen.items()
                if passages is not None
            }
        )
    if not any(found):
        raise MeasuredDataError(
            f"{path}: no vehicle comes over a detector of detectors.csv; check lane_id and "
            "position_m there"
        )
    has_lengths = "length_m" in vehicles.columns and vehicles["length_m"].count()
    assumed = "" if has_lengths else f", with vehicles taken to be {USUAL_LENGTH_M:g} m long"
    findings.append(
        Finding(
            f"{path.name}: no detections; passages over the detectors are read off the "
            f"trajectories{assumed}. Trajectories of a part of the vehicles would look like less "
            "demand"
        )
    )
    if apart:
        findings.append(
            Finding(
                f"{path.name}: {counted(apart, 'time')} a vehicle_id comes back after {LOST_S:g} s "
                "without a position at a place that its speeds do not tell, or farther back on its "
                "road; it counts as another vehicle then"
            )
        )
    return tuple(found)


def _length_m(rows: pl.DataFrame) -> float:
    """Return the length of a vehicle from its rows."""
    known = rows["length_m"].drop_nulls() if "length_m" in rows.columns else []
    return float(known[0]) if len(known) else USUAL_LENGTH_M


def _parted(rows: pl.DataFrame) -> Iterable[pl.DataFrame]:
    """Yield the rows of one id in parts, each of one vehicle that was never lost from sight.

    Where it was unseen for long, it is the same one if it came as far as its speeds tell.
    """
    time, position, speed = (
        rows[name].to_numpy() for name in ("time_s", "position_m", "speed_mps")
    )
    road = np.array([edge_of_lane(name) for name in rows["lane_id"]])
    same, step_s, way = road[1:] == road[:-1], np.diff(time), np.diff(position)
    back = same & (way < -_length_m(rows))
    slow, fast = np.minimum(speed[1:], speed[:-1]), np.maximum(speed[1:], speed[:-1])
    as_told = same & (way >= (0.5 * slow - 1.0) * step_s) & (way <= (1.5 * fast + 1.0) * step_s)
    cuts = np.flatnonzero(back | ((step_s > LOST_S) & ~as_told)) + 1
    for begin, end in itertools.pairwise((0, *cuts.tolist(), len(rows))):
        yield rows[begin:end]


def _crossings(
    vehicles: pl.DataFrame, by_lane: Mapping[str, Sequence[Detector]]
) -> tuple[dict[tuple[str, str], list[tuple[float, ...]]], int]:
    """Return detector and lane to the passages of all vehicles of a period there.

    The second value is how often an id came back as another vehicle.
    """
    rows: dict[tuple[str, str], list[tuple[float, ...]]] = {}
    until_s = float(vehicles["time_s"].to_numpy().max(initial=-np.inf))
    wholes = vehicles.partition_by("vehicle_id", maintain_order=True)
    parts = [part for whole in wholes for part in _parted(whole.sort("time_s"))]
    for part in parts:
        track = _Track.of(part)
        for lane, begin, end in track.stays():
            for detector in by_lane.get(lane, ()):
                if (passage := track.passage(detector, begin, end, until_s)) is not None:
                    rows.setdefault((detector.id, lane), []).append(passage)
    return rows, len(parts) - len(wholes)


def _over(
    detector: Detector, rows: Mapping[tuple[str, str], list[tuple[float, ...]]]
) -> Passages | None:
    """Return the passages over a detector, from those over each of its lanes; None without any."""
    keys = [(detector.id, lane) for lane in detector.lanes]
    lanes = [_passages(rows[key]) for key in keys if key in rows]
    if len(lanes) > 1:
        return Passages.together(lanes)
    return lanes[0] if lanes else None


def _passages(rows: list[tuple[float, ...]]) -> Passages:
    rows = sorted(rows, key=lambda row: row[1] if np.isnan(row[0]) else row[0])
    table = np.array(rows, dtype=np.float64)
    return Passages(*np.round(table.T, 3))
