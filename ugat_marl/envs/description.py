"""Description of an environment: lanes behind the observed numbers, movements of the phases."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from ugat_marl.envs.observations import OBSERVATION_UNITS, Observer
from ugat_marl.scenarios import Intersection, Network, green_of_file, shipped_scenarios

TURNS = {
    "s": "through", "l": "left", "L": "left", "r": "right", "R": "right", "t": "turn-around",
    "T": "turn-around",
}  # fmt: skip
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
        scenario: Name of the scenario.
    """

    observation: pl.DataFrame
    phases: pl.DataFrame
    unit: str
    scenario: str

    def __str__(self) -> str:
        """Return both tables as text, one agent after the other, as wide as the terminal."""
        width = shutil.get_terminal_size().columns
        lines: list[str] = []
        for (agent, light), entries in _groups(self.observation, "agent", "intersection"):
            lines.append(agent if agent == light else f"{agent} ({light})")
            for number, entry in enumerate(entries):
                own = entry["of"] == agent
                what = f"{entry['name']}: {entry['shows']}" if entry["name"] else entry["shows"]
                lines += _wrapped(f"  [{number}]", what if own else f"{entry['of']}: {what}", width)
            of_agent = self.phases.filter(agent=agent)
            for (phase, green), moves in _groups(of_agent, "phase", "green_of_file"):
                here = f"  phase {phase}"
                here += "" if green is None else f" (green {green} of the file)"
                ways = [
                    f"{m['from']} {m['turn']} to {m['to']}"
                    + (" (yields)" if m["right_of_way"] == "yields" else "")
                    for m in moves
                ]
                lines += _wrapped(f"{here}:", "; ".join(ways), width)
        lines.append(f"unit of features: {self.unit}")
        named = self.scenario.startswith("resco:") or self.scenario in dict(shipped_scenarios())
        drawn = self.scenario if named else "FOLDER_OR_SUMOCFG"
        lines.append(f"as drawings: ugat-marl scenario draw {drawn} --out pictures")
        return "\n".join(lines)


def _groups(
    frame: pl.DataFrame, *keys: str
) -> Iterator[tuple[tuple[Any, ...], list[dict[str, Any]]]]:
    """Yield the rows of a frame by keys, in their order."""
    for values, part in frame.group_by(*keys, maintain_order=True):
        yield values, part.rows(named=True)


def _wrapped(head: str, text: str, width: int) -> list[str]:
    """Return a text behind its head, in lines of a width, that divide no word."""
    return textwrap.wrap(
        f"{head} {text}",
        width,
        subsequent_indent=" " * 6,
        break_long_words=False,
        break_on_hyphens=False,
    )


def describe(
    scenario: str, network: Network, observer: Observer, agents: Sequence[str]
) -> Description:
    """Return the description of an environment.

    Args:
        scenario: Name of the scenario.
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
    return Description(pl.DataFrame(rows), phases, unit, scenario)


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
