"""Names of agents, of SUMO's lanes, and of the drawings of lights."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence


def group_names(kinds: Sequence[Hashable]) -> dict[str, list[int]]:
    """Return groups of equal kinds, in order of appearance.

    Args:
        kinds: The kind of each item.

    Returns:
        Group name to the positions of its items. The name is ``"signal"`` if there is one kind,
        else ``"signala"``, ``"signalb"``, ...
    """
    distinct = list(dict.fromkeys(kinds))
    names = (
        ["signal"] if len(distinct) == 1 else [f"signal{letters(i)}" for i in range(len(distinct))]
    )
    groups: dict[str, list[int]] = {name: [] for name in names}
    for position, kind in enumerate(kinds):
        groups[names[distinct.index(kind)]].append(position)
    return groups


def member_names(groups: Mapping[str, Sequence[int]]) -> tuple[str, ...]:
    """Return ``<group>_<n>`` for every position, in the order of the positions."""
    names = {
        place: f"{name}_{n}" for name, members in groups.items() for n, place in enumerate(members)
    }
    return tuple(names[place] for place in sorted(names))


def letters(number: int) -> str:
    """Return a, b, ..., z, aa, ab, ... for 0, 1, ..."""
    text = ""
    number += 1
    while number:
        number, digit = divmod(number - 1, 26)
        text = chr(ord("a") + digit) + text
    return text


def drawing_name(light: str) -> str:
    """Return the name of a light's drawing, without its ending; it is valid in any file system."""
    return re.sub(r"[^\w-]+", "_", light).strip("_")[:80] or "intersection"


def edge_of_lane(lane: str) -> str:
    """Return the edge in a lane's name ``<edge>_<n>``; empty if there is no underscore."""
    return lane.rpartition("_")[0]
