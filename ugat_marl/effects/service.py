"""Effect on the service of single lanes: seconds of green that their traffic does not use."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from ugat_marl.effects.base import ControllerEffect, NumberParameter, TextParameter
from ugat_marl.effects.controllers import ControllerPart
from ugat_marl.effects.places import network_places
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import Intersection, Network, Scenario, Withheld

Seconds = tuple[float, float]
"""Red at the beginning of a green, and in every further decision, in s."""


@dataclass(frozen=True)
class LaneService(ControllerEffect):
    """Links from a lane show red at the beginning of their green, and in each further decision.

    The first is start-up lost time of this lane alone. The second lowers its saturation flow:
    queues stop for some seconds in every decision in which the green goes on. Controllers command
    and observe the full green. A network may have one such effect for each lane. SUMO's own
    programmes show the same red, see `with_late_green_programmes`.
    """

    name: ClassVar[str] = "lane_service"
    apart_by: ClassVar[tuple[str, ...]] = ("name", "lane")
    ranges: ClassVar[dict[str, NumberParameter]] = {
        "begin_s": NumberParameter("s", 0.0, 30.0),
        "each_s": NumberParameter("s", 0.0, 30.0),
    }
    texts: ClassVar[dict[str, TextParameter]] = {"lane": TextParameter("lane")}
    lane: str
    begin_s: float
    each_s: float

    def apply(self, scenario: Scenario) -> Scenario:
        """List the effect in the scenario; the last of two of the same lane counts.

        Raises:
            UnknownNameError: No such lane at a traffic light.
        """
        places = network_places(scenario)
        places.check(self.name, "lane", self.lane, places.ends)
        return super().apply(scenario)

    def service(self) -> Mapping[str, Seconds]:
        """Return the lane and its seconds."""
        return {self.lane: (self.begin_s, self.each_s)}


def service_of(
    effects: Iterable[ControllerPart], fitted: Iterable[ControllerPart]
) -> dict[str, Seconds]:
    """Return lane to its seconds of red in all.

    Args:
        effects: Effects of the scenario; the last one of a lane counts.
        fitted: What was fitted beside these effects, and is added to them.
    """
    seconds = {lane: red for effect in effects for lane, red in effect.service().items()}
    for part in fitted:
        for lane, (begin_s, each_s) in part.service().items():
            begins_s, eaches_s = seconds.get(lane, (0.0, 0.0))
            seconds[lane] = (begins_s + begin_s, eaches_s + each_s)
    return seconds


def withheld(network: Network, lanes: Mapping[str, Seconds]) -> dict[str, Withheld]:
    """Return the red of single links by traffic light, for lights with such a lane."""
    found = {item.id: _of_light(item, lanes) for item in network.intersections}
    return {light: red for light, red in found.items() if any(red.begin_s) or any(red.each_s)}


def refuse_service(network: Network, effects: Iterable[ControllerPart]) -> None:
    """Refuse effects on lanes that lead to no agent's light: nobody would withhold their green.

    Raises:
        OptionError: There is such an effect.
    """
    reached = {link.from_lane for item in network.intersections for link in item.links}
    for lane in service_of(effects, ()):
        if lane not in reached:
            raise OptionError(
                f"lane_service: lane {lane!r} leads to no light of an agent, and only there green "
                "is withheld; leave it out"
            )


def _of_light(item: Intersection, lanes: Mapping[str, Seconds]) -> Withheld:
    begin_s, each_s = ([0.0] * len(item.phases[0]) for _ in range(2))
    for link in item.links:
        begin, each = lanes.get(link.from_lane, (0.0, 0.0))
        # Lanes that share a signal have the red of the slower one.
        begin_s[link.index] = max(begin_s[link.index], begin)
        each_s[link.index] = max(each_s[link.index], each)
    return Withheld(tuple(begin_s), tuple(each_s))
