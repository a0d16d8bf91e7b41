"""Effects on the engine: queues in place of car following, blocked junctions, reach of counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

from ugat_marl.effects.base import Effect, Parameter
from ugat_marl.scenarios import Scenario, validated

HEADWAY_S = 1.4
"""Net headway of queues that drive on, of drivers who keep 1 s: SUMO multiplies it with theirs.

With 7.5 m per vehicle at the speed limit that is one every 2.30, 1.94 and 1.79 s at 8.3, 13.9 and
19.4 m/s; of car following 2.48, 1.95 and 1.71 s were measured, straight on from one saturated lane.
"""


@dataclass(frozen=True)
class QueueModel(Effect):
    """Vehicles wait in queues at the ends of segments of so many metres (SUMO's mesoscopic model).

    Vehicles have no position within a segment and no acceleration; what they look at are signals,
    and room in the next segment. Only the last segment of an edge has a queue for each way on; in
    those before it whoever finds no room keeps all others back, so `--sim meso`, an engine to train
    in, many times as fast, has segments as long as most roads. A diagnosis does not look for it.
    """

    name: ClassVar[str] = "queue_model"
    ranges: ClassVar[dict[str, Parameter]] = {"metres": Parameter("m", 20.0, 500.0)}
    metres: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set options of SUMO and the clearance, so that queues serve what car following serves.

        A green of g s on a saturated lane serves (g - 0.9) / 1.95 vehicles in car following at
        13.9 m/s, yellow and start included. SUMO's queues would serve as many in a green shorter by
        `QUEUE_START_S`, and drive on in yellow: agents show red for yellow, and greens are late
        (see `late_greens`). Its headways depend on how full segments are; here they are one,
        `HEADWAY_S`, however long the queue and the segment. (The network's own programmes keep
        their yellow, from which phases may be read. Not `meso-lane-queue`, with which SUMO 1.28
        crashes on some networks.)
        """
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
    """A vehicle that has stood on a junction for so many seconds is no obstacle any more.

    Vehicles that meet in the middle of a junction, slow ones that started late above all, can hold
    each other up for ever: SUMO solves that by teleporting alone, which the suite switches off, and
    whatever signals show, the network fills up to the end of the episode. On a street somebody
    gives way (SUMO: ``--ignore-junction-blocker``). A diagnosis does not look for it.
    """

    name: ClassVar[str] = "blocker_patience"
    ranges: ClassVar[dict[str, Parameter]] = {"seconds": Parameter("s", 1.0, 3600.0)}
    seconds: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Set the option of SUMO."""
        return _changed(scenario, self, {"ignore-junction-blocker": f"{self.seconds:g}"})


@dataclass(frozen=True)
class Reach(Effect):
    """Vehicles are counted so far upstream of stop lines, where lanes at lights are shorter.

    Networks made of maps are cut into short roads, and whoever stands on the road before the last
    is seen by nobody; a policy learns that vehicles there cost nothing. With it observations and
    rewards, and the measured queue, hold those on the lanes upstream, too, and those that wait
    to enter the network there. A diagnosis does not look for it.
    """

    name: ClassVar[str] = "reach"
    ranges: ClassVar[dict[str, Parameter]] = {"metres": Parameter("m", 1.0, 2000.0)}
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
        settings=validated(settings, f"scenario {scenario.id!r}"),
        applied=(*scenario.applied, str(effect)),
    )
