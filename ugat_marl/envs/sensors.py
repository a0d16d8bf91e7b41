"""Path of measured counts to the controllers, through the sensors of a scenario's effects.

An environment has `Sensors` if its scenario or its option `fitted` has effects on observations.
Functions that make observations see what arrives, too. Rewards and scores use the measured counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects import ControllerPart, Reading, Sensor
from ugat_marl.scenarios import Network
from ugat_marl.simulation import Snapshot


class Sensors:
    """The chain of sensors between a network and its controllers.

    Args:
        chain: Sensors of the effects.
        limit_mps: Speed limit of each lane in m/s, ``(lanes,)``.

    Attributes:
        chain: Sensors in the order in which they act.
        zone_m: Length of the detection zones in m; 0 for whole lanes.
    """

    def __init__(self, chain: Sequence[Sensor], limit_mps: NDArray[np.float64]) -> None:
        self._limit_mps = limit_mps
        self.chain = tuple(sorted(chain, key=lambda sensor: sensor.stage))
        self.zone_m = max(sensor.zone_m for sensor in self.chain)

    @classmethod
    def of(
        cls, effects: Sequence[ControllerPart], network: Network, decision_interval_s: float
    ) -> Sensors | None:
        """Return the sensors of a scenario with these effects; None if there are none."""
        latest = {effect.name: effect for effect in effects}  # the last of a name counts
        made = (effect.sensor(network, decision_interval_s) for effect in latest.values())
        chain = [sensor for sensor in made if sensor is not None]
        return cls(chain, network.lane_table().speed_mps) if chain else None

    def reset(self, seed: int) -> None:
        """Begin an episode; `seed` decides all random draws."""
        for sensor in self.chain:
            sensor.reset(seed)

    def see(self, snapshot: Snapshot) -> Snapshot:
        """Return the snapshot that controllers see at this decision.

        Args:
            snapshot: Measured snapshot; first that of the reset, then that of each decision in
                turn.

        Returns:
            A snapshot of the same time with the lanes as they arrive at the controllers. Lanes are
            empty, and as fast as their speed limit, until the first counts arrive.
        """
        measured, upstream = snapshot.waiting_s, snapshot.queued_upstream
        none = np.zeros_like(snapshot.vehicles)
        counts = np.array(
            [
                snapshot.vehicles,
                snapshot.halting,
                measured if len(measured) else none,
                upstream if len(upstream) else none,
                self._limit_mps - snapshot.mean_speed_mps,
            ]
        )
        reading = Reading(counts, snapshot.near, snapshot.mean_left)
        for sensor in self.chain:
            reading = sensor.read(reading)
        return replace(
            snapshot,
            vehicles=reading.counts[0],
            halting=reading.counts[1],
            waiting_s=reading.counts[2] if len(measured) else measured,
            queued_upstream=reading.counts[3] if len(upstream) else upstream,
            mean_speed_mps=self._limit_mps - reading.counts[4],
            mean_left=reading.mean_left,
        )
