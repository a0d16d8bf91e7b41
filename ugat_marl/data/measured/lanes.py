"""Traffic of lanes, second by second, from positions of single vehicles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.measured.tracks import COARSEST_S
from ugat_marl.scenarios import Period
from ugat_marl.simulation import HALTING_MPS


def traffic_of_lanes(
    vehicles: pl.DataFrame,
    lanes: Sequence[str],
    period: Period,
    moments: NDArray[np.float64] | None = None,
) -> pl.DataFrame:
    """Return vehicles, halting vehicles and mean speed of each lane, by second.

    A second has the state of the last observed moment at or before it, at most `COARSEST_S` old.

    Args:
        vehicles: Positions in one period, with the columns of ``trajectories``.
        lanes: Ids of the lanes.
        period: The period.
        moments: Times at which the street was observed, s, ascending, to the millisecond. None for
            those at which a vehicle was seen; nothing is then known of longer times without any
            vehicle.

    Returns:
        A frame with the columns of ``lanes``, a row per whole second and lane. Vehicles and halting
        vehicles are null where no moment was observed.
    """
    vehicles = vehicles.with_columns(pl.col("time_s").round(3))
    if moments is None:
        moments = np.unique(vehicles["time_s"].to_numpy())
    seconds = np.arange(np.ceil(period.begin_s), period.end_s)
    before = np.concatenate(([-np.inf], moments))
    latest = before[np.searchsorted(before, seconds, side="right") - 1]
    moment = np.where(seconds - latest <= COARSEST_S, latest, np.nan)
    grid = pl.DataFrame({"time_s": seconds, "moment": pl.Series(moment, nan_to_null=True)})
    grid = grid.join(pl.DataFrame({"lane_id": sorted(lanes)}), how="cross")
    seen = vehicles.group_by("time_s", "lane_id").agg(
        pl.len().cast(pl.Float64).alias("vehicles"),
        (pl.col("speed_mps") < HALTING_MPS).sum().cast(pl.Float64).alias("halting"),
        pl.col("speed_mps").mean().round(3).alias("mean_speed_mps"),
    )
    joined = grid.join(
        seen.rename({"time_s": "moment"}),
        on=["moment", "lane_id"],
        how="left",
        maintain_order="left",
    )
    empty = pl.when(pl.col("moment").is_not_null()).then(0.0)
    return joined.select(
        pl.lit(period.id).alias("period_id"),
        "time_s",
        "lane_id",
        pl.coalesce("vehicles", empty).alias("vehicles"),
        pl.coalesce("halting", empty).alias("halting"),
        "mean_speed_mps",
    )
