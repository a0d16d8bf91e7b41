"""Controllers of the soak's street: they follow commands, fail on request, and have own plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

Fault = Literal["", "stuck", "slow", "own plan"]
"""Fault of a controller: it keeps its state, follows late, or runs its own plan."""

SILENCE_S = 30
"""Time without a command after which a controller runs its own plan, s."""
_OWN_GREEN_S, _YELLOW_S, _ALL_RED_S = 20, 3, 2
_SLOW_S = (1, 4, 2, 6)
"""Delays of a controller that follows late, in turn, s."""


class Cabinet:
    """Controller of one light, safe by itself.

    Args:
        greens: States with green, for its own plan.
        state: State at first.

    Attributes:
        state: State that the light shows.
        fault: Fault at present.
    """

    def __init__(self, greens: Sequence[str], state: str) -> None:
        self.state = state
        self.fault: Fault = ""
        self._greens = greens
        self._next = 0
        self._silent_s = 0
        self._own = True
        self._held_s = 0
        self._pending: tuple[int, str] | None = None
        self._delays = 0

    @property
    def on_own_plan(self) -> bool:
        """True while it follows no commands."""
        return self._own or self.fault == "own plan"

    def command(self, state: str, fresh: bool) -> bool:
        """Follow a command of the loop; return False if it is refused.

        Args:
            state: State to show.
            fresh: True if the connection is younger than the last silence.
        """
        if self._own and not fresh:
            return False
        self._own, self._silent_s = False, 0
        if self.fault == "own plan":
            return True  # it is taken, and not followed
        delay = 0
        if self.fault == "slow":
            delay = _SLOW_S[self._delays % len(_SLOW_S)]
            self._delays += 1
        # A newer command replaces the one that waits.
        self._pending = (delay, state)
        self._follow()
        return True

    def second(self) -> bool:
        """Let one second pass; return True if the controller has just lost patience."""
        self._silent_s += 1
        lost_patience = not self._own and self._silent_s > SILENCE_S
        if lost_patience:
            self._own, self._pending, self._held_s = True, None, 0
        if self.fault == "own plan":
            self._pending = None
        if self.on_own_plan:
            if self.fault != "stuck":
                self._run_own_plan()
        elif self._pending is not None:
            self._pending = (self._pending[0] - 1, self._pending[1])
            self._follow()
        return lost_patience

    def _follow(self) -> None:
        if self._pending is not None and self._pending[0] <= 0 and self.fault != "stuck":
            self._show(self._pending[1])
            self._pending = None

    def _show(self, state: str) -> None:
        if state != self.state:
            self.state, self._held_s = state, 0

    def _run_own_plan(self) -> None:
        """Show a green for its time, then yellow, then red, then the next green."""
        self._held_s += 1
        if "y" in self.state:
            if self._held_s >= _YELLOW_S:
                self._show("".join("r" if letter == "y" else letter for letter in self.state))
        elif "G" in self.state or "g" in self.state:
            if self._held_s >= _OWN_GREEN_S:
                self._show("".join("y" if letter in "Gg" else "r" for letter in self.state))
        elif self._held_s >= _ALL_RED_S:
            self._show(self._greens[self._next % len(self._greens)])
            self._next += 1


class Cabinets:
    """All controllers of the street.

    Args:
        greens: Light to the states with green of its own plan.
    """

    def __init__(self, greens: Mapping[str, Sequence[str]]) -> None:
        self.by_light = {light: Cabinet(states, states[0]) for light, states in greens.items()}
        self._fresh: set[str] = set()

    def connected(self) -> None:
        """Begin a connection; all controllers follow it."""
        self._fresh = set(self.by_light)

    def command(self, states: Mapping[str, str]) -> bool:
        """Pass commands on; return False if a controller refuses."""
        followed = [
            self.by_light[light].command(state, light in self._fresh)
            for light, state in states.items()
        ]
        return all(followed)

    def second(self) -> dict[str, str]:
        """Let one second pass; return light to state."""
        for light, cabinet in self.by_light.items():
            if cabinet.second():
                self._fresh.discard(light)
        return self.shown()

    def shown(self) -> dict[str, str]:
        """Return light to state."""
        return {light: cabinet.state for light, cabinet in self.by_light.items()}
