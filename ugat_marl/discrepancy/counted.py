"""Features of periods for which there are counts and nothing else."""

from __future__ import annotations

import numpy as np
import polars as pl

from ugat_marl.discrepancy.features import BIN_FEATURES, FEATURES, INDEX, Tally, bins_of
from ugat_marl.discrepancy.site import Site
from ugat_marl.measured.data import Period


def counts_tally(site: Site, period: Period, counts: pl.DataFrame) -> Tally:
    """Puts counts where the counts of detected vehicles would be; all else stays empty.

    Args:
        site: Lanes and detectors.
        period: Which period.
        counts: ``period_id, begin_s, end_s, detector_id, count``.
    """
    places = len(site.lanes) + len(site.exits)
    length = bins_of(period)
    sums = np.zeros((len(FEATURES), places, 2))
    bins = np.zeros((len(BIN_FEATURES), places, length))
    edges = np.linspace(period.begin_s, period.end_s, length + 1)
    for row in counts.filter(pl.col("period_id") == period.id).iter_rows(named=True):
        name, place = site.counted.get(row["detector_id"], ("", -1))
        if place >= 0:
            begin, end, count = float(row["begin_s"]), float(row["end_s"]), float(row["count"])
            sums[INDEX[name], place] += (count, (end - begin) / 60.0)
            inside = np.clip(np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin), 0.0, None)
            bins[BIN_FEATURES.index(name), place] += count * inside / max(end - begin, 1e-9)
    return Tally(sums, bins)
