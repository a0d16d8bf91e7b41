"""What controllers are shown of what was measured: noise, failures, zones, delays.

An environment has a `Sensing` only where its scenario lists effects on observations
(`ugat_marl.effects.observing`). Rewards and scores go by what was measured itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects import (
    OBSERVING,
    CountingError,
    CountingNoise,
    DetectorFailure,
    Effect,
    LostReadings,
)
from ugat_marl.scenarios import Network
from ugat_marl.seeding import numpy_generator
from ugat_marl.simulation import Snapshot


@dataclass(frozen=True)
class _Strengths:
    """The one number of each effect, by its name; 0 for those that are absent."""

    counting_noise: float = 0.0
    counting_error: float = 0.0
    detector_failure: float = 0.0
    detection_zone: float = 0.0
    observation_delay: float = 0.0
    lost_readings: float = 0.0
    quantised_counts: float = 0.0

    @classmethod
    def of(cls, effects: Sequence[Effect]) -> _Strengths:
        own = [effect for effect in effects if isinstance(effect, OBSERVING)]
        return cls(**{effect.name: getattr(effect, fields(effect)[0].name) for effect in own})


class Sensing:
    """Turns what was measured into what controllers see.

    In the order in which it happens on the street: who is in the zone, how detectors miscount, in
    which steps they count, which of them are dead, which readings are lost, and how late the others
    arrive. Every effect draws from a stream of its own below the episode's seed, lane by lane, so
    that it does the same whatever else is there; the detectors that are dead at a low share are
    among those that are dead at a higher one.

    Args:
        effects: Effects of the scenario; those that are not on observations do nothing here.
        network: The network.
        decision_interval_s: Seconds between two looks.
    """

    def __init__(
        self, effects: Sequence[Effect], network: Network, decision_interval_s: float
    ) -> None:
        self._strengths = _Strengths.of(effects)
        lanes = network.lane_table()
        self._lanes = len(lanes.ids)
        incoming = {lane for item in network.intersections for lane in item.incoming_lanes}
        self._at_stop_line = np.array([lane in incoming for lane in lanes.ids], dtype=np.float64)
        self._late = round(self._strengths.observation_delay / decision_interval_s)
        self._nothing = np.zeros((3, self._lanes))

    @classmethod
    def of(
        cls, effects: Sequence[Effect], network: Network, decision_interval_s: float
    ) -> Sensing | None:
        """The sensing of a scenario with these effects; None if controllers see everything."""
        if not any(isinstance(effect, OBSERVING) for effect in effects):
            return None
        return cls(effects, network, decision_interval_s)

    @property
    def zone_m(self) -> float:
        """Length of the detection zones in m; 0 where whole lanes are seen."""
        return self._strengths.detection_zone

    def reset(self, seed: int) -> None:
        """Begins an episode.

        Args:
            seed: Of the episode.
        """
        self._noise = numpy_generator(seed, "sensing", CountingNoise.name)
        self._errors = numpy_generator(seed, "sensing", CountingError.name)
        self._losses = numpy_generator(seed, "sensing", LostReadings.name)
        drawn = numpy_generator(seed, "sensing", DetectorFailure.name).random(self._lanes)
        self._alive = (drawn >= self._strengths.detector_failure).astype(np.float64)
        self._last = np.zeros((3, self._lanes))
        self._under_way: deque[NDArray[np.float64]] = deque()

    @property
    def dead(self) -> NDArray[np.bool_]:
        """Which lanes have a dead detector in this episode, ``(lanes,)``."""
        return self._alive == 0

    def see(self, snapshot: Snapshot) -> Snapshot:
        """What controllers see at the decision at which `snapshot` was measured.

        Args:
            snapshot: Of the reset first, and then of every decision in turn.

        Returns:
            A snapshot of the same time whose vehicles, halting vehicles and waiting times are those
            that arrive, none before the first ones do.
        """
        self._under_way.append(self._received(self._counted(snapshot)))
        shown = self._under_way.popleft() if len(self._under_way) > self._late else self._nothing
        return replace(
            snapshot,
            vehicles=shown[0],
            halting=shown[1],
            waiting_s=shown[2] if len(snapshot.waiting_s) else snapshot.waiting_s,
            mean_left=snapshot.mean_left * self._alive
            if len(snapshot.mean_left)
            else snapshot.mean_left,
        )

    def _counted(self, snapshot: Snapshot) -> NDArray[np.float64]:
        """What the detectors send: vehicles, halting ones, waiting times, ``(3, lanes)``."""
        strengths = self._strengths
        if strengths.detection_zone:
            counts = snapshot.near * self._at_stop_line
        else:
            waiting = snapshot.waiting_s if len(snapshot.waiting_s) else self._nothing[2]
            counts = np.array([snapshot.vehicles, snapshot.halting, waiting])
        if strengths.counting_noise:
            drawn = self._noise.standard_normal(self._lanes)
            counts *= np.maximum(1.0 + strengths.counting_noise * drawn, 0.0)
        if strengths.counting_error:
            drawn = self._errors.standard_normal(self._lanes)
            counts[:2] = np.maximum(counts[:2] + strengths.counting_error * drawn, 0.0)
        if strengths.quantised_counts:
            unit = strengths.quantised_counts
            counts[:2] = np.floor(counts[:2] / unit + 0.5) * unit
        return counts * self._alive

    def _received(self, counts: NDArray[np.float64]) -> NDArray[np.float64]:
        """What gets through; where a reading is lost, the one before is kept."""
        if self._strengths.lost_readings:
            lost = self._losses.random(self._lanes) < self._strengths.lost_readings
            counts = np.where(lost, self._last, counts)
        self._last = counts
        return counts
