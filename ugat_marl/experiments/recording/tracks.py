"""Positions of every vehicle at every second, from SUMO's output."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.sax.saxutils import unescape

import polars as pl

_FCD = re.compile(r'<timestep time="([\d.]+)"|<vehicle ([^>]*)/>')
_ATTRIBUTE = re.compile(r'(\w+)="([^"]*)"')


def tracks(file: Path, period: str, end_s: float, step_s: float) -> pl.DataFrame:
    """Return the position of every vehicle at every whole second, also on junctions.

    SUMO writes positions at the start of the step that led to them. Here they have its end, so that
    they follow the signals that were shown before.

    Args:
        file: SUMO's output.
        period: Id of the period.
        end_s: End of the period, on the scenario's clock.
        step_s: Length of a simulation step, s.
    """
    columns: dict[str, list[Any]] = {
        name: [] for name in ("vehicle_id", "time_s", "lane_id", "position_m", "speed_mps")
    }
    time = end_s
    for match in _FCD.finditer(file.read_text(encoding="utf-8")):
        if match[1]:
            time = float(match[1]) + step_s
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
