"""Phases of lights that run SUMO's own programmes, read from the states that they show."""

from __future__ import annotations

from collections.abc import Mapping

from ugat_marl.scenarios import GREEN, YELLOW, Intersection, Network

NO_PHASE = -1
"""Place of a light whose green is none of its phases."""


class ProgrammePhases:
    """The phases that the lights of a network show while SUMO runs their programmes.

    A state belongs to the phase in which the same links for vehicles are green. During yellow,
    red-amber and all-red the phase before goes on, because only SUMO knows which one an actuated
    programme takes next.

    Args:
        network: The network.

    Attributes:
        shown: Phase of each intersection, in the network's order; `NO_PHASE` for other greens.
        latest: The same with the last phase before other greens, 0 if there was none.
    """

    def __init__(self, network: Network) -> None:
        self._lights = network.intersections
        self._phases: list[dict[frozenset[int], int]] = []
        for light in self._lights:
            greens = [(_green(light, phase), place) for place, phase in enumerate(light.phases)]
            self._phases.append(dict(reversed(greens)))  # of equal ones, the first
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.shown = [NO_PHASE] * len(self._lights)
        self.latest = [0] * len(self._lights)

    def look(self, states: Mapping[str, str]) -> None:
        """Take over the state that each traffic light shows."""
        for place, (light, phases) in enumerate(zip(self._lights, self._phases, strict=True)):
            state = states[light.id]
            letters = {state[link.index] for link in light.links}
            if letters & YELLOW or not letters & GREEN:
                continue
            self.shown[place] = phases.get(_green(light, state), NO_PHASE)
            if self.shown[place] != NO_PHASE:
                self.latest[place] = self.shown[place]


def _green(light: Intersection, state: str) -> frozenset[int]:
    return frozenset(link.index for link in light.links if state[link.index] in GREEN)
