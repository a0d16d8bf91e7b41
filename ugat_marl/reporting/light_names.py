"""Names of a traffic light in a table: SUMO's id, the agent that acts there, and the streets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ugat_marl.envs import Observer
from ugat_marl.scenarios import Network, intersection_name


@dataclass(frozen=True)
class LightNames:
    """Names of the traffic lights of a network, by SUMO's id.

    Attributes:
        agents: Names of the agents.
        streets: Streets that meet at a light; empty if they have no names.
    """

    agents: Mapping[str, str] = field(default_factory=dict)
    streets: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, network: Network) -> LightNames:
        """Return the names of the lights of a network."""
        lights = network.intersections
        names = Observer(network, "count").agents  # the same for all observations
        return cls(
            {light.id: name for light, name in zip(lights, names, strict=True)},
            {light.id: intersection_name(light.links, network.streets) for light in lights},
        )

    def text(self, light: str) -> str:
        """Return a light with its agent, as in ``A1 (signal_0)``; another id as it is."""
        agent = self.agents.get(light, light)
        return light if agent == light else f"{light} ({agent})"

    def whole(self, light: str) -> str:
        """Return streets, light and agent, as in ``Long Road / Cross Street, 9 (signal_0)``."""
        return ", ".join(filter(None, (self.streets.get(light, ""), self.text(light))))


LIGHT_HEADING = "light (agent)"
"""Heading of a column of `LightNames.text`."""
