"""Passages of vehicles from rows of on and off events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.measured.copies import FEWEST, TWICE, overlapping
from ugat_marl.data.measured.tables import PERIOD, in_order, refuse
from ugat_marl.data.measured.values import Finding
from ugat_marl.errors import MeasuredDataError, nearest
from ugat_marl.scenarios import Detector, Passages, Period

MOST_UNPAIRED = 0.5
"""Largest share of events without a partner. A detector with more is not used."""
FEW = 0.01
"""Largest share of impossible values that is left out. A larger share means a wrong unit."""
FASTEST_MPS = 70.0
"""Largest plausible speed (250 km/h)."""
LONGEST_M = 40.0
"""Largest plausible length of a vehicle."""
MOST_SHARED = 0.5
"""From this share of equal detections on, two periods hold the same recording."""
MOST_SHARED_SECONDS = 0.9
"""The same if nearly all times are a second apart, or several. A queue leaves a fixed programme in
nearly the same seconds every day."""

DOUBLED_PART_S = 900.0
"""Length of the parts of a period in which two recordings on top of each other are looked for."""
DOUBLED_SHARE = 0.05
"""Share of events without a partner from which on they may lie on top of each other."""
DOUBLED_DETECTORS = 0.75
"""Share of the busy detectors at which there must be such events."""

IMPUTED_S = 2.0
"""Longest time between two ons in a row that count as two vehicles. The first one then gets its off
at the second on. ODOT's `atspm` (queries of split failures) does the same."""


@dataclass(frozen=True, eq=False)
class _Stream:
    """Events of detectors, sorted by stream and time; all arrays ``(events,)``.

    Attributes:
        key: Number of the stream: period times the number of detectors, plus detector.
        time: Time, s.
        is_on: True for on, False for off.
        speed: Speed, m/s; NaN if not measured.
        length: Length of the vehicle, m; NaN if not measured.
    """

    key: NDArray[np.int64]
    time: NDArray[np.float64]
    is_on: NDArray[np.bool_]
    speed: NDArray[np.float64]
    length: NDArray[np.float64]


def passages_of(
    path: Path,
    frame: pl.DataFrame,
    periods: Sequence[Period],
    detectors: Sequence[Detector],
    findings: list[Finding],
) -> tuple[tuple[dict[str, Passages], ...], frozenset[str]]:
    """Pair on and off events to the vehicles over every detector.

    Args:
        path: The file.
        frame: Its rows, with `PERIOD`.
        periods: The periods.
        detectors: The detectors.
        findings: Findings; events that are left out or filled in are added to them.

    Returns:
        For each period, detector to its passages; and the ids of detectors that cannot be used.

    Raises:
        MeasuredDataError: An event is unknown, no detector is known, speeds or lengths are
            impossible, or two periods share detections.
    """
    refuse(
        path,
        frame.filter(~pl.col("event").is_in(["on", "off"])),
        "event",
        "is unknown",
        "write on or off",
    )
    names = [detector.id for detector in detectors]
    frame = _known(path, frame, names, findings)
    frame = frame.with_columns(
        _plausible(path, frame, "speed_mps", FASTEST_MPS, findings),
        _plausible(path, frame, "length_m", LONGEST_M, findings),
    )
    once = frame.unique(["key", "time_s", "event"], keep="first", maintain_order=True)
    if once.height < frame.height:
        findings.append(
            Finding(
                f"{path.name}: {frame.height - once.height} of {frame.height} rows are there "
                "twice; they count once"
            )
        )
    stream = _sorted(path, once, findings)
    _refuse_copies(path, stream, periods, len(names))
    paired, broken = _pair(path, stream, periods, names, findings)
    return _split(paired, periods, names, broken), frozenset(names[i] for i in broken)


def _known(
    path: Path, frame: pl.DataFrame, names: Sequence[str], findings: list[Finding]
) -> pl.DataFrame:
    """Return the rows of known detectors, with the number of their stream as ``key``."""
    index = {name: i for i, name in enumerate(names)}
    code = pl.col("detector_id").replace_strict(index, default=None, return_dtype=pl.Int64)
    frame = frame.with_columns((pl.col(PERIOD).cast(pl.Int64) * len(names) + code).alias("key"))
    unknown = frame.filter(pl.col("key").is_null())
    if unknown.is_empty():
        return frame
    others = unknown["detector_id"].unique(maintain_order=True).to_list()
    near = nearest(others[0], names)
    listed = ", ".join(map(repr, others[:5])) + (" ..." if len(others) > 5 else "")
    if unknown.height == frame.height:
        raise MeasuredDataError(
            f"{path}: no row is of a detector in detectors.csv; the rows are of {listed}"
            + (f" (is {others[0]!r} {near!r}?)" if near else "")
        )
    findings.append(
        Finding(
            f"{path.name}: {unknown.height} rows are of detectors that detectors.csv does not "
            f"list ({listed}); they are left out"
        )
    )
    return frame.filter(pl.col("key").is_not_null())


def _plausible(
    path: Path, frame: pl.DataFrame, column: str, most: float, findings: list[Finding]
) -> pl.Series:
    """Return a column of speeds or lengths; missing and a few impossible values become NaN."""
    values = frame[column]
    refuse(
        path,
        frame.filter(pl.col(column) < 0),
        column,
        "is negative",
        "leave the cell empty where it was not measured",
    )
    impossible = values > most
    if column == "length_m":
        impossible |= values == 0
    count = int(impossible.sum() or 0)
    if count > FEW * max(values.len() - values.null_count(), 1) and count > 1:
        unit = "m/s" if column == "speed_mps" else "m"
        refuse(
            path,
            frame.filter(impossible),
            column,
            f"is impossible; allowed: up to {most:g} {unit}",
            f"convert the column to {unit}, or leave cells empty that were not measured",
        )
    if count:
        findings.append(Finding(f"{path.name}: {count} impossible {column} taken as not measured"))
    return values.set(impossible.fill_null(False), None).fill_null(float("nan")).alias(column)


def _sorted(path: Path, frame: pl.DataFrame, findings: list[Finding]) -> _Stream:
    key = frame["key"].to_numpy()
    time = frame["time_s"].to_numpy()
    is_on = (frame["event"] == "on").to_numpy()

    order = in_order(path, key, time, findings)
    order = order[untangled(key[order], time[order], is_on[order])]
    return _Stream(
        key[order],
        time[order],
        is_on[order],
        frame["speed_mps"].to_numpy()[order],
        frame["length_m"].to_numpy()[order],
    )


def _pair(
    path: Path,
    stream: _Stream,
    periods: Sequence[Period],
    names: Sequence[str],
    findings: list[Finding],
) -> tuple[tuple[NDArray[np.int64], Passages], frozenset[int]]:
    """Return passages with their streams, and the detectors with too many lost events."""
    key, time, is_on = stream.key, stream.time, stream.is_on
    follows = np.append(key[1:] == key[:-1], False)  # the next event is of the same stream
    leads = np.append(False, follows[:-1])
    next_on = np.append(is_on[1:], False)
    next_time = np.append(time[1:], np.nan)
    whole = is_on & follows & ~next_on
    imputed = is_on & follows & next_on & (next_time - time <= IMPUTED_S)
    open_end = is_on & ~follows
    open_begin = ~is_on & ~leads
    lost_off = is_on & follows & next_on & ~imputed
    lost_on = ~is_on & leads & np.append(False, ~is_on[:-1])
    with_on = whole | imputed | open_end
    first = np.flatnonzero(with_on | open_begin)
    on = np.where(is_on, time, np.nan)[first]
    off = np.where(is_on, np.where(open_end, np.nan, next_time), time)[first]
    partner = np.where(whole, np.arange(len(key)) + 1, np.arange(len(key)))[first]

    def of_pair(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(np.isfinite(values[partner]), values[partner], values[first])

    passages = Passages(on, off, of_pair(stream.speed), of_pair(stream.length))
    _report(path, int(imputed.sum()), int(lost_off.sum()), int(lost_on.sum()), len(first), findings)
    _report_doubled(path, stream, imputed | lost_off | lost_on, periods, len(names), findings)
    detector = key % len(names)
    events = np.bincount(detector, minlength=len(names))
    lost = np.bincount(detector[lost_off | lost_on], minlength=len(names))
    broken = frozenset(np.flatnonzero(lost > MOST_UNPAIRED * events).tolist())
    findings += [
        Finding(
            f"{path.name}: detector {names[i]!r} has no partner for {lost[i]} of {events[i]} "
            "events; it is not used"
        )
        for i in sorted(broken)
    ]
    return (key[first], passages), broken


def _report(
    path: Path, imputed: int, lost_off: int, lost_on: int, kept: int, findings: list[Finding]
) -> None:
    if imputed:
        findings.append(
            Finding(
                f"{path.name}: {imputed} times on follows on within {IMPUTED_S:g} s; the off in "
                "between was filled in"
            )
        )
    if lost_off or lost_on:
        findings.append(
            Finding(
                f"{path.name}: {lost_off} ons without off and {lost_on} offs without on were left "
                f"out; {kept} passages are left"
            )
        )


def _report_doubled(
    path: Path,
    stream: _Stream,
    irregular: NDArray[np.bool_],
    periods: Sequence[Period],
    detectors: int,
    findings: list[Finding],
) -> None:
    """Add a finding for a time in which two recordings seem to lie on top of each other.

    Where a clock was set back and the table then sorted, events of two hours alternate. So at
    nearly all detectors ons follow on ons and offs on offs, and at other times they do not.
    """
    period = stream.key // detectors
    begins = np.array([one.begin_s for one in periods])
    part = ((stream.time - begins[period]) // DOUBLED_PART_S).astype(np.int64)
    parts = int(part.max(initial=0)) + 1
    place = period * parts + part
    cells = place * detectors + stream.key % detectors
    size = len(periods) * parts
    events, odd = (
        np.bincount(cells, weights, size * detectors).reshape(size, detectors)
        for weights in (np.ones(len(cells)), irregular.astype(float))
    )
    busy = events >= FEWEST
    touched = (busy & (odd > 0)).sum(axis=1) >= DOUBLED_DETECTORS * np.maximum(busy.sum(axis=1), 2)
    share = odd.sum(axis=1) / np.maximum(events.sum(axis=1), 1)
    doubled = touched & (share > DOUBLED_SHARE)
    usual = odd[~doubled].sum() / max(events[~doubled].sum(), 1)
    found = (doubled & (share > 3 * usual)).reshape(len(periods), parts)
    for one, marks, shares in zip(periods, found, share.reshape(found.shape), strict=True):
        if not marks.any():
            continue
        first, last = np.flatnonzero(marks)[[0, -1]]
        begin_s = one.begin_s + first * DOUBLED_PART_S
        end_s = min(one.begin_s + (last + 1) * DOUBLED_PART_S, one.end_s)
        findings.append(
            Finding(
                f"{path.name}: from {begin_s:g} s to {end_s:g} s of period {one.id!r} "
                f"{shares[marks].mean():.0%} of the events have no partner, at nearly all "
                "detectors, as if two recordings lay on top of each other; was a clock set back, "
                "and the table sorted? Then leave this time out"
            )
        )


def _split(
    paired: tuple[NDArray[np.int64], Passages],
    periods: Sequence[Period],
    names: Sequence[str],
    broken: frozenset[int],
) -> tuple[dict[str, Passages], ...]:
    key, passages = paired
    result: tuple[dict[str, Passages], ...] = tuple({} for _ in periods)
    if not len(key):
        return result
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    for begin, end in zip(starts, np.append(starts[1:], len(key)), strict=True):
        period, detector = divmod(int(key[begin]), len(names))
        if detector not in broken:
            chosen = np.arange(begin, end)
            result[period][names[detector]] = passages.at(chosen)
    return result


def _refuse_copies(path: Path, stream: _Stream, periods: Sequence[Period], detectors: int) -> None:
    """Refuse two periods with the same detections."""
    # One whole number per event: its time in ms, its detector, and whether it is an on.
    time_ms = np.round(stream.time * 1000).astype(np.int64)
    code = time_ms * detectors + stream.key % detectors
    code = code * 2 + stream.is_on
    period = stream.key // detectors
    bounds = np.searchsorted(period, np.arange(len(periods) + 1))
    events = {
        one.id: np.sort(code[a:b])
        for one, a, b in zip(periods, bounds[:-1], bounds[1:], strict=True)
    }
    in_seconds = np.bincount(time_ms % 1000).max() >= 0.9 * len(time_ms)
    most = MOST_SHARED_SECONDS if in_seconds else MOST_SHARED
    for one, other in overlapping(periods):
        begin, end = max(one.begin_s, other.begin_s), min(one.end_s, other.end_s)
        a, b = (_between(events[each.id], begin, end, detectors) for each in (one, other))
        few, many = (a, b) if len(a) <= len(b) else (b, a)
        sample = few[:: max(len(few) // 200, 1)]
        if len(few) < FEWEST or _share(sample, many) < most:
            continue
        if (share := _share(few, many)) >= most:
            raise MeasuredDataError(
                f"{path}: {share:.0%} of the detections from {begin:g} s to {end:g} s are the "
                f"same in the periods {one.id!r} and {other.id!r}: {TWICE}"
            )


def _between(
    events: NDArray[np.int64], begin_s: float, end_s: float, detectors: int
) -> NDArray[np.int64]:
    scale = 2000 * detectors
    low, high = np.searchsorted(events, [begin_s * scale, (end_s + 0.001) * scale])
    return events[low:high]


def _share(some: NDArray[np.int64], many: NDArray[np.int64]) -> float:
    at = np.minimum(np.searchsorted(many, some), len(many) - 1)
    return float(np.mean(many[at] == some))


def passages_as_written(passages: Passages, begin_s: float, end_s: float) -> Passages:
    """Return the passages in the form of the files, as if they were written and read again.

    Simulated detectors report more than detectors of a street, such as two vehicles on one zone at
    the same time. Measured and simulated passages are compared in this form.

    Args:
        passages: Passages in any order.
        begin_s: Start of the period.
        end_s: End of the period.

    Returns:
        Passages without overlap, sorted by time, in whole milliseconds. Only the first ``on_s`` and
        the last ``off_s`` may be NaN.
    """
    on, off = np.round(passages.on_s, 3), np.round(passages.off_s, 3)
    on, off = np.where(on < begin_s, np.nan, on), np.where(off > end_s, np.nan, off)
    outside = (on > end_s) | (off < begin_s)
    throughout = np.isnan(on) & np.isnan(off) & ~outside
    on = np.where(throughout, begin_s, on)
    order = np.argsort(np.where(np.isnan(on), off, on), kind="stable")
    order = order[~outside[order]]
    on, off = on[order], off[order]
    starts = on[np.isfinite(on)]
    # An off without an on counts only as the first event of the period.
    stray = np.isnan(on) & (
        (np.arange(len(on)) > 0) | (off > (starts[0] if len(starts) else np.inf))
    )
    on, off, order = on[~stray], off[~stray], order[~stray]
    following = np.append(on[1:], np.inf)
    off = np.where(following - on <= IMPUTED_S, np.fmin(off, following), np.minimum(off, following))
    lost = np.isnan(off) & np.isfinite(following)
    # Two ons, or two offs, at one moment are a single event in a log.
    twice = (following == on) | (np.append(np.nan, off[:-1]) == off)
    kept = ~lost & ~(off < on) & ~twice
    chosen = order[kept]
    return Passages(on[kept], off[kept], passages.speed_mps[chosen], passages.length_m[chosen])


def untangled(
    key: NDArray[np.int64], time: NDArray[np.float64], is_on: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return an order of events in which ons and offs at the same moment alternate.

    Logs round times to tenths of a second, so on and off of a short pulse can have the same time.
    Many logs are also sorted by event, so that the off comes before its on. Ons and offs must
    alternate, and this decides which one comes first.

    Args:
        key: Number of the stream of each event, ``(events,)``, sorted.
        time: Time, s, ``(events,)``, sorted within each stream.
        is_on: True for on, False for off, ``(events,)``.
    """
    order = np.arange(len(key))
    same = (key[1:] == key[:-1]) & (time[1:] == time[:-1]) & (is_on[1:] != is_on[:-1])
    shown = is_on.copy()
    last = -1
    for i in np.flatnonzero(same).tolist():
        if i <= last:
            continue
        if i > 0 and key[i - 1] == key[i]:
            swap = shown[i - 1] == shown[i]
        else:  # the first events of a stream: the next event at a single time decides
            after = i + 2
            while after < len(same) and same[after] and key[after] == key[i]:
                after += 2
            if after < len(key) and key[after] == key[i]:
                swap = shown[i] != is_on[after]
            else:  # pulses only, or one moment only
                swap = after > i + 2 and not shown[i]
        if swap:
            order[[i, i + 1]] = order[[i + 1, i]]
            shown[[i, i + 1]] = shown[[i + 1, i]]
        last = i + 1
    return order
