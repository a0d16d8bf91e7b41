"""Effects on the engine: mesoscopic queues, blocked junctions, and the reach of counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

from ugat_marl.effects.base import Effect, NumberParameter
from ugat_marl.effects.roads import LaneClosure, Parking, no_blockers
from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios import Scenario, validate_settings

HEADWAY_S = 1.4
"""Net headway of moving queues in s, for drivers with `tau` = 1 s; SUMO multiplies it by `tau`.

With 7.5 m per vehicle, the time between vehicles is 1.4 s + 7.5 m / speed: 2.30, 1.94 and 1.79 s at
8.3, 13.9 and 19.4 m/s. Car following had 2.48, 1.95 and 1.71 s, measured straight on from one
saturated lane.
"""


@dataclass(frozen=True)
class QueueModel(Effect):
    """Vehicles wait in queues at the ends of segments `metres` long (SUMO's mesoscopic model).

    Vehicles have no position within a segment and no acceleration. They react to signals and to the
    room in the next segment. Only the last segment of an edge has one queue for each direction; in
    the segments before, one vehicle without room stops all others. So the domain `meso`, a much
    faster engine for training, has segments as long as most roads. A diagnosis does not look for
    this effect.
    """

    name: ClassVar[str] = "queue_model"
    ranges: ClassVar[dict[str, NumberParameter]] = {"metres": NumberParameter("m", 20.0, 500.0)}
    metres: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set options of SUMO and the clearance, so that queues serve as many as car following.

        In car following at 13.9 m/s, a green of g s on a saturated lane serves (g - 0.9) / 1.95
        vehicles, yellow and start included. SUMO's queues serve as many in a green that is shorter
        by `QUEUE_START_S`, and they drive on in yellow. So agents show red instead of yellow, and
        greens are late (see `late_greens`). SUMO's headways depend on the occupancy of segments;
        here all are `HEADWAY_S`. The network's own programmes keep their yellow, because phases may
        be read from them. The option `meso-lane-queue` is not used, because SUMO 1.28 crashes with
        it on some networks.

        Raises:
            ScenarioError: Vehicles stand on lanes, which is not possible in queues.
        """
        for effect in scenario.applied:
            if effect.partition("=")[0] in (LaneClosure.name, Parking.name):
                raise ScenarioError(no_blockers(effect))
        options = {
            "mesosim": "true",
            "meso-edgelength": f"{self.metres:g}",
            "meso-junction-control": "true",
            "meso-jam-threshold": "1",
            "meso-tauff": f"{HEADWAY_S:g}",
        }
        clearance_s = scenario.timing.clearance_s
        return _changed(scenario, self, options, yellow_s=0.0, all_red_s=clearance_s)


@dataclass(frozen=True)
class BlockerPatience(Effect):
    """A vehicle that has stood on a junction for `seconds` is no longer an obstacle.

    Vehicles in the middle of a junction can block each other for ever, above all slow ones that
    started late. SUMO solves this only by teleporting, which is switched off here, so the network
    fills up. On a street somebody gives way (SUMO: ``--ignore-junction-blocker``). A diagnosis does
    not look for this effect.
    """

    name: ClassVar[str] = "blocker_patience"
    ranges: ClassVar[dict[str, NumberParameter]] = {"seconds": NumberParameter("s", 1.0, 3600.0)}
    seconds: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set the option of SUMO."""
        return _changed(scenario, self, {"ignore-junction-blocker": f"{self.seconds:g}"})


@dataclass(frozen=True)
class Reach(Effect):
    """Vehicles are counted up to `metres` upstream of stop lines, across short roads.

    Networks from maps are cut into short roads. Without a reach, no agent sees vehicles before the
    last road, and a policy learns that they cost nothing. With it, observations, rewards and the
    measured queue include vehicles on the lanes upstream and those that wait to enter the network
    there. A diagnosis does not look for this effect.
    """

    name: ClassVar[str] = "reach"
    ranges: ClassVar[dict[str, NumberParameter]] = {"metres": NumberParameter("m", 1.0, 2000.0)}
    metres: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set `control.reach_m`."""
        return _changed(scenario, self, {}, reach_m=self.metres)


def _changed(
    scenario: Scenario, effect: Effect, options: Mapping[str, str], **control: float
) -> Scenario:
    """Return the scenario with further options of SUMO and other values in its control."""
    settings = scenario.settings.model_dump()
    settings["sumo"] = {**settings["sumo"], **options}
    settings["control"] = {**settings["control"], **control}
    return replace(
        scenario,
        settings=validate_settings(settings, f"scenario {scenario.id!r}"),
        applied=(*scenario.applied, str(effect)),
    )
