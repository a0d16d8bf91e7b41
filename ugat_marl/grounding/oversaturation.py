"""Oversaturation in a log: lanes that are full, and greens that lead to full lanes.

A green serves nobody if the lane behind the intersection is full. Without a look at that lane, this
is taken for a late green or a slow lane. A full lane also shows fewer arrivals than there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ugat_marl.grounding.summaries import Floats, LaneRows, LaneView

TOLD = 0.05
"""Share of decisions from which an intersection is named in reports. Half of it is reached by a
single queue of a peak hour."""


@dataclass(frozen=True)
class Oversaturation:
    """Shares of the decisions of each intersection that are oversaturated, ``(agents,)`` each.

    Attributes:
        agents: Names of the intersections.
        full: Share at which a lane before the light is full.
        held: Share at which a green leads to a full lane.
        any: Share at which either is so.
    """

    agents: tuple[str, ...]
    full: Floats
    held: Floats
    any: Floats

    @classmethod
    def of(cls, view: LaneView, rows: Sequence[LaneRows], agents: Sequence[str]) -> Oversaturation:
        """Measure the decisions of a log.

        Args:
            view: Lanes of the network.
            rows: Decisions of every lane (`LaneView.rows`).
            agents: Names of the intersections, in the order of the view.
        """
        measured: list[tuple[float, float, float]] = []
        for places in view.lanes_of(agents).values():
            lanes = [rows[place] for place in places]
            full = np.any([lane.full for lane in lanes], axis=0)
            held = np.any([lane.held & lane.has for lane in lanes], axis=0)
            both = float(np.logical_or(full, held).mean())
            measured.append((float(full.mean()), float(held.mean()), both))
        return cls(tuple(agents), *np.array(measured).T)

    def describe(self) -> list[str]:
        """Return a line for each intersection above `TOLD`."""
        return [
            f"{agent}: oversaturated in {share:.0%} of the decisions (a lane full in {full:.0%}, a "
            f"green held up by a full lane behind it in {held:.0%}); arrivals of full lanes and "
            "greens that are held up are left out of the fit"
            for agent, share, full, held in zip(
                self.agents, self.any, self.full, self.held, strict=True
            )
            if share > TOLD
        ]
