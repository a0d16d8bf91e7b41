"""Effects on what becomes of a controller's commands: the action gap.

The controller's cabinet (`ugat_marl.envs.actuators`) puts them into practice. Whatever it does,
the signal machine keeps minimum green, yellow and all-red.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from ugat_marl.effects.base import ControllerEffect, Effect, Parameter, Text
from ugat_marl.scenarios import Scenario

PHASE_ORDERS = ("cyclic", "barrier-leading", "barrier-lagging", "barrier-both")
"""Rules for which phase may follow which; `ugat_marl.envs.actuators.successors` says what they
are."""


@dataclass(frozen=True)
class ExecutionDelay(ControllerEffect):
    """Commands are carried out so late, in whole decisions; until then the light stays."""

    name: ClassVar[str] = "execution_delay"
    ranges: ClassVar[dict[str, Parameter]] = {"seconds": Parameter("s", 0.0, 600.0)}
    seconds: float


@dataclass(frozen=True)
class LostCommands(ControllerEffect):
    """A command to one light is lost with this chance; the light stays as it is."""

    name: ClassVar[str] = "lost_commands"
    ranges: ClassVar[dict[str, Parameter]] = {"share": Parameter("", 0.0, 1.0)}
    share: float


@dataclass(frozen=True)
class PhaseOrder(ControllerEffect):
    """Only some phases may follow a phase; a command for another one is not obeyed."""

    name: ClassVar[str] = "phase_order"
    texts: ClassVar[dict[str, Text]] = {"rule": Text("phase order", allowed=PHASE_ORDERS)}
    rule: str


@dataclass(frozen=True)
class MaxGreen(ControllerEffect):
    """No green lasts longer, in whole decisions; the next phase allowed follows by itself."""

    name: ClassVar[str] = "max_green"
    ranges: ClassVar[dict[str, Parameter]] = {"seconds": Parameter("s", 10.0, 600.0)}
    seconds: float


@dataclass(frozen=True)
class MinGreen(Effect):
    """Every green of the signals the agents control lasts at least so many s, in whole steps."""

    name: ClassVar[str] = "min_green"
    ranges: ClassVar[dict[str, Parameter]] = {"seconds": Parameter("s", 0.0, 120.0)}
    seconds: float

    def apply(self, scenario: Scenario) -> Scenario:
        """Sets `control.min_green_s`."""
        step = scenario.settings.step_length_s
        changed = scenario.with_control(min_green_s=round(self.seconds / step) * step)
        return replace(changed, applied=(*scenario.applied, str(self)))


ACTING: tuple[type[Effect], ...] = (ExecutionDelay, LostCommands, PhaseOrder, MaxGreen, MinGreen)
"""All of them."""
