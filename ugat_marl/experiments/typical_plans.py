"""Typical behaviour of a policy as a fixed-time plan that can be typed into a controller.

Episodes are played. For each light it is counted how long each phase is shown, how often each
movement gets green, and which phase follows which.

- Share of a movement: the time it has green, without clearance, divided by the whole time.
- Need of a phase: the largest share of the movements that no other phase of the plan serves.
- Phases of the plan: the fewest that serve every movement, and of these the ones whose needs add up
  to the least. A policy that chooses freely shows more phases, but one after the other they would
  waste the cycle with clearance.
- Cycle: the shortest in which every phase gets its need, C = L / (1 - sum of needs), where L is the
  clearance of all phases; at most `LONGEST_CYCLE_S`.
- Splits: every phase has its least green; the rest is divided by the needs.
"""

from __future__ import annotations

import cmath
import copy
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from ugat_marl.effects import Domain, domain_label
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.parallel import retry_on_crash
from ugat_marl.policies import LONGEST_CYCLE_S, Policy, PolicyFactory, roll_out, smallest_covers
from ugat_marl.progress import Reporter
from ugat_marl.scenarios import (
    GREEN,
    Intersection,
    Network,
    PlanPhase,
    Scenario,
    SignalPlan,
    movement_codes,
    programme_plan,
)

_MOST_SEARCHED = 16
"""Most phases for an exhaustive search of the fewest; with more the search is greedy."""
_STEADY = 0.5
"""Length of the mean unit vector of the cycles' begins, 0 to 1, from which an offset is given."""


@dataclass
class _Shown:
    """Phases of one light over some episodes.

    Attributes:
        served: Movements of each phase.
        decisions: Phase to the number of decisions in which it was shown.
        greens: Movement to the number of its greens.
        following: Pair of a phase and the next one to how often it came.
        begins_s: Phase to the times at which its green began, s on the scenario's clock.
    """

    served: Sequence[frozenset[str]]
    decisions: Counter[int] = field(default_factory=Counter[int])
    greens: Counter[str] = field(default_factory=Counter[str])
    following: Counter[tuple[int, int]] = field(default_factory=Counter[tuple[int, int]])
    begins_s: dict[int, list[float]] = field(default_factory=dict[int, list[float]])

    def add(
        self, phases: Sequence[int], begin_s: float, interval_s: float, clearance_s: float
    ) -> None:
        """Add the phases of one episode, one per decision."""
        self.decisions.update(phases)
        starts = [0, *(i for i, (a, b) in enumerate(pairwise(phases), 1) if a != b)]
        before = frozenset[str]()
        for start in starts:
            now = self.served[phases[start]]
            self.greens.update(now - before)
            # The first green has no clearance before it; its cycle is that of the others.
            green_s = begin_s + start * interval_s + clearance_s
            self.begins_s.setdefault(phases[start], []).append(green_s)
            before = now
        self.following.update(pairwise(phases[start] for start in starts))

    def share(self, movement: str, interval_s: float, clearance_s: float) -> float:
        """Return the share of the time in which a movement has green, without clearance."""
        shown = sum(n for phase, n in self.decisions.items() if movement in self.served[phase])
        green_s = shown * interval_s - self.greens[movement] * clearance_s
        return max(green_s, 0.0) / (sum(self.decisions.values()) * interval_s)


def typical_plans(
    scenario: Scenario,
    make: PolicyFactory,
    domain: Domain,
    seeds: Sequence[int],
    reporter: Reporter,
) -> tuple[SignalPlan, ...]:
    """Play a policy and return the plan that shows each phase as long as it does.

    Args:
        scenario: The scenario.
        make: Maker of the policy.
        domain: Domain to play in.
        seeds: Seeds of the episodes.
        reporter: Shows progress.

    Returns:
        A plan for every agent. Splits are whole seconds; no green is below the minimum green.
        The offset is 0 where the light has no steady cycle. A policy that leaves the lights to
        their programmes gives the plans of these.

    Raises:
        OptionError: There is no seed, or the policy would be played in SUMO's queue model.
    """
    if not seeds:
        raise OptionError("a typical plan needs at least one seed")
    world = parallel_env(scenario, domain)
    policy = make(world)
    env = parallel_env(world.scenario, **policy.env_options)
    network, control = env.network, env.scenario.control
    if env.options.signals == "programme":
        return tuple(programme_plan(light, network) for light in network.intersections)
    if env.scenario.settings.is_mesoscopic:
        raise OptionError(
            f"scenario {scenario.id!r} in domain {domain_label(domain)!r} runs in SUMO's queue "
            "model, where agents show red instead of yellow, so the plan would have no yellow; "
            "leave out queue_model"
        )
    shown = [_Shown(_served(light, network)) for light in network.intersections]
    begin_s, clearance_s = env.scenario.settings.begin_s, env.scenario.timing.clearance_s
    try:
        with reporter.task("playing episodes", len(seeds)) as advance:
            for seed in seeds:
                course = retry_on_crash(lambda seed=seed: _course(env, policy, seed))
                for light, phases in zip(shown, zip(*course, strict=True), strict=True):
                    light.add(phases, begin_s, control.decision_interval_s, clearance_s)
                advance()
    finally:
        env.close()
    return tuple(
        _plan(light.id, counts, env.scenario)
        for light, counts in zip(network.intersections, shown, strict=True)
    )


def _served(light: Intersection, network: Network) -> list[frozenset[str]]:
    """Return the movements of each phase."""
    codes = movement_codes(light, network)
    return [
        frozenset(code for link, code in codes.items() if state[link.index] in GREEN)
        for state in light.phases
    ]


def _course(env: TrafficEnv, policy: Policy, seed: int) -> list[list[int]]:
    """Return the phases of an episode, decision by decision."""
    course: list[list[int]] = []
    played = copy.deepcopy(policy)  # a user's policy may remember earlier episodes
    roll_out(env, played, seed, on_step=lambda _: course.append(env.phases))
    return course


def _plan(light: str, shown: _Shown, scenario: Scenario) -> SignalPlan:
    control, clearance_s = scenario.control, scenario.timing.clearance_s
    shares = {
        movement: shown.share(movement, control.decision_interval_s, clearance_s)
        for movement in sorted(frozenset[str]().union(*shown.served))
    }
    needs = _fewest(shown.served, shares)
    least_s = math.ceil(control.min_green_s + clearance_s)
    cycle_s = _shortest_cycle_s(needs, clearance_s, least_s)
    whole_s = max(math.ceil(min(cycle_s, LONGEST_CYCLE_S) - 1e-6), least_s * len(needs))
    wanted_s = {phase: clearance_s + need * whole_s for phase, need in needs.items()}
    splits_s = _divided(whole_s, least_s, wanted_s)
    order = _order(list(needs), shown)
    phases = tuple(
        PlanPhase(
            1, 1, tuple(sorted(shown.served[phase])), float(splits_s[phase]),
            control.yellow_s, control.all_red_s,
        )
        for phase in order
    )  # fmt: skip
    offset_s = _offset_s(shown.begins_s.get(order[0], []), float(whole_s))
    return SignalPlan(light, float(whole_s), offset_s, phases)


def _shortest_cycle_s(needs: Mapping[int, float], clearance_s: float, least_s: float) -> float:
    """Return the shortest cycle that gives every phase its need, s; infinite if there is none.

    A phase whose need takes less than `least_s` lasts that long, and the others need more.
    """
    longer: set[int] = set()
    while True:
        left = 1.0 - sum(needs[phase] for phase in longer)
        if left <= 0:
            return math.inf
        cycle_s = (least_s * (len(needs) - len(longer)) + clearance_s * len(longer)) / left
        more = {phase for phase, need in needs.items() if clearance_s + need * cycle_s > least_s}
        if more <= longer:
            return cycle_s
        longer |= more


def _divided(cycle_s: int, least_s: int, wanted_s: Mapping[int, float]) -> dict[int, int]:
    """Return whole seconds that add up to the cycle: the least for each, the rest as wanted."""
    above = {phase: max(seconds - least_s, 0.0) for phase, seconds in wanted_s.items()}
    if not sum(above.values()):
        above = dict.fromkeys(above, 1.0)
    rest, total = cycle_s - least_s * len(above), sum(above.values())
    wanted = {phase: rest * seconds / total for phase, seconds in above.items()}
    splits = {phase: least_s + math.floor(seconds) for phase, seconds in wanted.items()}
    by_remainder = sorted(wanted, key=lambda phase: math.floor(wanted[phase]) - wanted[phase])
    for place in range(cycle_s - sum(splits.values())):
        splits[by_remainder[place % len(by_remainder)]] += 1
    return splits


def _fewest(served: Sequence[frozenset[str]], shares: Mapping[str, float]) -> dict[int, float]:
    """Return the fewest phases that serve all movements, with their needs; see the module."""
    needs = [_needs(cover, served, shares) for cover in smallest_covers(served, _MOST_SEARCHED)]
    return min(needs, key=lambda own: sum(own.values()))


def _needs(
    kept: Sequence[int], served: Sequence[frozenset[str]], shares: Mapping[str, float]
) -> dict[int, float]:
    needs: dict[int, float] = {}
    for phase in kept:
        others = frozenset[str]().union(*(served[other] for other in kept if other != phase))
        needs[phase] = max((shares[movement] for movement in served[phase] - others), default=0.0)
    return needs


def _order(kept: Sequence[int], shown: _Shown) -> list[int]:
    """Return the phases from the longest on, each followed by its most frequent successor."""
    order = [max(kept, key=lambda phase: shown.decisions[phase])]
    while len(order) < len(kept):
        left = [phase for phase in kept if phase not in order]
        order.append(max(left, key=lambda phase: shown.following[order[-1], phase]))
    return order


def _offset_s(begins_s: Sequence[float], cycle_s: float) -> float:
    """Return the usual start of a cycle, whole s; 0 if the begins are spread over the cycle."""
    if not begins_s:
        return 0.0
    mean = sum(cmath.rect(1, 2 * math.pi * t / cycle_s) for t in begins_s) / len(begins_s)
    if abs(mean) < _STEADY:
        return 0.0
    return float(round(cmath.phase(mean) / (2 * math.pi) * cycle_s) % round(cycle_s))
