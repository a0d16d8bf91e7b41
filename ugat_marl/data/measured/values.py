"""Measured data of a street, or of simulated detectors, as plain values."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray
from polars import selectors

from ugat_marl.scenarios import Detector, Period, Split

HELD_OUT_SHARE = 0.4
"""Share of the periods that is held out by default. The last periods are held out."""


def first_row(path: Path) -> int:
    """Return the number of the first row of a table; line 1 of a CSV file is its header."""
    return 1 if path.suffix.lower() in (".parquet", ".toml") else 2


def place(path: Path, row: int) -> str:
    """Return the name of a row for messages; a mapping has entries."""
    unit = {".parquet": "row", ".toml": "entry"}.get(path.suffix.lower(), "line")
    return f"{path}, {unit} {row}"


@dataclass(frozen=True)
class Finding:
    """Gap in the data, or a sign that they are wrong.

    Attributes:
        text: Sentence with the fault, its place and its extent.
        rules_out: Names of effects that cannot be examined because of this finding.
    """

    text: str
    rules_out: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class MeasuredData:
    """All measured data of one network.

    Attributes:
        detectors: Detection zones.
        periods: Periods of measurement, in the order of ``periods.csv``.
        lanes: Table of lanes at instants, or None. Columns: ``period_id, time_s, lane_id, vehicles,
            halting, mean_speed_mps``.
        trajectories: Table of vehicles at instants, or None. Columns: ``period_id, vehicle_id,
            time_s, lane_id, position_m, speed_mps``, and ``length_m`` where it was measured.
        counts: Table of counts, or None. Columns: ``period_id, begin_s, end_s, detector_id,
            count``, and ``occupancy`` (share of time, 0 to 1) and ``mean_speed_mps`` where they
            were measured.
        turning: Table of turning counts, or None. Columns: ``period_id, begin_s, end_s, from_edge,
            to_edge, count``.
        travel_times: Table of travel times of probes, or None. Columns: ``period_id, time_s,
            from_edge, from_m, to_edge, to_m, travel_s``; ``time_s`` is at the first place.
        findings: Findings from the checks of the files.
    """

    detectors: tuple[Detector, ...]
    periods: tuple[Period, ...]
    lanes: pl.DataFrame | None = None
    trajectories: pl.DataFrame | None = None
    counts: pl.DataFrame | None = None
    turning: pl.DataFrame | None = None
    travel_times: pl.DataFrame | None = None
    findings: tuple[Finding, ...] = ()

    def of(self, split: Split) -> tuple[Period, ...]:
        """Return the periods of one split."""
        return tuple(period for period in self.periods if period.split == split)

    @property
    def has_events(self) -> bool:
        """True if detectors reported single vehicles, and not only counts."""
        return any(period.passages for period in self.periods)

    @property
    def has_speeds(self) -> bool:
        """True if detectors measured speeds of single vehicles."""
        return any(
            bool(np.isfinite(passages.speed_mps).any())
            for period in self.periods
            for passages in period.passages.values()
        )

    @property
    def hash(self) -> str:
        """SHA-256 over all measured data, as 64 hex digits.

        Times are rounded to the millisecond, as in the files. So writing and reading do not change
        the hash.
        """
        digest = hashlib.sha256()
        for detector in self.detectors:
            zone = (
                detector.id,
                detector.lane,
                float(detector.position_m),
                float(detector.length_m),
                detector.kind,
            )
            stated = [name for name in (detector.speed_at, detector.clock) if name is not None]
            digest.update(repr((*zone, *stated, *detector.beside)).encode())
        for period in self.periods:
            head = (period.id, float(period.begin_s), float(period.end_s), period.split)
            digest.update(repr(head).encode())
            for tls, log in sorted(period.signals.items()):
                shown = [(round(float(since), 3) + 0.0, state) for since, state in log]
                digest.update(repr((tls, shown)).encode())
            for name, passages in sorted(period.passages.items()):
                if len(passages):
                    digest.update(f"{name} {len(passages)}".encode())
                    for times in (passages.on_s, passages.off_s):
                        digest.update(_canonical(np.round(times, 3)))
                    digest.update(_canonical(passages.speed_mps) + _canonical(passages.length_m))
        frames = self.lanes, self.trajectories, self.counts, self.turning, self.travel_times
        for frame in frames:
            if frame is not None:
                numbers = selectors.numeric().cast(pl.Float64).fill_nan(None)
                table = frame.select(sorted(frame.columns)).with_columns(numbers)
                # A file holds no column without values.
                table = table.select(name for name in table.columns if table[name].count())
                times = selectors.by_name("time_s", "begin_s", "end_s", require_all=False)
                digest.update(table.with_columns(times.round(3) + 0.0).write_csv().encode())
        return digest.hexdigest()


def _canonical(numbers: NDArray[np.float64]) -> bytes:
    """Return the bytes of numbers, with one form of NaN and of zero."""
    return np.where(np.isnan(numbers), np.nan, numbers + 0.0).astype("<f8").tobytes()


def split_periods(count: int) -> tuple[Split, ...]:
    """Return the default split: the last 40 % are held out, at least one of two or more."""
    held = min(max(round(HELD_OUT_SHARE * count), 1), count - 1) if count > 1 else 0
    return ("fit",) * (count - held) + ("heldout",) * held
