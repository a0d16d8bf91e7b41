"""Detectors as SUMO's instant induction loops: written as XML, and their passages read back."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import SimulatorError
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import (
    Detector,
    DetectorKind,
    Document,
    Lane,
    Network,
    Passages,
    SpeedPoint,
)

STOP_SETBACK_M = 2.5
"""Distance of stop detectors upstream of the stop line. The first vehicle of a queue stands on the
detector, and its rear leaves the detector after a real start. Closer to the line, small changes
shift the times by seconds."""
ADVANCE_SETBACK_M = 50.0
EXIT_DISTANCE_M = 10.0

LANE_END_M = 0.1
"""Least distance of a loop from an end of its lane, m."""
_EVENT = re.compile(
    rb'id="([^"]*)" time="([\d.]+)" state="(enter|leave)" vehID="([^"]*)" '
    rb'speed="([-\d.]+)" length="([\d.]+)"'
)
_END = "@end"


def standard_detectors(network: Network) -> tuple[Detector, ...]:
    """Return advance and stop detectors on incoming lanes, exit detectors on outgoing ones."""
    places: dict[tuple[str, DetectorKind], float] = {}
    for intersection in network.intersections:
        for name in intersection.incoming_lanes:
            length = network.lanes[name].length_m
            places[name, "advance"] = max(length - ADVANCE_SETBACK_M, min(10.0, 0.3 * length))
            places[name, "stop"] = max(length - STOP_SETBACK_M, 0.6 * length)
        for name in intersection.outgoing_lanes:
            places[name, "exit"] = min(EXIT_DISTANCE_M, 0.5 * network.lanes[name].length_m)
    return tuple(
        Detector(f"{kind}:{lane}", lane, round(position, 2), 0.0, kind)
        for (lane, kind), position in places.items()
    )


def detectors_document(
    detectors: Sequence[Detector], lanes: Mapping[str, Lane] | None, file: Path
) -> Document:
    """Return an additional file with the loops of the detectors, which write to `file`.

    A zone has two loops: vehicles enter it at its upstream end and leave it at its downstream end.

    Args:
        detectors: Detectors to simulate.
        lanes: Lanes by id, used to keep zones on their lanes; or None.
        file: Absolute path of SUMO's output.
    """
    root = ET.Element("additional")
    for detector, number, lane in _zones(detectors):
        last_m = np.inf if lanes is None else lanes[lane].length_m - LANE_END_M
        name = _loop(detector, number)
        ends = {name: min(detector.position_m, last_m)}
        if detector.length_m > 0:
            ends[name + _END] = min(detector.position_m + detector.length_m, last_m)
        for loop, position in ends.items():
            add_loop(root, loop, lane, position, file)
    return Document("loops.add.xml", None, xml_bytes(root))


def add_loop(root: ET.Element, name: str, lane: str, position_m: float, file: Path) -> None:
    """Add a loop on a lane that writes each event to `file`."""
    place = {"id": name, "lane": lane, "pos": f"{position_m:.3f}", "file": str(file)}
    ET.SubElement(root, "instantInductionLoop", place)


def events_in(file: Path, what: str) -> bytes:
    """Return what the loops of a simulation wrote.

    Args:
        file: SUMO's output.
        what: What the loops stand for, in the message.

    Raises:
        SimulatorError: SUMO did not write the file.
    """
    try:
        return file.read_bytes()
    except OSError as error:
        raise SimulatorError(f"SUMO's {what} cannot be read ({error.strerror})") from None


def _zones(detectors: Sequence[Detector]) -> list[tuple[Detector, int, str]]:
    """Return every lane of every detector, with its number in the zone."""
    return [(one, number, lane) for one in detectors for number, lane in enumerate(one.lanes)]


def _loop(detector: Detector, number: int) -> str:
    """Return the id of the loop on a lane of a zone."""
    return f"{detector.id}@{number}" if number else detector.id


def read_passages(
    file: Path, detectors: Sequence[Detector], begin_s: float, end_s: float, step_s: float
) -> dict[str, Passages]:
    """Read the passages over detectors between two times; detectors without passages are left out.

    Times are those of each detector's own clock, see `Detector.clock`.

    Args:
        file: SUMO's output.
        detectors: The detectors of `detectors_document`.
        begin_s: Begin, on the scenario's clock.
        end_s: End, on the scenario's clock.
        step_s: Length of a simulation step, s.

    Raises:
        SimulatorError: SUMO did not write the file.
    """
    content = events_in(file, "detections")
    rows: dict[bytes, list[tuple[float, bool, bytes, float, float]]] = defaultdict(list)
    last_at: dict[bytes, bytes] = {}  # vehicle to the loop of its last event
    for name, time, state, vehicle, speed, length in _EVENT.findall(content):
        rows[name].append((float(time), state == b"enter", vehicle, float(speed), float(length)))
        last_at[vehicle] = name
    by_detector: dict[str, Passages] = {}
    for detector in detectors:
        by_lane: list[Passages] = []
        for number in range(len(detector.lanes)):
            first = _loop(detector, number).encode()
            last = first + _END.encode() if detector.length_m > 0 else first
            speed_at = detector.speed_at or "rear"
            gone = {row[2] for row in rows[first] if last_at[row[2]] not in (first, last)}
            by_lane.append(_passages(rows[first], rows[last], speed_at, gone))
        passages = by_lane[0] if len(by_lane) == 1 else Passages.together(by_lane)
        passages = _clipped(delayed(passages, (1 - detector.steps_early) * step_s), begin_s, end_s)
        if len(passages):
            by_detector[detector.id] = passages
    return by_detector


def _passages(
    front: list[tuple[float, bool, bytes, float, float]],
    rear: list[tuple[float, bool, bytes, float, float]],
    speed_at: SpeedPoint,
    gone: Collection[bytes],
) -> Passages:
    """Pair each entry at the upstream end with the exit of the same visit at the downstream end.

    The exit of a visit is the first one at or after its entry, and before the next entry of the
    vehicle. The speed of a visit without an entry is that of the rear, whatever `speed_at` says.

    Args:
        front: Events at the upstream end: time, True for an entry, vehicle, speed and length.
        rear: Events at the downstream end.
        speed_at: Where the speed is measured.
        gone: Vehicles that were seen elsewhere last.

    Returns:
        Passages, sorted by time. A visit without an entry is on since minus infinity. One without
        an exit is on for ever, or has no off (NaN) if the vehicle is gone.
    """
    left: dict[bytes, list[tuple[float, float]]] = defaultdict(list)
    for time, enters, vehicle, speed, _ in rear:
        if not enters:
            left[vehicle].append((time, speed))
    rows: list[tuple[float, float, float, float]] = []
    # A vehicle inserted on the loop, or one that changed lanes onto it, leaves without entering.
    strays: list[tuple[float, float]] = []
    for time, enters, vehicle, speed, length in reversed(front):  # so that the last entry is first
        if enters:
            exits, speed_off = left[vehicle], speed
            off = np.nan if vehicle in gone else np.inf
            while exits and exits[-1][0] >= time:
                if np.isfinite(off):
                    strays.append((off, speed_off))
                off, speed_off = exits.pop()
            seen = {"front": speed, "rear": speed_off, "mean": 0.5 * (speed + speed_off)}[speed_at]
            rows.append((time, off, seen, length))
    rows.reverse()
    for exits in (*left.values(), strays):
        rows += [(-np.inf, time, speed, np.nan) for time, speed in exits]
    if not rows:
        return Passages.none()
    rows.sort(key=lambda row: row[0] if np.isfinite(row[0]) else row[1])
    table = np.array(rows, dtype=np.float64)
    return Passages(table[:, 0], table[:, 1], table[:, 2], table[:, 3])


def delayed(passages: Passages, delay_s: float) -> Passages:
    """Return the passages with later stamps.

    Args:
        passages: Passages over a detector.
        delay_s: Time that is added to all stamps, s; negative for earlier ones.
    """
    return replace(passages, on_s=passages.on_s + delay_s, off_s=passages.off_s + delay_s)


def _clipped(passages: Passages, begin_s: float, end_s: float) -> Passages:
    """Return the passages between two times; times outside of them become NaN."""
    if not len(passages):
        return passages
    inside = (passages.off_s >= begin_s) & (passages.on_s < end_s)
    # An exit without an entry, or an entry without an exit, counts by its own time.
    inside &= np.isfinite(passages.on_s) | (passages.off_s < end_s)
    inside |= np.isnan(passages.off_s) & (passages.on_s >= begin_s) & (passages.on_s < end_s)
    kept = passages.at(inside)
    return Passages(
        _known(kept.on_s, kept.on_s >= begin_s),
        _known(kept.off_s, kept.off_s < end_s),
        kept.speed_mps,
        kept.length_m,
    )


def _known(times: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.where(known, times, np.nan)
