"""Traffic of lanes, second by second, from positions of single vehicles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from ugat_marl.scenarios import Period

HALTING_MPS = 0.1
"""Speed in m/s below which SUMO calls a vehicle halting."""


def traffic_of_lanes(vehicles: pl.DataFrame, lanes: Sequence[str], period: Period) -> pl.DataFrame:
    """Return vehicles, halting vehicles and mean speed of each lane, by second.

    Args:
        vehicles: Positions in one period, with the columns of ``trajectories``.
        lanes: Ids of the lanes.
        period: The period.

    Returns:
        A frame with the columns of ``lanes``, a row per whole second and lane.
    """
    seconds = pl.DataFrame({"time_s": np.arange(np.ceil(period.begin_s), period.end_s)})
    grid = seconds.join(pl.DataFrame({"lane_id": sorted(lanes)}), how="cross")
    seen = vehicles.group_by("time_s", "lane_id").agg(
        pl.len().cast(pl.Float64).alias("vehicles"),
        (pl.col("speed_mps") < HALTING_MPS).sum().cast(pl.Float64).alias("halting"),
        pl.col("speed_mps").mean().round(3).alias("mean_speed_mps"),
    )
    joined = grid.join(seen, on=["time_s", "lane_id"], how="left", maintain_order="left")
    return joined.select(
        pl.lit(period.id).alias("period_id"),
        "time_s",
        "lane_id",
        pl.col("vehicles", "halting").fill_null(0.0),
        "mean_speed_mps",
    )
