"""Data of every second: the position of each vehicle, and the traffic of each lane."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import unescape

import numpy as np
import polars as pl

from ugat_marl.scenarios import Detector, Period

HALTING_MPS = 0.1
"""Speed in m/s below which SUMO calls a vehicle halting."""

_FCD = re.compile(r'<timestep time="([\d.]+)"|<vehicle ([^>]*)/>')
_ATTRIBUTE = re.compile(r'(\w+)="([^"]*)"')


def tracks(file: Path, period: str, begin_s: float, end_s: float) -> pl.DataFrame:
    """Return the position of every vehicle at every whole second, also on junctions."""
    columns: dict[str, list[Any]] = {
        name: [] for name in ("vehicle_id", "time_s", "lane_id", "position_m", "speed_mps")
    }
    time = begin_s
    for match in _FCD.finditer(file.read_text(encoding="utf-8")):
        if match[1]:
            time = float(match[1])
        elif time < end_s and abs(time - round(time)) < 1e-6:
            given = dict(_ATTRIBUTE.findall(match[2]))
            values = (
                unescape(given["id"]),
                time,
                given["lane"],
                float(given["pos"]),
                float(given["speed"]),
            )
            for column, value in zip(columns.values(), values, strict=True):
                column.append(value)
    kinds = {name: pl.String if name.endswith("_id") else pl.Float64 for name in columns}
    frame = pl.DataFrame(columns, schema=kinds)
    return frame.select(pl.lit(period).alias("period_id"), *columns)


def per_lane(vehicles: pl.DataFrame, detectors: Sequence[Detector], period: Period) -> pl.DataFrame:
    """Return vehicles, halting vehicles and mean speed of each lane with a detector, by second."""
    names = sorted({detector.lane for detector in detectors})
    seconds = pl.DataFrame({"time_s": np.arange(np.ceil(period.begin_s), period.end_s)})
    grid = seconds.join(pl.DataFrame({"lane_id": names}), how="cross")
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
