"""Posterior over worlds: effects and the service of lanes that explain a log of the street.

Worlds are drawn from a prior over the effects of the library and over the green that single lanes
do not use. The policy of the log acts in each. A regression answers from the statistics of these
logs (`summaries`) what the drawn values were, and how it answers in worlds left out of it is
measured (`regression`). Together they give draws of the worlds that the street's log leaves
possible.

The prior gives each effect a chance to be absent; draws are without those that the log does not ask
for (`presence`). Worlds to learn from have most effects, whatever their chance: a regression that
seldom sees an effect says too little of it. They are without some, too: near a street without an
effect, worlds that all have it would answer that it is there.

All values are estimated together, with the correlation of their errors. Lanes share the regression
and the network's statistics, so where a lane's log says little its draws follow the network.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects import (
    EVERYWHERE,
    NO_SOFTER,
    ControllerPart,
    Effect,
    known_effects,
    nominal_number,
)
from ugat_marl.errors import CheckpointError, UnknownNameError
from ugat_marl.files import MALFORMED
from ugat_marl.grounding.draws import DRAWS, quantile_metrics
from ugat_marl.grounding.presence import LEAST_SPREAD, Presence, lanes_differ
from ugat_marl.grounding.regression import Calibration, Design, Floats, kernel, left_out, ridge
from ugat_marl.grounding.summaries import Summary
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import numpy_generator


@dataclass(frozen=True)
class EffectPrior:
    """Prior of an effect with one number for the whole network.

    Attributes:
        name: Name of the effect.
        low: Smallest value, in the effect's unit.
        high: Largest value.
        nominal: Value that changes nothing.
        chance: Chance that the effect is there; otherwise its value is nominal.
        log: True to draw and to estimate the logarithm: half of a small value changes as much as
            half of a large one.
    """

    name: str
    low: float
    high: float
    nominal: float
    chance: float = 0.35
    log: bool = False

    def of(self, scenario: Scenario) -> EffectPrior:
        """Return the prior with a scenario's nominal value, which its range includes."""
        kind = known_effects()[self.name]
        nominal = nominal_number(scenario, kind.attribute, self.nominal)
        low, high = min(self.low, nominal), max(self.high, nominal)
        return replace(self, low=low, high=high, nominal=nominal)


LIBRARY = (
    EffectPrior("acceleration", 0.4, 3.0, 2.6, 0.5, log=True),
    EffectPrior("deceleration", 1.2, 5.0, 4.5, 0.5, log=True),
    EffectPrior("emergency_deceleration", 2.0, 9.0, 9.0, 0.5, log=True),
    EffectPrior("startup_delay", 0.0, 1.0, 0.0, 0.5),
    EffectPrior("headway", 0.8, 2.2, 1.0),
    EffectPrior("desired_speed", 0.6, 1.1, 1.0),
    EffectPrior("demand_level", 0.8, 1.25, 1.0),
)
"""Effects whose values are estimated, with wide ranges around those of V1 to V4."""


@dataclass(frozen=True)
class ServicePrior:
    """Prior of the green that single lanes do not use, see `ugat_marl.effects.LaneService`.

    Attributes:
        chance: Chance that the network's mean is above 0.
        high_s: Largest mean, in s.
        unequal: Chance that lanes differ.
    """

    chance: float
    high_s: float
    unequal: float = 0.5

    def log_odds(self, differ: float) -> float:
        """Return the log of the odds that some lane has unused green.

        It has none if the mean is 0 and lanes do not differ.

        Args:
            differ: Log of how much more likely the lanes' data are if lanes differ.
        """
        equal = np.log(self.chance * (1.0 - self.unequal))
        there = np.logaddexp(equal, np.log(self.unequal) + differ)
        return float(there - np.log((1.0 - self.chance) * (1.0 - self.unequal)))


SERVICE = (ServicePrior(0.5, 5.0), ServicePrior(0.35, 3.0))
"""Priors of the red at the beginning of a green, and of the red in each further decision."""

UNCHANGED = 1e-3
"""Distance from nominal up to which an effect is left out of a world, in its unit; values have four
decimals."""


@dataclass(frozen=True)
class WorldValues:
    """Values of one world.

    Attributes:
        effects: ``(effects,)``, in the order of the library.
        service_s: ``(lanes, 2)``, red at the beginning of greens and in each further decision.
    """

    effects: Floats
    service_s: Floats


@dataclass(frozen=True)
class WorldPrior:
    """Prior of the worlds of a network.

    Attributes:
        library: Effects with their priors.
        lanes: Ids of the lanes.
        service: True to estimate the service of lanes.
    """

    library: tuple[EffectPrior, ...]
    lanes: tuple[str, ...]
    service: bool = True

    @classmethod
    def of(
        cls,
        lanes: Sequence[str],
        without: Sequence[str] = (),
        service: bool = True,
        scenario: Scenario | None = None,
    ) -> WorldPrior:
        """Return the prior of a network.

        Args:
            lanes: Ids of the lanes.
            without: Effects to leave out.
            service: True to estimate the service of lanes.
            scenario: The simulation without effects of the library; its vehicle types give the
                nominal values. None for those of SUMO's passenger car.

        Raises:
            UnknownNameError: An effect to leave out is not in the library.
        """
        names = [item.name for item in LIBRARY]
        for name in without:
            if name not in names:
                raise UnknownNameError("effect of the library", name, names)
        library = tuple(item for item in LIBRARY if item.name not in without)
        if scenario is not None:
            library = tuple(item.of(scenario) for item in library)
        return cls(library, tuple(lanes), service)

    @property
    def ends(self) -> Floats:
        """Lowest, nominal and highest values of the effects, ``(3, effects)``."""
        return np.array([(x.low, x.nominal, x.high) for x in self.library]).reshape(-1, 3).T

    def draw(self, seed: int, chance: float | None = None) -> WorldValues:
        """Draw a world from the prior.

        Args:
            seed: Seed of the world.
            chance: Chance of each effect, and of the red that all lanes share, to be there; None
                for the prior's.
        """
        generator = numpy_generator(seed, "worlds", "prior")

        def is_there(usual: float) -> bool:
            return bool(generator.random() < (usual if chance is None else chance))

        there = [is_there(item.chance) for item in self.library]
        low, nominal, high = self.ends
        drawn = self.natural(generator.uniform(self.scaled(low), self.scaled(high)))
        effects = np.where(there, drawn, nominal)
        service_s = np.zeros((len(self.lanes), len(SERVICE)))
        for column, prior in zip(service_s.T, SERVICE, strict=True):
            mean = generator.uniform(0.0, prior.high_s) if is_there(prior.chance) else 0.0
            unequal = generator.random() < prior.unequal
            spread = generator.uniform(0.0, prior.high_s / 2) if unequal else 0.0
            column += mean + spread * generator.standard_normal(len(self.lanes))
        return self.clipped(WorldValues(effects, service_s * self.service))

    def scaled(self, effects: Floats) -> Floats:
        """Return values of the effects on the scale of the estimate, ``(..., effects)``."""
        log = np.array([x.log for x in self.library], dtype=np.bool_)
        return np.where(log, np.log(np.where(log, effects, 1.0)), effects)

    def natural(self, scaled: Floats) -> Floats:
        """Return the effects of which `scaled` gave the values."""
        log = np.array([x.log for x in self.library], dtype=np.bool_)
        return np.where(log, np.exp(np.where(log, scaled, 0.0)), scaled)

    def clipped(self, values: WorldValues) -> WorldValues:
        """Return the values within their ranges."""
        low, _, high = self.ends
        effects = np.clip(values.effects, low, high)
        names = [item.name for item in self.library]
        for hard, soft in NO_SOFTER.items():
            if hard in names and soft in names:
                least = effects[names.index(soft)]
                effects[names.index(hard)] = max(effects[names.index(hard)], least)
        most_s = np.array([2.0 * prior.high_s for prior in SERVICE])
        return WorldValues(effects, np.clip(values.service_s, 0.0, most_s))

    def effects(self, values: WorldValues) -> tuple[Effect, ...]:
        """Return the effects of a world that change something; those on demand come first."""
        made: list[Effect] = []
        for item, value in zip(self.library, values.effects, strict=True):
            if abs(value - item.nominal) > UNCHANGED:
                kind = known_effects()[item.name]
                given = dict.fromkeys(kind.texts, EVERYWHERE) | {
                    next(iter(kind.ranges)): round(float(value), 4)
                }
                made.append(kind(**given))
        return tuple(sorted(made, key=lambda effect: effect.name != "demand_level"))


class FittedService(ControllerPart):
    """Red in the greens of single lanes, as a change of an environment.

    Args:
        lanes: Ids of the lanes.
        service_s: ``(lanes, 2)``, as in `WorldValues`.
    """

    name: ClassVar[str] = "fitted service"

    def __init__(self, lanes: Sequence[str], service_s: Floats) -> None:
        self._red = {
            lane: (round(begin, 2), round(each, 2))
            for lane, (begin, each) in zip(lanes, service_s.tolist(), strict=True)
            if begin >= 0.01 or each >= 0.01
        }

    def service(self) -> Mapping[str, tuple[float, float]]:
        """Return lane to red in its greens, in s: at their beginning, and in each decision."""
        return self._red

    def state_dict(self) -> dict[str, Any]:
        """Return the lanes with red and their seconds."""
        return {"lanes": list(self._red), "service_s": list(map(list, self._red.values()))}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> FittedService:
        """Restore `state_dict`."""
        return cls(state["lanes"], np.array(state["service_s"], float).reshape(-1, 2))


@dataclass(frozen=True)
class SimulatedLog:
    """A simulated world and the statistics of its log."""

    values: WorldValues
    summary: Summary


NAMED = 0.1
"""Least chance of an effect that is said."""

BEYOND = 0.5
"""Share of a log's statistics beyond those of all worlds above which it is unlike them. Of streets
drawn from the prior of `single-v1` at most one in a hundred is above it, with 60 worlds or more."""
BEYOND_AT_END = 0.1
"""The same share where an effect is answered beyond its range, too: two in a hundred."""


@dataclass(frozen=True)
class Posterior:
    """Draws of the worlds that the street's log leaves possible.

    Attributes:
        worlds: The prior.
        answer: Regression's answer for the street: effects on the scale of `WorldPrior.scaled`, and
            the lanes' mean service in s, ``(effects + 2,)``.
        calibration: How the regression answers.
        offsets_s: Answer for the distance of each lane from the mean, in s, ``(lanes, 2)``.
        offset_errors_s: Its residuals in the simulated worlds, ``(n, lanes, 2)``.
        chances: Weights of these residuals, ``(n,)``.
        beyond: Share of the network's statistics in the street's log that are beyond those of all
            simulated worlds, ``()``.
    """

    worlds: WorldPrior
    answer: Floats
    calibration: Calibration
    offsets_s: Floats
    offset_errors_s: Floats
    chances: Floats
    beyond: Floats

    @classmethod
    def fit(
        cls, worlds: WorldPrior, simulated: Sequence[SimulatedLog], street: Summary
    ) -> Posterior:
        """Fit the regression to simulated worlds and apply it to the street.

        What the street or all worlds lack at a lane is left out in both.

        Args:
            worlds: The prior.
            simulated: Simulated worlds, more than values that are estimated for the network and 1.
            street: Statistics of the street's log.
        """
        number, lanes = len(simulated), len(worlds.lanes)
        in_worlds = np.any([~np.isnan(item.summary.values) for item in simulated], axis=0)
        known = in_worlds & ~np.isnan(street.values)
        street, *summaries = (s.where(known) for s in (street, *(w.summary for w in simulated)))
        network = np.stack([summary.network for summary in summaries])
        told = ~np.isnan(street.network)
        low, high = np.nanmin(network[:, told], 0), np.nanmax(network[:, told], 0)
        beyond = (street.network[told] < low) | (street.network[told] > high)
        design = Design.of(network)
        x, x_street = design.inputs(network), design.inputs(street.network[None])
        effects = worlds.scaled(np.stack([item.values.effects for item in simulated]))
        service_s = np.stack([item.values.service_s for item in simulated])
        mean_s = service_s.mean(1)
        wanted = np.concatenate([effects, mean_s], axis=1)
        predicted, penalty = left_out(x, wanted, np.arange(number))
        answer = (x_street @ ridge(x, wanted, penalty))[0]
        errors = wanted - predicted

        # Lanes: their distance from the network's mean, from that of their statistics.
        unlike = np.stack([summary.values - summary.network for summary in summaries])
        usual = np.stack([_mean(unlike[:, lane]) for lane in range(lanes)])
        rows = (unlike - usual).reshape(number * lanes, -1)
        own = Design.of(rows)
        of_world = np.repeat(x[:, 1:], lanes, axis=0)
        x_lane = np.concatenate([own.inputs(rows), of_world], axis=1)
        offset_s = (service_s - mean_s[:, None]).reshape(number * lanes, -1)
        found_s, lane_penalty = left_out(x_lane, offset_s, np.repeat(np.arange(number), lanes))
        street_rows = own.inputs(street.values - street.network - usual)
        x_street_lane = np.concatenate(
            [street_rows, np.repeat(x_street[:, 1:], lanes, axis=0)], axis=1
        )
        answer_s = x_street_lane @ ridge(x_lane, offset_s, lane_penalty)
        lane_errors = (offset_s - found_s).reshape(service_s.shape)
        return cls(
            worlds,
            answer,
            Calibration.of(wanted, predicted),
            answer_s - answer_s.mean(0),
            lane_errors - lane_errors.mean(1, keepdims=True),
            kernel(predicted, answer, errors),
            np.array(beyond.sum() / max(beyond.size, 1)),
        )

    def draw(self, seed: int, chance: float | None = None) -> WorldValues:
        """Draw the values of a world.

        Args:
            seed: Seed of the world.
            chance: Chance of each effect, and of the red that all lanes share, to be there; None
                for the chances that the log leaves.
        """
        return self.drawn(numpy_generator(seed, "worlds", "posterior"), chance)

    def drawn(self, generator: np.random.Generator, chance: float | None = None) -> WorldValues:
        """Draw the values of a world with a generator, see `draw`."""
        row = int(generator.choice(len(self.chances), p=self.chances))
        values, there = self.presence.drawn(generator, chance)
        split = len(self.worlds.library)
        service_s = values[split:] + self.offsets_s + self.offset_errors_s[row]
        service_s = at_least_0(service_s) * there[split:] * self.worlds.service
        return self.worlds.clipped(WorldValues(self.worlds.natural(values[:split]), service_s))

    @functools.cached_property
    def presence(self) -> Presence:
        """Chances that the effects, and the red of lanes, are there."""
        worlds = self.worlds
        lanes_s = np.sqrt(np.einsum("n,nlc->lc", self.chances, self.offset_errors_s**2))
        log_odds = [math.log(item.chance / (1.0 - item.chance)) for item in worlds.library]
        for column, prior in enumerate(SERVICE):
            differ = lanes_differ(
                self.offsets_s[:, column],
                lanes_s[:, column] + LEAST_SPREAD * prior.high_s,
                prior.high_s / 2,
            )
            log_odds.append(prior.log_odds(differ))
        least, usual, most = worlds.scaled(worlds.ends)
        none_s = np.zeros(len(SERVICE))
        low, nominal = (np.concatenate((values, none_s)) for values in (least, usual))
        high = np.concatenate((most, [prior.high_s for prior in SERVICE]))
        return Presence.of(log_odds, self.calibration, self.answer, nominal, low, high)

    @property
    def beyond_range(self) -> list[str]:
        """Names of effects answered beyond their range by more than a standard deviation."""
        low, _, high = self.worlds.scaled(self.worlds.ends)
        answer = self.answer[: len(low)]
        error = np.sqrt(np.diag(self.calibration.covariance))[: len(low)]
        outside = (answer < low - error) | (answer > high + error)
        return [
            item.name for item, is_out in zip(self.worlds.library, outside, strict=True) if is_out
        ]

    @property
    def is_unlike(self) -> bool:
        """True if no simulated world is like the street; what is fitted then says little."""
        limit = BEYOND_AT_END if self.beyond_range else BEYOND
        return bool(self.beyond > limit)

    def sample(self, number: int, seed: int = 0) -> tuple[Floats, Floats]:
        """Return effects ``(number, effects)`` and service ``(number, lanes, 2)`` of draws."""
        generator = numpy_generator(seed, "worlds", "sample")
        drawn = [self.drawn(generator) for _ in range(number)]
        return np.stack([v.effects for v in drawn]), np.stack([v.service_s for v in drawn])

    @functools.cached_property
    def _draws(self) -> tuple[Floats, Floats]:
        """Draws of which intervals are told."""
        return self.sample(DRAWS)

    def describe(self) -> list[str]:
        """Return what was found, a line for each part that was fitted.

        Another line says it if no simulated world is like the street.
        """
        effects, service_s = self._draws
        lines: list[str] = []
        if self.is_unlike:
            effects_beyond = ", ".join(self.beyond_range) or "none"
            lines.append(
                f"the log is unlike every simulated world: {self.beyond:.0%} of its statistics are "
                f"beyond theirs (effects at the end of their range: {effects_beyond}); trust no "
                "fitted value, and compare the simulation's network and traffic with the street's"
            )
        if self.worlds.library:
            low, high = np.quantile(effects, (0.05, 0.95), axis=0).round(4)  # as in a world
            ranges = zip(self.worlds.library, low, high, strict=True)
            named = [
                f"{x.name} {a:.2g} to {b:.2g} ({chance:.0%})"
                for place, (x, a, b) in enumerate(ranges)
                if (chance := self.presence.chance_of(place)) >= NAMED
            ]
            lines.append(f"effects: {', '.join(named) or 'none'}")
        if self.worlds.service:
            begin_s, each_s = service_s.mean(0).T
            lines.append(
                f"greens: {begin_s.min():.1f} to {begin_s.max():.1f} s unused at their beginning, "
                f"{each_s.min():.1f} to {each_s.max():.1f} s in each further decision"
            )
        return lines

    def as_dict(self, lanes_of: Mapping[str, Sequence[int]]) -> dict[str, float]:
        """Return flat numbers for the metrics of a run: medians and 90 % intervals.

        Where no simulated world is like the street, ``street/beyond_worlds`` is `beyond`.

        Args:
            lanes_of: Agent to the positions of its lanes.
        """
        effects, service_s = self._draws
        numbers: dict[str, float] = {}
        if self.is_unlike:
            numbers["street/beyond_worlds"] = float(self.beyond)
        for place, item in enumerate(self.worlds.library):
            low, middle, high = np.quantile(effects[:, place], (0.05, 0.5, 0.95))
            numbers[f"effects/{item.name}"] = float(middle)
            numbers[f"effects/{item.name}/low"] = float(low)
            numbers[f"effects/{item.name}/high"] = float(high)
            numbers[f"effects/{item.name}/nominal"] = item.nominal
            numbers[f"effects/{item.name}/chance"] = self.presence.chance_of(place)
        if not self.worlds.service:
            return numbers
        for lane, (begin_s, each_s) in zip(self.worlds.lanes, service_s.mean(0), strict=True):
            numbers[f"service/begin_s/{lane}"] = float(begin_s)
            numbers[f"service/each_s/{lane}"] = float(each_s)
        for column, name in enumerate(("unused/begin_s", "unused/each_s")):
            unused_s = service_s[:, :, column]
            means_s = [unused_s[:, list(places)].mean(1) for places in lanes_of.values()]
            numbers |= quantile_metrics(name, np.array(means_s), lanes_of)
        return numbers

    def state_dict(self) -> dict[str, Any]:
        """Return the posterior's numbers as plain values."""
        own = {name: getattr(self, name) for name in _NUMBERS}
        return {name: numbers.tolist() for name, numbers in (own | vars(self.calibration)).items()}

    @classmethod
    def from_state(cls, worlds: WorldPrior, state: Mapping[str, Any]) -> Posterior:
        """Restore `state_dict`.

        Raises:
            CheckpointError: A value is missing or of a wrong shape.
        """
        names = [*_NUMBERS, *(field.name for field in fields(Calibration))]
        try:
            parts: dict[str, NDArray[np.float64]]
            parts = {name: np.array(state[name], dtype=np.float64) for name in names}
        except MALFORMED as error:
            raise CheckpointError(f"the worlds in the checkpoint are damaged: {error}") from None
        number, lanes = len(parts["chances"]), len(worlds.lanes)
        values = len(worlds.library) + len(SERVICE)
        shapes = {
            "answer": (values,),
            "constant": (values,),
            "slopes": (values, values),
            "covariance": (values, values),
            "offsets_s": (lanes, 2),
            "offset_errors_s": (number, lanes, 2),
            "chances": (number,),
            "beyond": (),
        }
        for name, shape in shapes.items():
            if parts[name].shape != shape:
                raise CheckpointError(
                    f"the worlds in the checkpoint are of another network or library: {name} is "
                    f"{parts[name].shape}, expected {shape}"
                )
        own = {name: parts[name] for name in _NUMBERS}
        how = {field.name: parts[field.name] for field in fields(Calibration)}
        return cls(worlds, calibration=Calibration(**how), **own)


_NUMBERS = ("answer", "offsets_s", "offset_errors_s", "chances", "beyond")


def at_least_0(service_s: Floats) -> Floats:
    """Return the values nearest to the given ones that are not negative and have the same means.

    Values that are only set to 0 where they are negative would have a higher mean: a street whose
    lanes use all of their greens would be given red in each. The answer is the projection on a
    simplex (Held, Wolfe and Crowder 1974): ``max(value - shift, 0)`` with one shift per column. All
    of a column with a mean below 0 is 0.

    Args:
        service_s: ``(lanes, columns)``.
    """
    lanes = len(service_s)
    total = np.maximum(service_s.sum(0), 0.0)
    ordered = -np.sort(-service_s, axis=0)
    shifts = (np.cumsum(ordered, axis=0) - total) / np.arange(1, lanes + 1)[:, None]
    positive = (ordered > shifts).sum(0)
    shift = shifts[np.maximum(positive, 1) - 1, np.arange(service_s.shape[1])]
    return np.maximum(service_s - shift, 0.0) * (total > 0)


def _mean(rows: Floats) -> Floats:
    """Return column means without NaN; 0 for a column without numbers."""
    known = ~np.isnan(rows)
    total = np.where(known, rows, 0.0).sum(0)
    return total / np.maximum(known.sum(0), 1)
