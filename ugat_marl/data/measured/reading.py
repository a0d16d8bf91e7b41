"""Reader of a directory of measured data, which it checks against the network."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import get_args

import numpy as np
import polars as pl

from ugat_marl.data.measured import tables
from ugat_marl.data.measured.copies import refuse_copies
from ugat_marl.data.measured.counts import counts_of, travel_times_of, turning_of
from ugat_marl.data.measured.coverage import coverage
from ugat_marl.data.measured.local_time import LocalClock, require_time_zone
from ugat_marl.data.measured.passages import (
    FASTEST_MPS,
    LONGEST_M,
    MOST_UNPAIRED,
    passages_of,
)
from ugat_marl.data.measured.tables import (
    PERIOD,
    ROW,
    Table,
    in_order,
    read_table,
    refuse,
    with_period,
)
from ugat_marl.data.measured.tracks import passages_of_tracks
from ugat_marl.data.measured.values import Finding, MeasuredData, place, split_periods
from ugat_marl.effects import is_detector_name
from ugat_marl.errors import MeasuredDataError, nearest
from ugat_marl.scenarios import (
    DETECTOR_CLOCKS,
    SIGNAL_LETTERS,
    SPEED_POINTS,
    Detector,
    DetectorKind,
    Lane,
    Network,
    Passages,
    Period,
    Scenario,
    SignalLog,
    Split,
    signal_widths,
)

TOLERANCE_M = 0.1
"""Tolerance for a zone that reaches beyond its lane: networks round lengths to 1 cm."""

_BEYOND_M = 20.0
"""Distance behind the end of its lane at which a vehicle may be seen: roads on maps and lanes of a
network differ by some metres."""
_SHORTEST_M = 1.0
"""Least room that a vehicle takes on a lane: bicycles side by side."""

SIGNAL_GAP_S = 600.0
"""A log with one state for longer than this probably has a gap."""
LATE_S = 120.0
"""A log may begin this much later than its period (about one signal cycle)."""


def read_measured(directory: Path, scenario: Scenario, network: Network) -> MeasuredData:
    """Read measured data; the files stay unchanged.

    Args:
        directory: Directory with the files of ``docs/reference/measured-data.md``.
        scenario: Scenario with the clock and demand of the data.
        network: Network of the scenario.

    Returns:
        The data, with findings on missing data and on rows that were left out.

    Raises:
        MeasuredDataError: A file is missing, cannot be read, contradicts itself, or does not fit
            the network or the scenario.
    """
    directory = Path(directory)
    if not directory.is_dir():
        there = "is a file, and no" if directory.exists() else "no such"
        raise MeasuredDataError(
            f"{directory}: {there} directory; measured data are a directory with periods.csv, "
            "detectors.csv, signals and detections (docs/reference/measured-data.md)"
        )
    files = _Files(directory)
    listed = files.rows(tables.PERIODS)
    periods = periods_of(*listed, scenario)
    files.clock = _clock(*listed)
    detectors = detectors_of(*files.rows(tables.DETECTORS), network)
    signals: tuple[dict[str, SignalLog], ...] = tuple({} for _ in periods)
    if files.has(tables.SIGNALS):
        rows = files.rows(tables.SIGNALS)
        signals = _signals(*rows, periods, scenario, network, files.findings)
    passages: tuple[dict[str, Passages], ...] = tuple({} for _ in periods)
    usable = detectors
    if files.has(tables.DETECTIONS):
        passages, broken = _passages(
            *files.rows(tables.DETECTIONS), periods, detectors, files.findings
        )
        usable = tuple(detector for detector in detectors if detector.id not in broken)
    lanes = _of_moments(files, tables.LANES, periods, network)
    trajectories = _of_moments(files, tables.TRAJECTORIES, periods, network)
    if trajectories is not None and files.seen_on_tracks:
        path = files.path(tables.TRAJECTORIES)
        passages = passages_of_tracks(path, trajectories, periods, usable, files.findings)
        empty = [one.id for one, seen in zip(periods, passages, strict=True) if not seen]
        _refuse_empty(path, "vehicle over a detector", empty)
    periods = tuple(
        replace(period, signals=shown, passages=seen)
        for period, shown, seen in zip(periods, signals, passages, strict=True)
    )
    counts, turning, times = _summed(files, periods, detectors, network)
    if counts is not None:
        counts = counts.filter(pl.col("detector_id").is_in([one.id for one in usable]))
    measured = MeasuredData(usable, periods, lanes, trajectories, counts, turning, times)
    files.findings += coverage(measured, scenario, network)
    return replace(measured, findings=tuple(files.findings))


class _Files:
    """Files of a directory of measured data.

    Args:
        directory: The directory.

    Attributes:
        clock: Local times at which the scenario's clock is 0; None until they are known.
        findings: Findings on files that were read.

    Raises:
        MeasuredDataError: A file that is needed is missing.
    """

    def __init__(self, directory: Path) -> None:
        self._paths = {table.stem: table.path(directory) for table in tables.TABLES}
        self.clock: LocalClock | None = None
        self.findings: list[Finding] = []
        needed = [tables.PERIODS, tables.DETECTORS]
        if not self.counts_only:
            needed += [] if self.has(tables.TRAJECTORIES) else [tables.DETECTIONS]
            needed += [tables.SIGNALS]
        for table in needed:
            if not self.has(table):
                raise _missing(directory, table)

    def has(self, table: Table) -> bool:
        """Return True if the file is there."""
        return self._paths[table.stem] is not None

    @property
    def counts_only(self) -> bool:
        """True if there are counts and no detections."""
        return self.has(tables.COUNTS) and not self.has(tables.DETECTIONS)

    @property
    def seen_on_tracks(self) -> bool:
        """True if only trajectories tell of single vehicles."""
        return not (self.has(tables.DETECTIONS) or self.has(tables.COUNTS))

    def path(self, table: Table) -> Path:
        """Return the path of a file that is there."""
        path = self._paths[table.stem]
        assert path is not None
        return path

    def rows(self, table: Table) -> tuple[Path, pl.DataFrame]:
        """Return the path and the rows of a file that is there."""
        path = self.path(table)
        return path, read_table(path, table, self.findings, self.clock)


def _summed(
    files: _Files, periods: Sequence[Period], detectors: Sequence[Detector], network: Network
) -> tuple[pl.DataFrame | None, pl.DataFrame | None, pl.DataFrame | None]:
    """Return counts, turning counts and travel times; None for files that are not there."""
    counts = turning = times = None
    if files.has(tables.COUNTS):
        path, frame = files.rows(tables.COUNTS)
        counts = counts_of(path, frame, periods, detectors, files.findings)
        if files.counts_only:
            counted = set(counts["period_id"])
            missing = [period.id for period in periods if period.id not in counted]
            _refuse_empty(path, "counts", missing)
    if files.has(tables.TURNING):
        turning = turning_of(*files.rows(tables.TURNING), periods, network, files.findings)
    if files.has(tables.TRAVEL_TIMES):
        path, frame = files.rows(tables.TRAVEL_TIMES)
        times = travel_times_of(path, with_period(path, frame, periods, files.findings), network)
    return counts, turning, times


def _clock(path: Path, frame: pl.DataFrame) -> LocalClock | None:
    """Return the local times at which the scenario's clock is 0; None if they are not given."""
    if frame["zero"].null_count() == frame.height:
        return None
    for name in ("zero", "time_zone"):
        if 0 < frame[name].null_count() < frame.height:
            refuse(
                path,
                frame.filter(pl.col(name).is_null()),
                "period_id",
                f"has no {name}, though others have",
                "write it for every period",
            )
    zones = frame["time_zone"].drop_nulls().unique().to_list()
    if len(zones) > 1:
        raise MeasuredDataError(
            f"{path}: two time zones, {zones[0]!r} and {zones[1]!r}; write that of the street"
        )
    zone = zones[0] if zones else ""
    require_time_zone(zone, str(path))
    return LocalClock.of(path, frame["period_id"], frame["begin_s"], frame["zero"], zone)


def _missing(directory: Path, table: Table) -> MeasuredDataError:
    there = ", ".join(sorted(path.name for path in directory.iterdir())[:8]) or "nothing"
    return MeasuredDataError(
        f"{directory}: no {' or '.join(table.names())}; there is {there}. "
        "docs/reference/measured-data.md describes the files"
    )


def _signals(
    path: Path,
    frame: pl.DataFrame,
    periods: tuple[Period, ...],
    scenario: Scenario,
    network: Network,
    findings: list[Finding],
) -> tuple[dict[str, SignalLog], ...]:
    if frame.is_empty():
        raise MeasuredDataError(f"{path}: no signals; write the state at every change")
    frame = with_period(path, frame, periods, findings, early=True)
    logs = signals_of(path, frame, periods, signal_widths(scenario), findings)
    controlled = [intersection.id for intersection in network.intersections]
    for period, shown in zip(periods, logs, strict=True):
        if not any(tls in shown for tls in controlled):
            raise MeasuredDataError(
                f"{path}: no signals of any intersection in period {period.id!r}; add them, or "
                "leave the period out"
            )
    return logs


def _passages(
    path: Path,
    frame: pl.DataFrame,
    periods: tuple[Period, ...],
    detectors: tuple[Detector, ...],
    findings: list[Finding],
) -> tuple[tuple[dict[str, Passages], ...], frozenset[str]]:
    if frame.is_empty():
        raise MeasuredDataError(f"{path}: no detections; write one row per on and off")
    frame = with_period(path, frame, periods, findings)
    passages, broken = passages_of(path, frame, periods, detectors, findings)
    if broken and not any(passages):
        raise MeasuredDataError(
            f"{path}: no detector can be used: of each, more than {MOST_UNPAIRED:.0%} of the "
            "events have no partner; write a row for every on and for every off"
        )
    empty = [p.id for p, seen in zip(periods, passages, strict=True) if not seen]
    _refuse_empty(path, "detections", empty)
    return passages, broken


def _of_moments(
    files: _Files, table: Table, periods: tuple[Period, ...], network: Network
) -> pl.DataFrame | None:
    """Return the table of lanes or of trajectories; None without one."""
    if not files.has(table):
        return None
    path, frame = files.rows(table)
    frame = with_period(path, frame, periods, files.findings)
    for column in (
        "vehicles", "halting", "mean_speed_mps", "speed_mps", "position_m", "length_m",
    ):  # fmt: skip
        if column in frame.columns:
            refuse(
                path, frame.filter(pl.col(column) < 0), column, "is negative", "correct the rows"
            )
    tracks = table is tables.TRAJECTORIES
    lengths_m: dict[str, float] = {}
    for name in frame["lane_id"].unique(maintain_order=True):
        if not (tracks and name.startswith(":")):  # a vehicle may be inside of a junction
            lengths_m[name] = _lane_of(f"{path}: a row", name, network).length_m
    _refuse_impossible(path, frame, tracks, lengths_m)
    what = "vehicle_id" if tracks else "lane_id"
    once = frame.unique(["period_id", what, "time_s"], keep="first", maintain_order=True)
    if twice := frame.height - once.height:
        files.findings.append(
            Finding(f"{path.name}: {twice} rows are there twice; the first ones are taken")
        )
    frame = once
    number = "position_m" if tracks else "vehicles"
    refuse_copies(path, frame, periods, (what, "time_s"), number)
    lengths = ("length_m",) if "length_m" in frame.columns and frame["length_m"].count() else ()
    optional = lengths if tracks else table.optional
    return frame.select(*table.columns, *optional)


def _refuse_impossible(
    path: Path, frame: pl.DataFrame, tracks: bool, lengths_m: Mapping[str, float]
) -> None:
    """Refuse rows that no street can show, of trajectories or of lanes."""
    length_m = pl.col("lane_id").replace_strict(
        lengths_m, default=math.inf, return_dtype=pl.Float64
    )
    if tracks:
        far = frame.filter(pl.col("position_m") > length_m + _BEYOND_M)
        refuse(path, far, "position_m", "is beyond the end of the lane", "correct lane or position")
        fast = frame.filter(pl.col("speed_mps") > FASTEST_MPS)
        refuse(path, fast, "speed_mps", f"is more than {FASTEST_MPS:g} m/s", "write m/s")
        if "length_m" in frame.columns:
            wrong = frame.filter((pl.col("length_m") <= 0) | (pl.col("length_m") > LONGEST_M))
            refuse(path, wrong, "length_m", f"is not above 0 and up to {LONGEST_M:g} m", "write m")
        return
    fast = frame.filter(pl.col("mean_speed_mps") > FASTEST_MPS)
    refuse(path, fast, "mean_speed_mps", f"is more than {FASTEST_MPS:g} m/s", "write m/s")
    most = length_m / _SHORTEST_M + 2
    full = frame.filter(pl.col("vehicles") > most)
    refuse(path, full, "vehicles", "is more than the lane has room for", "correct the rows")
    more = frame.filter(pl.col("halting") > pl.col("vehicles"))
    refuse(path, more, "halting", "is more than there are vehicles", "correct the rows")


def _refuse_empty(path: Path, kind: str, periods: list[str]) -> None:
    """Refuse periods for which a file has no rows."""
    if periods:
        raise MeasuredDataError(
            f"{path}: no {kind} in period {', '.join(map(repr, periods[:6]))}; was the file cut "
            "short? Add them, or leave the period out of periods.csv"
        )


def periods_of(path: Path, frame: pl.DataFrame, scenario: Scenario) -> tuple[Period, ...]:
    """Return the periods, without signals and detections.

    Raises:
        MeasuredDataError: There is no period, or no period to fit. Or a period occurs twice, ends
            before it begins, lies outside the scenario, or has a split other than ``fit`` and
            ``heldout``.
    """
    if frame.is_empty():
        raise MeasuredDataError(f"{path}: no periods; write one row per period of measurement")
    refuse(
        path,
        frame.filter(pl.col("period_id").is_duplicated()),
        "period_id",
        "occurs twice",
        "give each period a name of its own",
    )
    refuse(
        path,
        frame.filter(~(pl.col("end_s") > pl.col("begin_s"))),
        "end_s",
        "is not after begin_s",
        "write times in seconds of the scenario's clock",
    )
    _check_times(path, frame, scenario)
    splits = _splits(path, frame)
    return tuple(
        Period(name, begin, end, split, {}, {})
        for name, begin, end, split in zip(
            frame["period_id"].to_list(),
            frame["begin_s"].to_list(),
            frame["end_s"].to_list(),
            splits,
            strict=True,
        )
    )


def _check_times(path: Path, frame: pl.DataFrame, scenario: Scenario) -> None:
    settings = scenario.settings
    first, last = settings.begin_s, settings.begin_s + settings.duration_s
    refuse(
        path,
        frame.filter(pl.col("begin_s") >= last),
        "begin_s",
        f"is after the end of the scenario {scenario.id!r}, which has demand from {first:g} s to "
        f"{last:g} s",
        "make the scenario with --begin-s at that time, or write times from its own 0 s on",
    )
    for column, bad in (
        ("begin_s", pl.col("begin_s") < first),
        ("end_s", pl.col("end_s") > last + 1e-6),
    ):
        refuse(
            path,
            frame.filter(bad),
            column,
            f"lies outside the scenario {scenario.id!r}, which has demand from {first:g} s to "
            f"{last:g} s",
            _other_zero(path, frame, scenario)
            or "shorten the period, or use a scenario whose duration_s covers it",
        )


def _other_zero(path: Path, frame: pl.DataFrame, scenario: Scenario) -> str | None:
    """Return what to write where `zero` is the time at which the scenario begins, and not 0 s."""
    first, length_s = scenario.settings.begin_s, scenario.settings.duration_s
    early = frame.filter(pl.col("begin_s") < first)
    fits = early.filter(pl.col("begin_s") >= 0, pl.col("end_s") <= length_s + 1e-6)
    if not fits.height or fits.height < early.height or not (clock := _clock(path, frame)):
        return None
    row = fits.row(0, named=True)
    zero = clock.zeros[row["period_id"]] - timedelta(seconds=first)
    return (
        f"zero is the local time at which the scenario's clock is 0: write {zero}, with begin_s "
        f"{row['begin_s'] + first:g} and end_s {row['end_s'] + first:g}"
    )


def _splits(path: Path, frame: pl.DataFrame) -> tuple[Split, ...]:
    refuse(
        path,
        frame.filter(pl.col("split").is_not_null() & ~pl.col("split").is_in(list(get_args(Split)))),
        "split",
        "is unknown",
        "write fit or heldout",
    )
    given = frame["split"]
    if 0 < given.null_count() < len(given):
        refuse(
            path,
            frame.filter(pl.col("split").is_null()),
            "period_id",
            "has no split, though others have",
            "write fit or heldout for every period, or leave the column out",
        )
    splits = split_periods(len(given)) if given.null_count() else tuple(given.to_list())
    if "fit" not in splits:
        raise MeasuredDataError(
            f"{path}: every period is held out, none is left to fit; write split = fit for some"
        )
    return splits


def _refuse_impossible_detectors(path: Path, frame: pl.DataFrame) -> None:
    """Refuse tables of detectors that are wrong on any network."""
    if frame.is_empty():
        raise MeasuredDataError(f"{path}: no detectors; write one row per detection zone")
    refuse(
        path,
        frame.filter(pl.col("detector_id").is_duplicated()),
        "detector_id",
        "occurs twice",
        "give each detector a name of its own",
    )
    names = pl.col("detector_id").map_elements(is_detector_name, return_dtype=pl.Boolean)
    refuse(
        path,
        frame.filter(~names),
        "detector_id",
        "has characters that no effect on a detector can name",
        "leave out commas, quotes, tabs and | \\ ; < > &, and spaces at the ends",
    )
    kinds = get_args(DetectorKind)
    refuse(
        path,
        frame.filter(~pl.col("kind").is_in(list(kinds))),
        "kind",
        "is unknown",
        f"write one of {', '.join(kinds)}",
    )
    _refuse_names_of_groups(path, frame, kinds)
    for column, allowed in (("speed_at", SPEED_POINTS), ("clock", DETECTOR_CLOCKS)):
        refuse(
            path,
            frame.filter(pl.col(column).is_not_null() & ~pl.col(column).is_in(allowed)),
            column,
            "is unknown",
            f"write one of {', '.join(allowed)}, or leave it empty where it is not known",
        )


def _refuse_names_of_groups(path: Path, frame: pl.DataFrame, kinds: Sequence[str]) -> None:
    """Refuse detectors with the name of a group of others, which effects on it would miss."""
    of_kind = Counter(frame["kind"])
    groups = [
        own
        for own, kind in frame.select("detector_id", "kind").rows()
        if own == "*" or own.partition("@")[0] in {*kinds} - {own} or of_kind[own] > (kind == own)
    ]
    refuse(
        path,
        frame.filter(pl.col("detector_id").is_in(groups)),
        "detector_id",
        "would mean several detectors, such as all of a kind",
        "rename it, here and in the detections",
    )


def _lane_of(where: str, name: str, network: Network) -> Lane:
    lane = network.lanes.get(name)
    if lane is None:
        at_lights = [
            lane
            for light in network.intersections
            for lane in (*light.incoming_lanes, *light.outgoing_lanes)
        ]
        near = nearest(name, at_lights or network.lanes)  # where there are detectors: no sidewalks
        raise MeasuredDataError(
            f"{where} lies on lane {name!r}, which the network does not have"
            + (f"; did you mean {near!r}?" if near else "; lanes are called <edge>_<number>")
        )
    return lane


def _lanes_of(where: str, names: Sequence[str], network: Network) -> list[Lane]:
    """Return the lanes of a zone; refuse unknown ones, and lanes of several roads."""
    lanes = [_lane_of(where, name, network) for name in names]
    if not names:
        raise MeasuredDataError(f"{where} lies on no lane; lane_id is <edge>_<number>")
    if len(set(names)) < len(names) or len({lane.edge for lane in lanes}) > 1:
        raise MeasuredDataError(
            f"{where} lies on the lanes {', '.join(names)}; a zone on several lanes names each "
            "lane of one road once, with spaces between"
        )
    return lanes


def detectors_of(path: Path, frame: pl.DataFrame, network: Network) -> tuple[Detector, ...]:
    """Return the detectors.

    Raises:
        MeasuredDataError: There is no detector. Or a detector occurs twice, is on an unknown lane,
            reaches beyond its lane, or has an unknown kind, point of speed measurement or clock.
    """
    _refuse_impossible_detectors(path, frame)
    detectors: list[Detector] = []
    for row in frame.iter_rows(named=True):
        where = f"{place(path, row[ROW])}: detector {row['detector_id']!r}"
        lane, *others = _lanes_of(where, row["lane_id"].split(), network)
        begin, length = row["position_m"], row["length_m"]
        if not (0 <= begin <= lane.length_m + TOLERANCE_M and length >= 0):
            raise MeasuredDataError(
                f"{where} has position_m {begin:g} and length_m {length:g}; lane {lane.id!r} "
                f"goes from 0 to {lane.length_m:g} m, measured from its upstream end"
            )
        if begin + length > lane.length_m + TOLERANCE_M:
            raise MeasuredDataError(
                f"{where} ends {begin + length:g} m along lane {lane.id!r}, which ends at "
                f"{lane.length_m:g} m; its length_m is at most {lane.length_m - begin:g}"
            )
        detectors.append(
            Detector(
                row["detector_id"],
                lane.id,
                begin,
                length,
                row["kind"],
                row["speed_at"],
                row["clock"],
                tuple(other.id for other in others),
            )
        )
    return tuple(detectors)


def signals_of(
    path: Path,
    frame: pl.DataFrame,
    periods: Sequence[Period],
    widths: Mapping[str, int],
    findings: list[Finding],
) -> tuple[dict[str, SignalLog], ...]:
    """Return the signal log of every traffic light, one mapping per period.

    Args:
        path: The file.
        frame: Its rows, with `PERIOD`.
        periods: The periods.
        widths: Number of letters in the state of each traffic light of the network.
        findings: Findings; late logs, gaps and double states are added to them.

    Raises:
        MeasuredDataError: A traffic light is unknown, a state has a wrong length or unknown
            letters, or a log begins too late.
    """
    _check_states(path, frame, widths)
    names = sorted(widths)
    index = {tls: i for i, tls in enumerate(names)}
    code = frame["tls_id"].replace_strict(index, return_dtype=pl.Int64).to_numpy()
    key = frame[PERIOD].to_numpy().astype(np.int64) * len(names) + code

    def name(stream: int) -> str:
        return (
            f"traffic light {names[stream % len(names)]!r} in period "
            f"{periods[stream // len(names)].id!r}"
        )

    time = frame["time_s"].to_numpy()
    order = in_order(path, key, time, findings)
    key, time = key[order], time[order]
    states = frame["state"].gather(order).to_list()
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    logs: tuple[dict[str, SignalLog], ...] = tuple({} for _ in periods)
    for begin, end in zip(starts, np.append(starts[1:], len(key)), strict=True):
        stream = int(key[begin])
        period = periods[stream // len(names)]
        log = _log(
            list(zip(time[begin:end].tolist(), states[begin:end], strict=True)),
            period,
            f"{path}: {name(stream)}",
            findings,
        )
        logs[stream // len(names)][names[stream % len(names)]] = log
    return logs


def _check_states(path: Path, frame: pl.DataFrame, widths: Mapping[str, int]) -> None:
    known = pl.col("tls_id").is_in(list(widths))
    unknown = frame.filter(~known)
    if unknown.height:
        near = nearest(unknown["tls_id"][0], widths)
        refuse(
            path,
            unknown,
            "tls_id",
            "is not a traffic light of the network" + (f"; did you mean {near!r}?" if near else ""),
            f"it has: {', '.join(sorted(widths)[:12]) or 'none'}",
        )
    for tls, state in frame.select("tls_id", "state").unique(maintain_order=True).iter_rows():
        rows = (pl.col("tls_id") == tls) & (pl.col("state") == state)
        if len(state) != widths[tls]:
            refuse(
                path,
                frame.filter(rows),
                "state",
                f"has {len(state)} letters, but traffic light {tls!r} has {widths[tls]} links",
                "write one letter per link, in the order of the network's linkIndex",
            )
        if strange := sorted(set(state) - SIGNAL_LETTERS):
            refuse(
                path,
                frame.filter(rows),
                "state",
                f"of traffic light {tls!r} has letters SUMO does not know ({''.join(strange)})",
                f"allowed: {' '.join(sorted(SIGNAL_LETTERS))}",
            )


def _log(
    entries: list[tuple[float, str]], period: Period, where: str, findings: list[Finding]
) -> SignalLog:
    """Return the changes of one log from the start of the period; the last of equal times counts.

    A logger that writes the state every second gives the same log as one that writes changes.
    """
    kept: list[tuple[float, str]] = []
    clashes = 0
    for entry in entries:
        if kept and kept[-1][0] == entry[0]:
            clashes += kept[-1][1] != entry[1]
            kept.pop()
        kept.append(entry)
    if clashes:
        findings.append(
            Finding(f"{where}: {clashes} moments with two states; the last one is taken")
        )
    first = kept[0][0]
    if first > period.begin_s:
        if first > period.begin_s + LATE_S:
            raise MeasuredDataError(
                f"{where} begins at {first:g} s, {first - period.begin_s:g} s late; write the "
                "state at or before the start of the period, or begin the period later"
            )
        findings.append(
            Finding(
                f"{where} begins {first - period.begin_s:g} s late; its first state is taken for "
                "the time before"
            )
        )
        kept[0] = (period.begin_s, kept[0][1])
    log = tuple(entry for i, entry in enumerate(kept) if i == 0 or entry[1] != kept[i - 1][1])
    times = [max(since, period.begin_s) for since, _ in log] + [period.end_s]
    gaps = np.diff(times)
    if gaps.max() > SIGNAL_GAP_S:
        at = float(times[int(gaps.argmax())])
        findings.append(
            Finding(
                f"{where} shows one state for {math.floor(gaps.max() / 60)} min from {at:g} s on; "
                "was it recorded?"
            )
        )
    return log
