"""Description of an environment: lanes behind the observed numbers, movements of the phases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import polars as pl

from ugat_marl.envs.observations import OBSERVATION_UNITS, Observer
from ugat_marl.scenarios import Intersection, Network, green_of_file

TURNS = {"s": "through", "l": "left", "L": "left", "r": "right", "R": "right", "t": "turn-around"}
"""Words for SUMO's letters of directions."""


@dataclass(frozen=True)
class Description:
    """Tables of the numbers that agents see and of the phases that they choose.

    Attributes:
        observation: One row per number of each agent's observation: ``agent``, ``intersection``
            (SUMO's id), ``entry`` (its place in the vector), ``of`` (the agent whose intersection
            it shows), ``part`` ("feature", "phase", "asked" or "age"), ``name`` (lane, or phase)
            and ``shows``.
        phases: One row per agent, phase and movement: ``agent``, ``intersection`` (SUMO's id),
            ``phase`` (the action), ``green_of_file`` (number of the green of the file's programme
            with the same links, from 0; null if there is none), ``from`` and ``to`` (edges),
            ``turn``, ``lanes`` (incoming), and ``right_of_way`` ("protected", or "yields").
        unit: Meaning and unit of the features.
    """

    observation: pl.DataFrame
    phases: pl.DataFrame
    unit: str

    def __str__(self) -> str:
        """Return both tables whole, as text."""
        with pl.Config(tbl_rows=-1, tbl_cols=-1, fmt_str_lengths=60, tbl_width_chars=100):
            return (
                f"{self.observation}\nunit of features: {self.unit}\n{self.phases}\n"
                "as drawings: ugat-marl scenario draw SCENARIO --out pictures"
            )


def describe(network: Network, observer: Observer, agents: Sequence[str]) -> Description:
    """Return the description of an environment.

    Args:
        network: The network.
        observer: Observer of the environment.
        agents: Names of the agents, in the order of the network's intersections.
    """
    own = [
        _own_entries(agent, item, observer.feature_names[place])
        for place, (agent, item) in enumerate(zip(agents, network.intersections, strict=True))
    ]
    rows: list[dict[str, object]] = []
    for place, agent in enumerate(agents):
        entries = [entry for j in (place, *observer.near[place]) for entry in own[j]]
        phases = len(network.intersections[place].phases)
        for lag in range(observer.commands):
            when = "the last command" if lag == 0 else f"the command {lag + 1} decisions ago"
            entries += [
                (agent, "asked", f"phase {phase}", f"1 if {when} was this phase")
                for phase in range(phases)
            ]
        if observer.commands:
            entries.append((agent, "age", "", "age of the green / 60 s"))
        rows.extend(
            {
                "agent": agent,
                "intersection": network.intersections[place].id,
                "entry": number,
                "of": of,
                "part": part,
                "name": name,
                "shows": shows,
            }
            for number, (of, part, name, shows) in enumerate(entries)
        )
    movements: list[dict[str, object]] = [
        {
            "agent": agent,
            "intersection": item.id,
            "phase": phase,
            "green_of_file": green_of_file(item, item.phases[phase]),
            **movement,
        }
        for agent, item in zip(agents, network.intersections, strict=True)
        for phase in range(len(item.phases))
        for movement in _movements(item, phase)
    ]
    unit = OBSERVATION_UNITS.get(observer.name, "as the function returns them")
    phases = pl.DataFrame(movements, schema_overrides={"green_of_file": pl.Int64})
    return Description(pl.DataFrame(rows), phases, unit)


def _own_entries(
    agent: str, item: Intersection, names: Sequence[tuple[str, str]]
) -> list[tuple[str, str, str, str]]:
    """Return the entries of an intersection's own features and phase."""
    features = [(agent, "feature", lane, shows) for lane, shows in names]
    phases = [
        (agent, "phase", f"phase {phase}", "1 if it is green or about to be")
        for phase in range(len(item.phases))
    ]
    return features + phases


def _movements(item: Intersection, phase: int) -> list[dict[str, str]]:
    """Return the movements that are green in a phase."""
    state = item.phases[phase]
    lanes: dict[tuple[str, str, str, str], list[str]] = {}
    for link in item.links:
        letter = state[link.index]
        if letter not in "Gg":
            continue
        right = "protected" if letter == "G" else "yields"
        turn = TURNS.get(link.direction, link.direction)
        own = lanes.setdefault((link.from_edge, link.to_edge, turn, right), [])
        if link.from_lane not in own:
            own.append(link.from_lane)
    return [
        {"from": start, "to": end, "turn": turn, "lanes": " ".join(own), "right_of_way": right}
        for (start, end, turn, right), own in lanes.items()
    ]
