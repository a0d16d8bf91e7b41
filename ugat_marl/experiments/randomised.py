"""Domain randomisation: every episode in another world, drawn from the ranges of the effects.

It needs no data of the real domain, so methods that use such data must beat it. The effects are
those of the paper's domains V1 to V4. Each range spans the values of V1 to V4, of the simulation,
and of the diagnosis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ugat_marl.diagnosis import Hypothesis, free_values, global_hypotheses, ordered
from ugat_marl.effects import NO_SOFTER, PAPER_WORLDS, Domain, Effect, scenario_in_domain
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.grounding import DrawnEnv
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import numpy_generator


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


def drawn_effects(ranges: Sequence[Range], seed: int) -> tuple[Effect, ...]:
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


class RandomisedEnv(DrawnEnv):
    """Environment with another world in every episode, drawn from ranges of effects.

    Args:
        make_env: Makes an environment of the simulation with some effects.
        ranges: Ranges of the effects.
    """

    def __init__(
        self, make_env: Callable[[tuple[Effect, ...]], TrafficEnv], ranges: Sequence[Range]
    ) -> None:
        super().__init__(make_env(()), lambda seed: make_env(drawn_effects(ranges, seed)))


def randomised_env(
    scenario: Scenario, options: Mapping[str, Any], sim: Domain = "sim"
) -> RandomisedEnv:
    """Return an environment of worlds drawn around a simulation.

    Args:
        scenario: The network and its traffic.
        options: Options of the environments, see `EnvOptions`.
        sim: The simulation, as a domain of the scenario.
    """
    simulation = scenario_in_domain(scenario, sim, duration_s=options.get("duration_s"))

    def make(effects: tuple[Effect, ...]) -> TrafficEnv:
        return parallel_env(simulation, effects, **options)

    return RandomisedEnv(make, effect_ranges(simulation))
