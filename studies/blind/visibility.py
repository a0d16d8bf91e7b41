"""Visibility of hidden effects, by a test that is told the effect.

A diagnosis has to find the effect, its place and its strength. This test knows them, and asks only
by how many standard deviations of noise they move what the fitted periods show: what it cannot see
no diagnosis can name. It opens labels, and so it only judges cases that have been diagnosed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from studies.blind.cases import DIAGNOSIS, VISIBLE, WINDOW, Hidden, chosen, read_json, read_label
from ugat_marl.data import read_measured
from ugat_marl.diagnosis import (
    IN_THE_LOG,
    DiagnosisConfig,
    Reference,
    Study,
    Tally,
    added,
    groups_of,
    independent,
    shift,
)
from ugat_marl.effects import Effect, effect_from, known_effects, load_scenario
from ugat_marl.files import write_whole
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Network

DAYS = 24
"""Simulated with the effect; the same ones without it."""


def judge_visibility(
    directory: Path, *, only: Sequence[str] = (), seed: int = 0, reporter: Reporter | None = None
) -> dict[str, float | None]:
    """Judge every diagnosed case with a single effect, and writes what it finds.

    Args:
        directory: A blind test.
        only: Cases; none for all.
        seed: Seed of the diagnoses, whose simulated days are used again.
        reporter: Shows progress.

    Returns:
        By case: standard deviations, or None where the log of the signals shows the effect.

    Raises:
        BlindTestError: Not a blind test, or a damaged label.
        UnknownNameError: No such case.
    """
    path = directory / VISIBLE
    found: dict[str, float | None] = read_json(path) if path.exists() else {}
    labels = [
        read_label(directory, case.case)
        for case in chosen(directory, only)
        if (directory / case.case / DIAGNOSIS).exists()
    ]
    left = [item for item in labels if item.group == "single" and item.case not in found]
    with (reporter or Silent()).task("looking along the hidden effect", len(left)) as advance:
        for label in left:
            effects = [effect_of(item) for item in label.effects]
            if any(effect.name in IN_THE_LOG for effect in effects):
                found[label.case] = None
            else:
                scenario = load_scenario(label.scenario)
                data = directory / label.case / "measured"
                measured = read_measured(data, scenario, Network.read(scenario))
                config = DiagnosisConfig(budget_s=math.inf, seed=seed)
                found[label.case] = deviations_of(Study.of(scenario, measured, config), effects)
            write_whole(path, json.dumps(found, indent=1, allow_nan=False) + "\n")
            advance(note=label.case)
    return found


def effect_of(hidden: Hidden) -> Effect:
    """Make the effect from the form in which it is named."""
    texts = known_effects()[hidden.name].texts
    values: dict[str, float | str] = dict(hidden.parameters)
    values |= dict(zip(texts, (hidden.place or "").split(">"), strict=True)) if texts else {}
    if hidden.window is not None:
        values |= dict(zip(WINDOW, hidden.window, strict=True))
    return effect_from({"name": hidden.name} | values)


def deviations_of(study: Study, effects: Sequence[Effect]) -> float:
    """By how many standard deviations effects move what the fitted periods show.

    Days with and without them are simulated with the same vehicles.

    Args:
        study: Scenario, data and simulated days.
        effects: The hidden ones, strength and all.
    """
    base = study.base(Silent()).model
    with_them = [day.tally for day in study.engine.replicates(effects, study.engine.first(DAYS))]
    without = base.tallies[: len(with_them)]
    return separation(base.reference, study.fit, with_them, without)


def separation(
    reference: Reference, data: Sequence[Tally], after: Sequence[Tally], before: Sequence[Tally]
) -> float:
    """The distance of two models in noise, as the best linear test between them sees it.

    It is the Mahalanobis distance of their means, for the block of statistics that shows them best.
    Its square is estimated by the product of the difference in every other day with that in the
    days between, which has no bias: what is chance in one is not in the other.

    Args:
        reference: Whose noise.
        data: Periods, which decide what is seen and how precisely.
        after: Days of one model.
        before: The same days of the other.

    Returns:
        Standard deviations; 0 where chance turns the estimate of the square negative.
    """
    halves = [shift(reference.pools, after[i::2], before[i::2])[0] for i in (0, 1)]
    sums = reference.pools.pool(added(data))
    squares: list[float] = []
    for name, block in reference.blocks.items():
        weight = sums[name][..., 1] / len(data)
        noise = np.sqrt(block.noise(weight, len(data)))
        groups = groups_of(block.used & (weight >= 1.0), block.correlation)
        one, two = (independent(half[name] / noise, groups) for half in halves)
        squares.append(float(one @ two))
    return math.sqrt(max(0.0, *squares))
