"""Field loop as a service: it goes on when its street comes back, and tells how it is."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable

from ugat_marl.errors import EpisodeError, OutputError, SimulatorError
from ugat_marl.field.decisions import Decision, DecisionLog
from ugat_marl.field.health import Health
from ugat_marl.field.loop import FieldLoop, LoopSummary
from ugat_marl.field.site import Site
from ugat_marl.field.street import Street
from ugat_marl.field.watchdog import TrustLimits
from ugat_marl.policies import Policy

FIRST_PAUSE_S = 1.0
"""Pause after the first attempt to reach the street, s. Each pause is twice the one before."""
LONGEST_PAUSE_S = 60.0
"""Longest pause between two attempts, s."""


class FieldService:
    """Field loop that looks for its street again whenever it is gone.

    Lights that the loop cannot reach get no commands; their controllers run their own plan. When
    the street is back, each light is taken over from what it shows then.

    Args:
        site: The intersections, with the policy's observation.
        policy: The policy.
        connect: Function that returns the street, or raises `SimulatorError` or `OSError`.
        limits: Limits of trust; None for the default values.
        log: Log of the decisions; None for no log.
        health: Teller of the loop's state; None for none.
        look_for_s: Time for which the loop looks for a street that is gone, s; 0 to end at once.
        say: Function that tells somebody that the street is gone or back.
        sleep: Function that waits some seconds.
    """

    def __init__(
        self,
        site: Site,
        policy: Policy,
        connect: Callable[[], Street],
        limits: TrustLimits | None = None,
        log: DecisionLog | None = None,
        *,
        health: Health | None = None,
        look_for_s: float = math.inf,
        say: Callable[[str], None] = lambda text: None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._site, self._policy, self._connect = site, policy, connect
        self._limits, self._log = limits, log
        self._health = health or Health()
        self._look_for_s, self._say, self._sleep = look_for_s, say, sleep
        self._loop: FieldLoop | None = None
        self._lost: Exception | None = None
        self._losses = 0
        self._of_caller: Exception | None = None
        self._has_run = False

    def run(
        self, seconds: float, on_decision: Callable[[Decision], None] | None = None
    ) -> LoopSummary:
        """Drive the street for `seconds`, not counting the time without it, and close the log.

        A service runs once.

        Args:
            seconds: Time to drive, s; inf for ever.
            on_decision: Function that is called after each decision.

        Raises:
            SimulatorError: The street was gone for longer than `look_for_s`.
            OSError: The same, with an error of the street's driver.
            Exception: What `on_decision` raises.
            OptionError: The street lacks a light, or a light shows a state that it cannot have.
            OutputError: The log cannot be written at the end.
            EpisodeError: The service has run before.
        """
        if self._has_run:
            raise EpisodeError("this FieldService has run; make another one to go on")
        self._has_run = True
        try:
            return self._driven(seconds, on_decision)
        finally:
            if self._loop is not None:
                self._loop.close()
            self._health.tell("ended", **self._facts())
            if self._log is not None:
                self._log.close()

    def _driven(
        self, seconds: float, on_decision: Callable[[Decision], None] | None
    ) -> LoopSummary:
        pause_s, until = FIRST_PAUSE_S, math.inf
        while True:
            try:
                loop = self._reached()
                return loop.drive(
                    seconds - loop.driven_s, lambda made: self._tell(made, on_decision)
                )
            except OutputError:
                raise
            except (SimulatorError, OSError) as error:
                if error is self._of_caller:
                    raise
                if self._lost is None:
                    pause_s, until = FIRST_PAUSE_S, time.monotonic() + self._look_for_s
                    self._losses += 1
                if time.monotonic() >= until:
                    raise
                if self._lost is None:
                    self._tell_user(f"the street is gone ({error}); looking for it again")
                self._lost = error.with_traceback(None)  # which would keep the old street open
                self._health.tell("looking", **self._facts())
                self._sleep(min(pause_s, max(until - time.monotonic(), 0.0)))
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def _reached(self) -> FieldLoop:
        street = self._connect()
        if self._loop is None:
            self._loop = FieldLoop(self._site, self._policy, street, self._limits, self._log)
        else:
            self._loop.take_over(street)
        return self._loop

    def _tell(self, decision: Decision, on_decision: Callable[[Decision], None] | None) -> None:
        if self._lost is not None:
            self._lost = None
            self._tell_user("the street is back")
        self._health.tell(
            "driving",
            street_time_s=decision.time_s,
            lights_on_plan=dict(decision.fallback),
            **self._facts(),
        )
        if on_decision is not None:
            try:
                on_decision(decision)
            except Exception as error:
                self._of_caller = error  # it says nothing about the street
                raise

    def _tell_user(self, text: str) -> None:
        with contextlib.suppress(OSError):  # a full disk does not stop the lights
            self._say(text)

    def _facts(self) -> dict[str, object]:
        summary = LoopSummary() if self._loop is None else self._loop.summary
        return {
            "decisions": summary.decisions,
            "faults": dict(summary.reasons),
            "times_gone": self._losses,
            "gone_because": "" if self._lost is None else str(self._lost),
            "log_lines_lost": 0 if self._log is None else self._log.lost,
        }
