"""Plausibility of counts: the limits, and the watchdog that checks counts against them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from ugat_marl.errors import OptionError
from ugat_marl.field.street import LaneCount

_MAY_BE_ENDLESS = ("frozen_after_s", "silent_after_s", "over_capacity")
_FULL = 0.8
"""Share of a lane's capacity from which it may be full. The count of a full lane may not change."""


@dataclass(frozen=True)
class TrustLimits:
    """Limits beyond which counts and policy are not trusted.

    Attributes:
        answer_ms: Longest time from reading the counts until every light has its plan, ms.
        reserve_ms: Part of `answer_ms` for the steps after the policy, ms.
        stale_after_s: Age from which a count is not used, s.
        frozen_after_s: Time, s, after which an unchanged count above 0 is a fault. It runs only
            while the lane has green and is not full, because queues at red and full lanes do not
            move. If no count of any lane changes for this time, all lanes are at fault.
        silent_after_s: Time, s, after which a lane that counts no vehicle is at fault, if it has
            counted one before and other lanes move. Use inf where roads are empty for hours.
        over_capacity: Multiple of a lane's capacity above which a count is absurd. It is above 1
            because motorcycles need less room than the vehicles that define the capacity.
        return_after: Number of good decisions in a row before the policy drives a light again.
        green_s: Time of a phase of the fixed-time plan, s, its clearance included.
        obey_s: Time, s, for which a light may go on with its earlier state after a command. Then it
            is at fault, and is taken over from what it shows.
        look_every_s: Longest time between two looks at what lights show, s.
    """

    answer_ms: float = 50.0
    reserve_ms: float = 10.0
    stale_after_s: float = 5.0
    frozen_after_s: float = 180.0
    silent_after_s: float = 1800.0
    over_capacity: float = 2.0
    return_after: int = 3
    green_s: float = 30.0
    obey_s: float = 2.0
    look_every_s: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value, endless = getattr(self, field.name), field.name in _MAY_BE_ENDLESS
            if not (value >= 0 and (endless or value < math.inf)):
                raise OptionError(f"{field.name} = {value}: must be a number, 0 or more")
        if self.green_s == 0:
            raise OptionError("green_s = 0: must be above 0; the fixed-time plan needs greens")
        if self.look_every_s == 0:
            raise OptionError("look_every_s = 0: lights cannot be looked at without a pause")
        if self.reserve_ms >= self.answer_ms:
            raise OptionError(
                f"reserve_ms = {self.reserve_ms:g} leaves the policy nothing of the "
                f"{self.answer_ms:g} ms; give less"
            )


class Watchdog:
    """Check of the counts of every decision.

    Args:
        capacity: Lane that must be counted to the number of vehicles that fit on it.
        halting: True if the number of standing vehicles must be known as well.
        limits: Limits of trust.
    """

    def __init__(self, capacity: Mapping[str, float], halting: bool, limits: TrustLimits) -> None:
        self._capacity = capacity
        self._halting = halting
        self._limits = limits
        self._value: dict[str, tuple[float, float]] = {}
        self._still_s: dict[str, float] = {}
        self._since_s: dict[str, float] = {}
        self._looked_s = self._moved_s = 0.0
        self._counted: set[str] = set()

    def check(
        self,
        counts: Mapping[str, LaneCount],
        now_s: float,
        green_s: Mapping[str, float] | None = None,
    ) -> tuple[dict[str, LaneCount], dict[str, str]]:
        """Return the trusted counts, and lane to fault, ``<kind>: <details>``, for the others.

        Args:
            counts: Lane to its count, whose numbers may be of any type.
            now_s: Time on the street's clock, s.
            green_s: Lane to its green since the last call, s, in which vehicles could leave it; all
                of the time for other lanes, and for all if None.
        """
        trusted: dict[str, LaneCount] = {}
        lane_faults: dict[str, str] = {}
        elapsed, self._looked_s = now_s - self._looked_s, now_s
        for lane, capacity in self._capacity.items():
            count, wrong = counts.get(lane), f"missing: no count of lane {lane}"
            if count is not None:
                count, wrong = self._checked(count, capacity, now_s)
                wrong = wrong and f"{wrong} on lane {lane}"
            if count is not None and not wrong:
                moving_s = min((green_s or {}).get(lane, elapsed), elapsed)
                full = count.vehicles >= _FULL * capacity
                self._note(lane, count, now_s, 0.0 if full else moving_s)
                trusted[lane] = count
            else:
                lane_faults[lane] = wrong
                self._value.pop(lane, None)  # the lane's next good count is a change
        lane_faults = self._stuck(now_s) | lane_faults
        return {lane: n for lane, n in trusted.items() if lane not in lane_faults}, lane_faults

    def _checked(
        self, count: LaneCount, capacity: float, now_s: float
    ) -> tuple[LaneCount | None, str]:
        """Return a count with numbers of Python, and what is wrong with it, or ""."""
        try:
            halting = _number(count.halting) if self._halting else math.nan
            plain = LaneCount(_number(count.time_s), _number(count.vehicles), halting)
        except (TypeError, ValueError, AttributeError, ArithmeticError):  # drivers return anything
            return None, f"absurd: {count!r:.200} is not a count"
        return plain, self._absurd(plain, capacity) or self._stale(plain, now_s)

    def _absurd(self, count: LaneCount, capacity: float) -> str:
        vehicles, halting = count.vehicles, count.halting
        if not math.isfinite(vehicles) or vehicles < 0:
            return f"absurd: {vehicles} vehicles"
        if vehicles > self._limits.over_capacity * capacity:
            return f"absurd: {vehicles:g} vehicles where {capacity:.1f} fit"
        if self._halting and not 0 <= halting <= vehicles:
            return f"absurd: {halting} of {vehicles:g} vehicles stand"
        return ""

    def _stale(self, count: LaneCount, now_s: float) -> str:
        age = now_s - count.time_s
        if not abs(age) <= self._limits.stale_after_s:  # NaN and times in the future are stale too
            return f"stale: a count {age:g} s old"
        return ""

    def _note(self, lane: str, count: LaneCount, now_s: float, elapsed: float) -> None:
        value = (count.vehicles, count.halting if self._halting else 0.0)
        if self._value.get(lane) == value:
            self._still_s[lane] += elapsed
        else:
            self._value[lane], self._still_s[lane] = value, 0.0
            self._since_s[lane] = self._moved_s = now_s
        if count.vehicles > 0:
            self._counted.add(lane)

    def _stuck(self, now_s: float) -> dict[str, str]:
        """Return lane to fault, for counts that do not change; a count of 0 may stay for long."""
        limits, still = self._limits, now_s - self._moved_s
        if still > limits.frozen_after_s and any(vehicles for vehicles, _ in self._value.values()):
            return {
                lane: f"frozen: no count has changed for {still:g} s, as on lane {lane}"
                for lane in self._value
            }
        stuck: dict[str, str] = {}
        for lane, (vehicles, _) in self._value.items():
            moving, silent = self._still_s[lane], now_s - self._since_s[lane]
            if vehicles > 0 and moving > limits.frozen_after_s:
                stuck[lane] = f"frozen: {vehicles:g} vehicles for {moving:g} s of green on {lane}"
            elif (
                vehicles == 0
                and silent > limits.silent_after_s
                and still <= limits.frozen_after_s
                and lane in self._counted
            ):
                stuck[lane] = f"silent: nobody for {silent:g} s on lane {lane}"
        return stuck


def _number(value: Any) -> float:
    if isinstance(value, str | bytes):
        raise TypeError(f"{value!r:.200} is text")
    return float(value)
