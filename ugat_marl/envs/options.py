"""Options of an environment, checked at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from ugat_marl.effects import ControllerPart
from ugat_marl.errors import OptionError, UnknownNameError

RenderMode = Literal["human", "rgb_array"]


@dataclass(frozen=True)
class EnvOptions:
    """Options of an environment.

    Attributes:
        observation: Name of the observation; see `ugat_marl.envs.observations.OBSERVATION_UNITS`.
        reward: ``"total-queue"``, ``"queue"``, ``"pressure"``, ``"waiting"`` or a function of two
            `IntersectionView`.
        neighbours: Distance in roads up to which agents see features and phases of others.
        commands: Number of its own last commands that an agent sees, and the age of its green with
            them; 0 for none. Needed where commands are late or lost.
        signals: ``"actions"``, or ``"programme"``: SUMO runs the network's own signal programme
            and actions are ignored.
        duration_s: Length of an episode in s; None for the scenario's own.
        simulator: ``"process"`` (any number at once, exactly repeatable), ``"spawn"`` (the same
            without forking), or ``"inprocess"`` (one per process, a little faster).
        fitted: Fitted changes of sensors, commands and greens, beside those of the scenario's
            effects.
        crossings: True to measure when vehicles cross the stop lines, for roll-outs to record. It
            is slower, because lanes are read every second.
        render_mode: None, ``"rgb_array"`` (a picture from `render`) or ``"human"`` (sumo-gui).
    """

    observation: str = "count"
    reward: str | Callable[[Any, Any], float] = "total-queue"
    neighbours: int = 0
    commands: int = 0
    signals: str = "actions"
    duration_s: float | None = None
    simulator: str = "process"
    fitted: tuple[ControllerPart, ...] = ()
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
                names = [choice for choice in allowed if choice]
                raise UnknownNameError(f"value of option {name!r}:", str(value), names)
        roads: Any = self.neighbours
        if not isinstance(roads, int) or roads < 0:
            raise OptionError(f"neighbours = {roads!r}: must be 0 or a number of roads, such as 1")
        commands: Any = self.commands
        if not isinstance(commands, int) or commands < 0:
            raise OptionError(f"commands = {commands!r}: must be 0 or a number of decisions")

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> EnvOptions:
        """Return options from keywords.

        Raises:
            UnknownNameError: An option or a value does not exist.
        """
        known = [field.name for field in fields(cls)]
        for name in options:
            if name not in known:
                raise UnknownNameError("option", name, known)
        return cls(**options)
