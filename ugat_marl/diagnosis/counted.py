"""Features of periods for which there are counts and nothing else."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
import polars as pl

from ugat_marl.diagnosis.features import BIN_FEATURES, BIN_S, FEATURES, INDEX, Tally, bins_of
from ugat_marl.diagnosis.site import Site
from ugat_marl.scenarios import Period

_WHOLE = 0.99
"""Share of a bin, or a period, that must have been counted."""


def bins_together(counts: pl.DataFrame | None) -> int:
    """How many bins a count covers: within it nobody knows when vehicles came.

    Args:
        counts: ``begin_s, end_s`` and others; None where single vehicles were detected.
    """
    if counts is None or counts.is_empty():
        return 1
    longest = float((counts["end_s"] - counts["begin_s"]).cast(pl.Float64).to_numpy().max())
    return max(1, math.ceil(longest / BIN_S - 1e-6))


def without_gaps(counts: pl.DataFrame, periods: Sequence[Period]) -> frozenset[str]:
    """Detectors that were counted in every period from begin to end."""
    length = pl.col("end_s").cast(pl.Float64) - pl.col("begin_s").cast(pl.Float64)
    found = set(counts["detector_id"].to_list())
    for period in periods:
        own = counts.filter(pl.col("period_id") == period.id)
        times = dict(own.group_by("detector_id").agg(length.sum()).iter_rows())
        least = _WHOLE * (period.end_s - period.begin_s)
        found = {name for name in found if times.get(name, 0.0) >= least}
    return frozenset(found)


def counts_tally(site: Site, period: Period, counts: pl.DataFrame, whole: Collection[str]) -> Tally:
    """Puts counts where the counts of detected vehicles would be; all else stays empty.

    Args:
        site: Lanes and detectors.
        period: Which period.
        counts: ``period_id, begin_s, end_s, detector_id, count``.
        whole: Detectors `without_gaps`. Of the others only single bins are used: the mean of some
            hours is not that of all.
    """
    places = len(site.lanes) + len(site.exits)
    length = bins_of(period)
    sums = np.zeros((len(FEATURES), places, 2))
    bins = np.zeros((len(BIN_FEATURES), places, length))
    covered = np.zeros_like(bins)
    edges = np.linspace(period.begin_s, period.end_s, length + 1)
    for row in counts.filter(pl.col("period_id") == period.id).iter_rows(named=True):
        name, place = site.counted.get(row["detector_id"], ("", -1))
        if place >= 0:
            begin, end, count = float(row["begin_s"]), float(row["end_s"]), float(row["count"])
            if row["detector_id"] in whole:
                sums[INDEX[name], place] += (count, (end - begin) / 60.0)
            inside = np.clip(np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin), 0.0, None)
            line = BIN_FEATURES.index(name), place
            bins[line] += count * inside / max(end - begin, 1e-9)
            covered[line] += inside
    known = (covered > _WHOLE * np.diff(edges)).astype(np.float64)
    return Tally(sums, bins * known, known=known)
