"""Detection limits: the strength from which on the data would have shown an effect.

A verdict that names nothing is worth what the data could have contradicted. So days with single
effects are simulated, sets of them are tested as the measured periods were, and the share of sets
that would have contradicted the model is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ugat_marl.diagnosis.engine import OutOfTime
from ugat_marl.diagnosis.hypotheses import Hypothesis, effects_of, keys_of, merged
from ugat_marl.diagnosis.records import DetectionLimit, Tested
from ugat_marl.diagnosis.residual import drawn_days
from ugat_marl.diagnosis.select import Selector
from ugat_marl.diagnosis.study import Study
from ugat_marl.effects import known_effects
from ugat_marl.errors import OptionError, ScenarioError, SimulatorError
from ugat_marl.progress import Reporter
from ugat_marl.seeding import numpy_generator

_Side = tuple[Hypothesis, float]
"""A hypothesis, and its farthest value on one side of the usual one."""


def detection_limits(
    study: Study, selector: Selector, tested: Tested, reporter: Reporter
) -> tuple[DetectionLimit, ...]:
    """Return the detection limit of each effect on the whole network, on each of its sides.

    Effects of the model have none, and neither do those without a number, with a place of their
    own, or with a usual value that differs between vehicle types. The distance from the usual value
    to the farthest one that a diagnosis examines is halved `Thresholds.limit_halvings` times.

    Args:
        study: The data and the simulated days.
        selector: The search that tested the model.
        tested: A model that leaves no more than chance.
        reporter: Display of progress, which is told if the budget ends before all are found.
    """
    thresholds, periods = study.config.thresholds, len(study.fit)
    null = selector.null_of(tested)
    count = thresholds.days_of_a_limit(periods)
    numbers = range(study.effort.base, study.effort.base + count)  # other vehicles than the model's
    generator = numpy_generator(study.config.seed, "detection limits")
    sets = [drawn_days(generator, count, periods, thresholds) for _ in range(thresholds.limit_sets)]

    def shows(hypothesis: Hypothesis, value: float) -> bool:
        """Return True if enough sets of days with the effect contradict the model."""
        effects = effects_of(merged(tested.model.members, ((hypothesis, (value,)),)))
        days = [day.tally for day in study.engine.replicates(effects, numbers)]
        shown = [
            null.test([days[int(k)] for k in chosen], tested.extra or None).p <= study.config.alpha
            for chosen in sets
        ]
        return float(np.mean(shown)) >= thresholds.limit_power

    limits: list[DetectionLimit] = []
    sides = _sides(study.hypotheses, tested)
    with reporter.task("what the data would show", len(sides)) as advance:
        for hypothesis, farthest in sides:
            try:
                found = _bracket(hypothesis, farthest, shows, thresholds.limit_halvings)
                limits.append(_record(hypothesis, *found))
            except (SimulatorError, OptionError, ScenarioError) as error:
                reporter.say(f"note: {hypothesis.name} has no detection limit: {error}")
            except OutOfTime:
                reporter.say("note: the budget ended before all detection limits were found")
                break
            advance(note=hypothesis.name)
    return tuple(limits)


def _sides(hypotheses: Sequence[Hypothesis], tested: Tested) -> list[_Side]:
    """Return the effects that the model lacks, with their farthest plausible value on each side."""
    present = keys_of(tested.model.members)
    sides: list[_Side] = []
    for hypothesis in hypotheses:
        if hypothesis.key in present or hypothesis.nothing is None:
            continue
        (usual,) = hypothesis.nothing
        values = [value for (value,) in hypothesis.levels if (value,) not in hypothesis.extreme]
        if hypothesis.both:  # examined on one side, and as large on the other
            values += [hypothesis.clipped((2.0 * usual - value,))[0] for value in values]
        below = [value for value in values if value < usual]
        above = [value for value in values if value > usual]
        sides += [(hypothesis, pick(side)) for pick, side in ((min, below), (max, above)) if side]
    return sides


def _bracket(
    hypothesis: Hypothesis, farthest: float, shows: Callable[[Hypothesis, float], bool], times: int
) -> tuple[float, float | None]:
    """Return the strongest value found that would not show, and the weakest one that would.

    Args:
        hypothesis: The effect.
        farthest: Its farthest value.
        shows: Function that says whether a value would show.
        times: Number of halvings.
    """
    if not shows(hypothesis, farthest):
        return farthest, None
    assert hypothesis.nothing is not None
    (hidden,), shown = hypothesis.nothing, farthest
    for _ in range(times):
        (middle,) = hypothesis.clipped((0.5 * (hidden + shown),))
        if middle in (hidden, shown):  # neighbours on the effect's grid
            break
        if shows(hypothesis, middle):
            shown = middle
        else:
            hidden = middle
    return hidden, shown


def _record(hypothesis: Hypothesis, hidden: float, shown: float | None) -> DetectionLimit:
    assert hypothesis.nothing is not None
    (parameter,), (usual,) = hypothesis.free, hypothesis.nothing
    unit = known_effects()[hypothesis.name].ranges[parameter].unit
    return DetectionLimit(hypothesis.name, parameter, unit, usual, hidden, shown)
