"""Signals: rows of states become one log per traffic light and period."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import polars as pl

from ugat_marl.data.measured.data import Finding
from ugat_marl.data.measured.rows import PERIOD, in_order, refuse_set_back
from ugat_marl.data.measured.tables import ROW, refuse
from ugat_marl.errors import MeasuredDataError, nearest
from ugat_marl.scenarios import STATES, Period, SignalLog

SIGNAL_GAP_S = 600.0
"""A traffic light that shows the same for longer was probably not recorded."""
LATE_S = 120.0
"""A log that begins later than this in its period, about a cycle, cannot be replayed."""


def signals_of(
    path: Path,
    frame: pl.DataFrame,
    periods: Sequence[Period],
    widths: Mapping[str, int],
    found: list[Finding],
) -> tuple[dict[str, SignalLog], ...]:
    """What every traffic light showed, one mapping per period.

    Args:
        path: The file.
        frame: Its rows, with `PERIOD`.
        periods: The periods.
        widths: Letters in the state of each traffic light of the network.
        found: Findings; logs that begin late, gaps and the like are added.

    Raises:
        MeasuredDataError: An unknown traffic light, a state of another length than the network's
            or with letters SUMO does not know, a clock set back, or a log that begins too late.
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
    refuse_set_back(path, key, time, frame[ROW].to_numpy(), name)
    order = in_order(path, key, time, found)
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
            f"{path.name}: {name(stream)}",
            found,
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
            "is no traffic light of the network" + (f"; did you mean {near!r}?" if near else ""),
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
        if strange := sorted(set(state) - STATES):
            refuse(
                path,
                frame.filter(rows),
                "state",
                f"of traffic light {tls!r} has letters SUMO does not know ({''.join(strange)})",
                f"allowed: {' '.join(sorted(STATES))}",
            )


def _log(
    entries: list[tuple[float, str]], period: Period, where: str, found: list[Finding]
) -> SignalLog:
    """One log: of entries at the same time the last one counts; the first is at the begin."""
    kept: list[tuple[float, str]] = []
    clashes = 0
    for entry in entries:
        if kept and kept[-1][0] == entry[0]:
            clashes += kept[-1][1] != entry[1]
            kept.pop()
        kept.append(entry)
    if clashes:
        found.append(Finding(f"{where}: {clashes} moments with two states; the last one is taken"))
    first = kept[0][0]
    if first > period.begin_s:
        if first > period.begin_s + LATE_S:
            raise MeasuredDataError(
                f"{where} begins at {first:g} s, {first - period.begin_s:g} s late; write the "
                "state at or before the begin of the period, or begin the period later"
            )
        found.append(
            Finding(
                f"{where} begins {first - period.begin_s:g} s late; its first state is taken for "
                "the time before"
            )
        )
        kept[0] = (period.begin_s, kept[0][1])
    changes = [since for i, (since, s) in enumerate(kept) if i == 0 or s != kept[i - 1][1]]
    changes = [max(since, period.begin_s) for since in changes] + [period.end_s]
    gaps = np.diff(changes)
    if len(gaps) and gaps.max() > SIGNAL_GAP_S:
        at = float(changes[int(gaps.argmax())])
        found.append(
            Finding(
                f"{where} shows one state for {math.floor(gaps.max() / 60)} min from {at:g} s on; "
                "was it recorded?"
            )
        )
    return tuple(kept)
