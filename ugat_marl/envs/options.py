"""Options of an environment, checked at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from ugat_marl.errors import OptionError, UnknownNameError

RenderMode = Literal["human", "rgb_array"]


@dataclass(frozen=True)
class EnvOptions:
    """Options of an environment.

    Attributes:
        observation: What an agent sees; see `ugat_marl.envs.observations.UNITS`.
        reward: ``"queue"``, ``"pressure"``, ``"waiting"`` or a function of two `IntersectionView`.
        neighbours: How many roads away intersections are whose features and phase are seen too.
        signals: ``"actions"``, or ``"programme"``: SUMO runs the network's own signal programme
            and actions are ignored.
        duration_s: Length of an episode in s; None for the scenario's own.
        simulator: ``"process"`` (any number at once, reproducible to the bit), ``"spawn"`` (the
            same without forking), or ``"inprocess"`` (one per process, a little faster).
        crossings: Whether it is also measured when vehicles cross the stop lines, which roll-outs
            then record; lanes are looked at every second, which takes time.
        render_mode: None, ``"rgb_array"`` (a picture from `render`) or ``"human"`` (sumo-gui).
    """

    observation: str = "count"
    reward: str | Callable[[Any, Any], float] = "queue"
    neighbours: int = 0
    signals: str = "actions"
    duration_s: float | None = None
    simulator: str = "process"
    crossings: bool = False
    render_mode: str | None = None

    def __post_init__(self) -> None:
        for name, allowed in (
            ("signals", ("actions", "programme")),
            ("simulator", ("process", "spawn", "inprocess")),
            ("render_mode", (None, *get_args(RenderMode))),
        ):
            value = getattr(self, name)
            if value not in allowed:
                names = [item for item in allowed if item]
                raise UnknownNameError(f"value of option {name!r}:", str(value), names)
        roads: Any = self.neighbours
        if not isinstance(roads, int) or roads < 0:
            raise OptionError(f"neighbours = {roads!r}: must be 0 or a number of roads, such as 1")

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> EnvOptions:
        """Options from keywords.

        Raises:
            UnknownNameError: No option of this name, or no such value.
        """
        known = [item.name for item in fields(cls)]
        for name in options:
            if name not in known:
                raise UnknownNameError("option", name, known)
        return cls(**options)
