"""Vehicles over a detector as its electronics log them: on or off, and nothing in between."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ugat_marl.scenarios import Passages

IMPUTED_S = 2.0
"""Two ons in a row at most this far apart are two vehicles: the first one's off is set to the
second one's on. ODOT's `atspm` (queries of split failures) does the same."""


def as_logged(passages: Passages, begin_s: float, end_s: float) -> Passages:
    """What is left of passages once they were written to a file and read again.

    Simulated detectors know more than those of a street: two vehicles on one zone, or one that
    changed lanes beside it. Measured and simulated passages are compared in this form.

    Args:
        passages: In any order.
        begin_s: Begin of the period.
        end_s: End of the period.

    Returns:
        Passages in order of time, to the millisecond, none of which overlap. ``on_s`` is NaN at
        most in the first, ``off_s`` at most in the last.
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
    # A leaving without an entering counts where nothing can have come before it.
    stray = np.isnan(on) & (
        (np.arange(len(on)) > 0) | (off > (starts[0] if len(starts) else np.inf))
    )
    on, off, order = on[~stray], off[~stray], order[~stray]
    following = np.append(on[1:], np.inf)
    off = np.where(following - on <= IMPUTED_S, np.fmin(off, following), np.minimum(off, following))
    lost = np.isnan(off) & np.isfinite(following)
    # Two ons, or two offs, at one moment are one for a detector.
    twice = (following == on) | (np.append(np.nan, off[:-1]) == off)
    kept = ~lost & ~(off < on) & ~twice
    chosen = order[kept]
    return Passages(on[kept], off[kept], passages.speed_mps[chosen], passages.length_m[chosen])


def untangled(
    key: NDArray[np.int64], time: NDArray[np.float64], is_on: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """The order of events in which an on and an off at the same moment make sense.

    Logs of tenths of a second hold pulses shorter than that, and are often sorted by event: the off
    of such a pulse then stands before its on. After an off comes an on, and after an on an off.

    Args:
        key: Stream of each event ``(events,)``, sorted.
        time: ``(events,)`` s, in order within each stream.
        is_on: ``(events,)``.
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
        else:  # nothing before it: the next event with a time of its own decides
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
