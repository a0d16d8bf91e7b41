"""Field loop: once per decision it reads counts, checks them, decides and sets the lights.

A decision is ready within `TrustLimits.answer_ms`. If the policy has not answered by then, the
lights follow the fixed-time plan. Every answer goes through the signal machines of
`ugat_marl.field.safety`.
"""

from __future__ import annotations

import functools
import time
from array import array
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ugat_marl.envs import checked_phases
from ugat_marl.field.answering import Answering, Late, NoAnswer
from ugat_marl.field.decisions import Decision, DecisionLog
from ugat_marl.field.lights import Lights
from ugat_marl.field.safety import PolicyTrust, fixed_time
from ugat_marl.field.site import Site
from ugat_marl.field.street import LaneCount, Street
from ugat_marl.field.watchdog import TrustLimits, Watchdog
from ugat_marl.policies import Policy
from ugat_marl.scenarios import GREEN, Segment

_WARM_UP_S = 30.0


@dataclass
class LoopSummary:
    """Counts of a run: decisions, latencies, faults.

    Attributes:
        decisions: Number of decisions.
        latencies_ms: Latency of each decision, ms.
        light_decisions: Number of decisions times number of lights.
        reasons: Kind of fault to the number of times it sent a single light to the plan.
    """

    decisions: int = 0
    latencies_ms: array[float] = field(default_factory=lambda: array("d"))
    light_decisions: int = 0
    reasons: Counter[str] = field(default_factory=Counter)

    def add(self, decision: Decision) -> None:
        """Count a decision."""
        self.decisions += 1
        self.latencies_ms.append(decision.latency_ms)
        self.light_decisions += len(decision.phases)
        self.reasons.update(reason.partition(":")[0] for reason in decision.fallback.values())

    @property
    def fallback_share(self) -> float:
        """Share of the decisions of single lights that the plan made, 0 to 1."""
        return sum(self.reasons.values()) / max(self.light_decisions, 1)

    def latency_ms(self, quantile: float) -> float:
        """Return a quantile of the latencies, ms; NaN before the first decision."""
        if not self.latencies_ms:
            return float("nan")
        return float(np.quantile(self.latencies_ms, quantile))


class FieldLoop:
    """Control of a street's lights by a policy, as long as counts and policy can be trusted.

    Args:
        site: The intersections, with the policy's observation.
        policy: The policy; it runs in a thread of its own.
        street: The street whose counts are read and whose lights are set.
        limits: Limits of trust; None for the default values.
        log: Log of the decisions, which the caller closes; None for no log.

    Attributes:
        summary: Counts of all decisions.
        driven_s: Time of all decisions on the street's clock, s.

    Raises:
        OptionError: The street lacks a light, or a light shows a state that it cannot have.
    """

    def __init__(
        self,
        site: Site,
        policy: Policy,
        street: Street,
        limits: TrustLimits | None = None,
        log: DecisionLog | None = None,
    ) -> None:
        self._site, self._policy, self._log = site, policy, log
        self._limits = limits = limits or TrustLimits()
        interval = site.decision_interval_s
        self._plan = fixed_time(site.network, interval, site.timing, limits.green_s)
        self.summary = LoopSummary()
        self.driven_s = 0.0
        self._recorded = Decision(0.0, {}, {}, 0.0, 0.0)
        self._answer = _answer_of(policy, site)
        lights = Lights(site, street, limits)  # a street that does not answer leaves no thread
        self._asked = Answering()
        self._begin(street, lights)

    def take_over(self, street: Street) -> None:
        """Go on with a street that came back, from what its lights show now.

        Raises:
            SimulatorError: The street shows none of the lights.
        """
        self._begin(street, Lights(self._site, street, self._limits, all_seen=False))

    def _begin(self, street: Street, lights: Lights) -> None:
        self._street, self._lights = street, lights
        self._memory = self._site.observer.memory(self._site.decision_interval_s)
        if self._memory is not None:
            self._memory.reset([light.phase for light in lights.machines.values()])
        self._watchdog = Watchdog(self._site.capacity, self._site.halting, self._limits)
        self._green_s: Mapping[str, float] = {}
        self._trust = PolicyTrust(self._site.lights, self._limits.return_after)
        self._warm_up(self._policy)

    def drive(
        self, seconds: float, on_decision: Callable[[Decision], None] | None = None
    ) -> LoopSummary:
        """Drive the street for `seconds`, rounded up to whole decisions; return `summary`.

        Raises:
            SimulatorError: The connection to the street is lost; no light can be set any more.
        """
        until = self._street.now_s() + seconds - 1e-6
        while (now := self._street.now_s()) < until:
            begun = time.perf_counter()
            decision, plans = self.decide()
            self._lights.act(plans, functools.partial(self._record, begun, decision, plans))
            self.driven_s += self._street.now_s() - now
            if on_decision is not None:
                on_decision(self._recorded)
        return self.summary

    def decide(self) -> tuple[Decision, dict[str, list[Segment]]]:
        """Read the counts, check them and decide; no light is set yet.

        Returns:
            The decision, and traffic light to its states in the coming interval.
        """
        begun = time.perf_counter()
        now = float(self._street.now_s())
        disobeying = self._lights.faults()
        counts, faults = self._look(now)
        faults |= disobeying
        read_ms = _ms_since(begun)
        requested: list[int] = []
        lights = self._lights.machines
        if len(faults) < len(lights):
            requested, wrong = self._ask(counts, now, begun)
            if wrong:
                faults = dict.fromkeys(lights, wrong) | faults
        fallback = self._trust.judge(faults)
        phases = self._plan.act({}, {})
        for light, phase in zip(lights, requested, strict=False):
            if light not in fallback:
                phases[light] = phase
        plans = self._lights.plan(phases)
        if self._memory is not None:
            asked = [phases[name] for name in lights]
            self._memory.add(asked, [light.phase for light in lights.values()])
        decision = Decision(now, phases, fallback, read_ms, _ms_since(begun))
        return decision, plans

    def _record(self, begun: float, decision: Decision, plans: Mapping[str, list[Segment]]) -> None:
        """Log and count a decision, after its first states are set: no light waits for a disk.

        A signal may end the loop in between. So every decision that is counted is in the log.
        """
        self._recorded = decision = replace(decision, latency_ms=_ms_since(begun))
        if self._log is not None:
            self._log.add(decision)
        self.summary.add(decision)
        self._green_s = _green_s(self._site, plans)

    def close(self) -> None:
        """Let the policy's thread end; the lights keep their states."""
        self._asked.close()

    def _look(self, now: float) -> tuple[dict[str, LaneCount], dict[str, str]]:
        """Return the trusted counts, and light to its fault.

        A light is at fault if it needs a count that is not trusted, or if it is not taken over yet.
        """
        try:
            counts, wrong = self._watchdog.check(self._street.read(), now, self._green_s)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever a detector's driver raises
            self._watchdog.check({}, now)  # what comes after the gap is a change
            reason = f"missing: no counts at all, {type(error).__name__}: {error}"
            return {}, dict.fromkeys(self._lights.machines, reason)
        faults: dict[str, str] = {}
        for name, light in self._lights.machines.items():
            reasons = [wrong[lane] for lane in self._site.sees[name] if lane in wrong]
            if reasons:
                faults[name] = reasons[0] + (f" (+{len(reasons) - 1})" if reasons[1:] else "")
            elif not light.taken_over:
                faults[name] = "beginning: it shows what is none of its phases"
        return counts, faults

    def _ask(
        self, counts: Mapping[str, LaneCount], now: float, begun: float
    ) -> tuple[list[int], str]:
        """Return the policy's phases in the order of the lights, or the reason why there are none.

        `begun` is the start of the decision by `time.perf_counter`, s.
        """
        limits = self._limits
        phases = [light.phase for light in self._lights.machines.values()]
        observations = self._site.observe(counts, now, phases, self._memory)
        within_ms = limits.answer_ms - limits.reserve_ms
        if _ms_since(begun) >= within_ms:
            return [], f"late: {within_ms:g} ms were over before the policy could be asked"

        def left_s() -> float:
            return (within_ms - _ms_since(begun)) / 1e3

        try:
            if self._reset_due:
                self._asked.ask(self._policy.reset, 0, within_s=left_s())
                self._reset_due = False
            return self._asked.ask(self._answer, observations, self._infos(), within_s=left_s()), ""
        except Late as late:
            return [], f"late: {late}"
        except NoAnswer as error:
            return [], f"policy: {error}"

    def _infos(self) -> dict[str, dict[str, Any]]:
        interval = self._site.decision_interval_s
        lights = zip(self._site.observer.agents, self._lights.machines.values(), strict=True)
        return {
            agent: {"action_mask": light.free(interval), "executed_action": light.phase}
            for agent, light in lights
        }

    def _warm_up(self, policy: Policy) -> None:
        """Ask the policy once before the first decision: a network's first answer takes longest."""
        self._reset_due = True  # a policy that is still busy with another street is reset later
        try:
            now, phases = self._street.now_s(), [0] * len(self._lights.machines)
            nothing = self._site.observe({}, now, phases, self._memory)
            for function, arguments in (
                (policy.reset, (0,)),
                (self._answer, (nothing, self._infos())),
                (policy.reset, (0,)),
            ):
                self._asked.ask(function, *arguments, within_s=_WARM_UP_S)
            self._reset_due = False
        except NoAnswer:
            return  # the first decision meets the same failure and reports it


def _answer_of(policy: Policy, site: Site) -> Callable[..., list[int]]:
    """Return a function that asks the policy and checks its answer."""
    agents, spaces = site.observer.agents, site.spaces

    def answer(observations: Any, infos: Any) -> list[int]:
        return checked_phases(policy.act(observations, infos), agents, spaces)

    return answer


def _green_s(site: Site, plans: Mapping[str, list[Segment]]) -> dict[str, float]:
    """Return the time for which each lane in front of a light has green in these plans, s."""
    green_s: dict[str, float] = {}
    for intersection in site.network.intersections:
        green_s |= dict.fromkeys(intersection.incoming_lanes, 0.0)
        for seconds, state in plans.get(intersection.id, ()):
            for lane in {x.from_lane for x in intersection.links if state[x.index] in GREEN}:
                green_s[lane] = green_s.get(lane, 0.0) + seconds
    return green_s


def _ms_since(begun: float) -> float:
    return 1e3 * (time.perf_counter() - begun)
