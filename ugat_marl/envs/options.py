"""Options of an environment, checked at once."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from numbers import Integral
from typing import Any, Literal, TypedDict, TypeVar, get_args

import numpy as np

from ugat_marl.effects import ControllerPart
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.parallel import require_deadline

Function = TypeVar("Function", bound=Callable[..., Any])

RenderMode = Literal["human", "rgb_array"]


class EnvKeywords(TypedDict, total=False):
    """Keywords of `parallel_env`, `env` and `vector_env`: the fields of `EnvOptions`."""

    observation: str | Callable[[Any], Any]
    reward: str | Callable[[Any, Any], float]
    neighbours: int
    commands: int
    signals: str
    duration_s: float | None
    simulator: str
    fitted: tuple[ControllerPart, ...]
    crossings: bool
    render_mode: str | None
    deadline_s: float | None


def with_env_keywords(function: Function) -> Function:
    """Show the fields of `EnvOptions` as keywords in the help of a function.

    The function takes them as ``**options``, so that an unknown one is refused by `EnvOptions.of`
    with the nearest name.
    """
    signature = inspect.signature(function)
    given = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    taken = {parameter.name for parameter in given}
    keywords = [
        inspect.Parameter(
            option.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=option.default,
            annotation=option.type,
        )
        for option in fields(EnvOptions)
        if option.name not in taken
    ]
    shown: Any = function
    shown.__signature__ = signature.replace(parameters=[*given, *keywords])
    about = inspect.getdoc(EnvOptions) or ""
    listed = about.partition("Attributes:\n")[2]
    indented = "\n".join(f"    {line}".rstrip() for line in listed.splitlines())
    shown.__doc__ = f"{inspect.getdoc(function)}\n\nKeywords:\n{indented.rstrip()}\n"
    return function


@dataclass(frozen=True)
class EnvOptions:
    """Options of an environment.

    Attributes:
        observation: Name of the observation (`ugat_marl.envs.observations.OBSERVATION_UNITS`), or a
            function of an `IntersectionView` that returns a row of features.
        reward: ``"total-queue"``, ``"queue"``, ``"pressure"``, ``"waiting"`` or a function of two
            `IntersectionView`.
        neighbours: Distance in roads up to which agents see features and phases of others.
        commands: Number of its own last commands that an agent sees, and the age of its green with
            them; 0 for none. Needed where commands are late or lost.
        signals: ``"actions"``, or ``"programme"``: SUMO runs the network's own signal programme
            and actions are ignored. Agents see the phase with the same green links; while the green
            is none of their phases, they see no phase.
        duration_s: Length of an episode in s; None for the scenario's own. An episode has whole
            decision intervals: of 65 s, ten seconds each, it has 60.
        simulator: ``"process"`` (any number at once, exactly repeatable), ``"spawn"`` (the same
            without forking), or ``"inprocess"`` (one per process, a little faster).
        fitted: Fitted changes of sensors, commands and greens, beside those of the scenario's
            effects, such as the parts of a `ugat_marl.grounding.StreetWorld`.
        crossings: True to measure when vehicles cross the stop lines, for roll-outs to record. It
            is slower, because lanes are read every second.
        render_mode: None, ``"rgb_array"`` (a picture from `render`) or ``"human"`` (sumo-gui).
        deadline_s: Seconds within which the simulation's process has to answer. Then it is killed:
            `parallel_env` raises `SimulatorCrashed`, and `vector_env` replaces it. None for the
            variable ``UGAT_MARL_DEADLINE_S``, or 900. ``"inprocess"`` has no deadline.
    """

    observation: str | Callable[[Any], Any] = "count"
    reward: str | Callable[[Any, Any], float] = "total-queue"
    neighbours: int = 0
    commands: int = 0
    signals: str = "actions"
    duration_s: float | None = None
    simulator: str = "process"
    fitted: tuple[ControllerPart, ...] = ()
    crossings: bool = False
    render_mode: str | None = None
    deadline_s: float | None = None

    def __post_init__(self) -> None:
        for option in fields(self):  # checkpoints are JSON, which has no scalars of NumPy
            value: Any = getattr(self, option.name)
            if isinstance(value, np.generic):
                object.__setattr__(self, option.name, value.item())
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
        if not is_count(roads):
            raise OptionError(f"neighbours = {roads!r}: must be 0 or a number of roads, such as 1")
        commands: Any = self.commands
        if not is_count(commands):
            raise OptionError(f"commands = {commands!r}: must be 0 or a number of decisions")
        given: Any = self.fitted
        parts = tuple(given) if isinstance(given, Iterable) else (None,)
        if not all(isinstance(part, ControllerPart) for part in parts):
            raise OptionError(f"fitted = {given!r}: must be parts of a fitted street")
        object.__setattr__(self, "fitted", parts)
        crossings: Any = self.crossings
        if not isinstance(crossings, bool):
            raise OptionError(f"crossings = {crossings!r}: must be True or False")
        require_deadline(self.deadline_s)
        if self.deadline_s is not None and self.simulator == "inprocess":
            raise OptionError(
                "deadline_s is for simulations in a process of their own; leave it out with "
                "simulator='inprocess', which cannot be killed alone"
            )

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> EnvOptions:
        """Return options from keywords.

        Raises:
            UnknownNameError: An option or a value does not exist.
            OptionError: A value is impossible, or the domain has another name.
        """
        known = [field.name for field in fields(cls)]
        for name in options:
            if name in ("domain", "domains"):
                raise OptionError(
                    f"{name} is no option of this function: parallel_env and env take domain, "
                    "vector_env takes domains"
                )
            if name not in known:
                raise UnknownNameError("option", name, ["domain", *known])
        return cls(**options)


def is_count(value: Any) -> bool:
    """Return True for a whole number from 0 on; a bool is none."""
    return not isinstance(value, bool) and isinstance(value, Integral) and int(value) >= 0
