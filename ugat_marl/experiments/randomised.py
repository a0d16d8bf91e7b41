"""Domain randomisation: every episode in another world, drawn from the ranges of the effects.

It needs no data of the real domain, so methods that use such data must beat it. The effects are
those of the paper's domains V1 to V4. Each range spans the values of V1 to V4, of the simulation,
and of the diagnosis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pettingzoo.utils import BaseParallelWrapper

from ugat_marl.diagnosis import Hypothesis, free_values, global_hypotheses, ordered
from ugat_marl.effects import PAPER_WORLDS, Domain, Effect, scenario_in_domain
from ugat_marl.envs import AgentSet, ResetResult, TrafficEnv, parallel_env
from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import numpy_generator

NO_SOFTER = {"emergency_deceleration": "deceleration"}
"""Effects with their lower bound: an emergency deceleration is at least the usual deceleration."""


@dataclass(frozen=True)
class Range:
    """Range of the values of an effect.

    Attributes:
        hypothesis: The effect with an open value.
        low: Smallest value, in the effect's unit.
        high: Largest value, in the effect's unit.
    """

    hypothesis: Hypothesis
    low: float
    high: float

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.hypothesis.name


def effect_ranges(scenario: Scenario) -> tuple[Range, ...]:
    """Return the ranges of the effects of V1 to V4 around a simulation.

    Each range holds the simulation's own value, those of V1 to V4, and the first values that the
    diagnosis tries, without the extreme ones.

    Args:
        scenario: The simulation; its vehicle types hold the present values.
    """
    settings = [effect for effects in PAPER_WORLDS.values() for effect in effects]
    ranges: list[Range] = []
    for hypothesis in global_hypotheses(scenario, {effect.name for effect in settings}):
        values = [level[0] for level in hypothesis.levels if level not in hypothesis.extreme]
        values += [free_values(e, hypothesis)[0] for e in settings if e.name == hypothesis.name]
        values += hypothesis.nominal or ()
        ranges.append(Range(hypothesis, min(values), max(values)))
    return tuple(ranges)


def drawn(ranges: Sequence[Range], seed: int) -> tuple[Effect, ...]:
    """Draw the world of an episode: each value uniform in its range, independent of the others.

    Args:
        ranges: Ranges of the effects.
        seed: Seed of the episode.
    """
    generator = numpy_generator(seed, "randomised")
    values = {each.name: float(generator.uniform(each.low, each.high)) for each in ranges}
    for name, least in NO_SOFTER.items():
        if name in values and least in values:
            values[name] = max(values[name], values[least])
    return ordered([each.hypothesis.effect((values[each.name],)) for each in ranges])


class RandomisedEnv(BaseParallelWrapper[str, Any, Any]):
    """Environment with another world in every episode; the seed of `reset` decides the world.

    The simulation of an episode ends before the next one begins.

    Args:
        make_env: Makes an environment of the simulation with some effects.
        ranges: Ranges of the effects.
    """

    def __init__(
        self, make_env: Callable[[tuple[Effect, ...]], TrafficEnv], ranges: Sequence[Range]
    ) -> None:
        super().__init__(make_env(()))
        self._make_env = make_env
        self._ranges = tuple(ranges)
        self._agents = AgentSet.of(self.env)
        self._generator = numpy_generator(0, "worlds")

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """Start an episode in a newly drawn world.

        Args:
            seed: Seed of world and traffic; None to draw it from the generator of the last seed.
            options: Passed to the environment.

        Raises:
            ScenarioError: The world has other agents than the simulation.
        """
        if seed is not None:
            self._generator = numpy_generator(seed, "worlds")
        else:
            seed = int(self._generator.integers(2**31))
        self.env.close()
        effects = drawn(self._ranges, seed)
        self.env = self._make_env(effects)
        if AgentSet.of(self.env) != self._agents:
            raise ScenarioError(
                f"the world {self.env.domain} has other agents, observations or phases than the "
                f"simulation: {AgentSet.of(self.env)}, not {self._agents}; draw effects on vehicles"
            )
        return self.env.reset(seed=seed, options=options)


def randomised_env(
    scenario: Scenario, options: Mapping[str, Any], sim: Domain = "sim"
) -> RandomisedEnv:
    """Return an environment of worlds drawn around a simulation.

    Args:
        scenario: The network and its traffic.
        options: Options of the environments, see `EnvOptions`.
        sim: The simulation, as a domain of the scenario.
    """
    simulation = scenario_in_domain(scenario, sim)

    def make(effects: tuple[Effect, ...]) -> TrafficEnv:
        return parallel_env(simulation, effects, **options)

    return RandomisedEnv(make, effect_ranges(simulation))
