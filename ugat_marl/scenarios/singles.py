"""Route files of single vehicles, which need no routing before they are counted or drawn again."""

from __future__ import annotations

from ugat_marl.files import Tag


class OwnEdges:
    """Whether a route file holds single vehicles with their own edges only, tag after tag."""

    def __init__(self) -> None:
        self._holds = True
        self._waiting = False  # for the route of the vehicle before

    @property
    def lost(self) -> bool:
        """Whether something else came: nothing behind it changes that."""
        return not self._holds

    def read(self, item: Tag) -> None:
        """Takes the next opening tag."""
        if item.name in ("vehicle", "trip", "flow", "route", "routeDistribution"):
            single = item.name == "vehicle" and "route" not in item.attributes
            self._holds &= item.name == "route" or (single and not self._waiting)
            self._waiting = single

    def ended(self) -> bool:
        """The answer for the whole file."""
        return self._holds and not self._waiting
