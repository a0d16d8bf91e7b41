"""Observer of traffic lights: it knows the rules of the road and nothing of the field loop.

It reads the network and the timing by itself and shares no code with what it judges.
"""

from __future__ import annotations

import functools
import tomllib
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

_GREEN, _YELLOW = "Gg", "y"


@dataclass(frozen=True)
class Rules:
    """Rules for the lights of a network.

    Attributes:
        crossing: Traffic light to the pairs of links whose traffic crosses or merges.
        yellow_s: Shortest yellow, s.
        all_red_s: Shortest time between the end of a yellow and the green of crossing traffic, s.
        min_green_s: Shortest green, s.
    """

    crossing: Mapping[str, frozenset[tuple[int, int]]]
    yellow_s: int
    all_red_s: int
    min_green_s: int

    @classmethod
    def read(cls, directory: Path) -> Rules:
        """Read the rules of a scenario directory with one controller per junction."""
        control = tomllib.loads((directory / "scenario.toml").read_text())["control"]
        crossing: dict[str, frozenset[tuple[int, int]]] = {}
        for junction in ET.parse(directory / "network.net.xml").getroot().iter("junction"):
            if junction.get("type") == "traffic_light":
                crossing[junction.attrib["id"]] = frozenset(
                    (int(request.attrib["index"]), other)
                    for request in junction.iter("request")
                    # The last letter is the link with number 0.
                    for other, letter in enumerate(reversed(request.attrib["foes"]))
                    if letter == "1"
                )
        return cls(crossing, control["yellow_s"], control["all_red_s"], control["min_green_s"])


class Observer:
    """Somebody beside the street who looks at every light once a second.

    Args:
        rules: The rules.

    Attributes:
        seconds: Number of looks.
        unsafe: Number of looks at which a rule was broken.
        broken: Rule to the number of times that it was broken.
        examples: The first ten broken rules: second, light, rule, and the states around it.
    """

    def __init__(self, rules: Rules) -> None:
        self._rules = rules
        self.seconds = self.unsafe = 0
        self.broken: Counter[str] = Counter()
        self.examples: list[str] = []
        self._before: dict[str, str] = {}
        self._since: dict[tuple[str, int], int] = {}
        """Second from which a link shows its letter; none if it began before the first look."""
        self._open: dict[tuple[str, int], int] = {}
        """Last second at which a link showed green or yellow."""

    def look(self, shown: Mapping[str, str]) -> None:
        """Judge one second.

        Args:
            shown: Traffic light to its state, one letter per link.
        """
        found: list[str] = []
        for light, crossing in self._rules.crossing.items():
            state = shown[light]
            before = self._before.get(light, state)
            wrong = ["greens that cross"] if _crosses(state, crossing) else []
            if state != before:
                for link, (was, now) in enumerate(zip(before, state, strict=True)):
                    if _kind(was) != _kind(now):
                        wrong += self._change(light, link, (_kind(was), _kind(now)), state)
                        self._since[light, link] = self.seconds
            for link, letter in enumerate(state):
                if letter in _GREEN or letter == _YELLOW:
                    self._open[light, link] = self.seconds
            found += wrong
            if wrong and len(self.examples) < 10:
                self.examples.append(f"{self.seconds} s {light}: {wrong[0]}, {before} -> {state}")
            self._before[light] = state
        self.broken.update(found)
        self.unsafe += bool(found)
        self.seconds += 1

    def _change(self, light: str, link: int, kinds: tuple[str, str], state: str) -> list[str]:
        """Return the rules that a link breaks by its change to another kind of letter."""
        crossing, (was, now) = self._rules.crossing[light], kinds
        wrong: list[str] = []
        since = self._since.get((light, link))
        lasted = self._rules.min_green_s if since is None else self.seconds - since
        if was == "green":
            if now != "yellow":
                wrong.append("green without yellow")
            if lasted < self._rules.min_green_s:
                wrong.append("short green")
        if was == "yellow":
            if now == "green":
                wrong.append("green after yellow")
            if since is not None and lasted < self._rules.yellow_s:
                wrong.append("short yellow")
        if now == "green":
            last = [
                self._open.get((light, other), -self._rules.all_red_s - 1)
                for one, other in crossing
                if one == link and state[other] not in _GREEN  # "greens that cross" is for those
            ]
            if last and self.seconds - 1 - max(last) < self._rules.all_red_s:
                wrong.append("short clearance")
        return wrong


@functools.lru_cache(maxsize=4096)
def _crosses(state: str, crossing: frozenset[tuple[int, int]]) -> bool:
    return any(state[one] == state[other] == "G" for one, other in crossing)


def _kind(letter: str) -> str:
    return "green" if letter in _GREEN else "yellow" if letter == _YELLOW else "red"
