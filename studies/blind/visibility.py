"""Visibility of hidden effects to a test that knows them.

A diagnosis has to find the effect, its place and its strength. This test knows them. It measures by
how many standard deviations of noise they move the data of the fitted periods. No diagnosis can
name an effect that this test cannot see. The test reads labels, so it only takes cases that have
been diagnosed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from studies.blind.cases import (
    DIAGNOSIS,
    VISIBLE,
    WINDOW,
    Hidden,
    chosen,
    read_json,
    read_label,
    read_street,
)
from ugat_marl.diagnosis import (
    IN_THE_LOG,
    DiagnosisConfig,
    Reference,
    Study,
    Tally,
    change_between,
    correlation_groups,
    sum_of,
    whitened,
)
from ugat_marl.effects import Effect, effect_from_record, known_effects
from ugat_marl.files import write_whole
from ugat_marl.progress import Reporter, Silent

DAYS = 24
"""Number of days that are simulated with the effect, and again without it."""


def judge_visibility(
    directory: Path, *, only: Sequence[str] = (), seed: int = 0, reporter: Reporter | None = None
) -> dict[str, float | None]:
    """Test every diagnosed case with a single effect, and write the result.

    Args:
        directory: Directory of a blind test.
        only: Ids of cases; empty for all.
        seed: Seed of the diagnoses, whose simulated days are used again.
        reporter: Reporter of the progress.

    Returns:
        Case to standard deviations, or to None if the log of the signals shows the effect.

    Raises:
        BlindTestError: The directory holds no blind test, or a label is damaged.
        UnknownNameError: There is no such case.
    """
    path = directory / VISIBLE
    before = read_json(path) if path.exists() else {}
    # simulated days are those of the seed, so another seed begins anew
    found: dict[str, float | None] = before["cases"] if before.get("seed") == seed else {}
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
                data = directory / label.case / "measured"
                scenario, measured = read_street(label.scenario, data)
                config = DiagnosisConfig(budget_h=math.inf, seed=seed)
                found[label.case] = deviations_of(Study.of(scenario, measured, config), effects)
            told = {"seed": seed, "cases": found}
            write_whole(path, json.dumps(told, indent=1, allow_nan=False) + "\n")
            advance(note=label.case)
    return found


def effect_of(hidden: Hidden) -> Effect:
    """Make an effect of the library from the form of a diagnosis."""
    texts = known_effects()[hidden.name].texts
    values: dict[str, float | str] = dict(hidden.parameters)
    values |= dict(zip(texts, (hidden.place or "").split(">"), strict=True)) if texts else {}
    if hidden.window is not None:
        values |= dict(zip(WINDOW, hidden.window, strict=True))
    return effect_from_record({"name": hidden.name} | values)


def deviations_of(study: Study, effects: Sequence[Effect]) -> float:
    """Return by how many standard deviations effects move the data of the fitted periods.

    Days with and without the effects are simulated with the same vehicles.

    Args:
        study: Scenario, data and simulated days.
        effects: Hidden effects with their true values.
    """
    base = study.base(Silent()).model
    with_them = [day.tally for day in study.engine.replicates(effects, list(base.days)[:DAYS])]
    without = base.tallies[: len(with_them)]
    return separation(base.reference, study.fit, with_them, without)


def separation(
    reference: Reference, data: Sequence[Tally], after: Sequence[Tally], before: Sequence[Tally]
) -> float:
    """Return the distance of two models in standard deviations of noise.

    It is the Mahalanobis distance of their means, ``sqrt(d' C^-1 d)`` with the noise C, as seen by
    the best linear test, for the block of statistics that separates them best. The square is
    estimated by ``d_1' C^-1 d_2`` with the differences d_1 and d_2 of alternate days. This estimate
    has no bias, because the noise of the two halves is independent. The first third of the days
    chooses the block, and the others measure: the largest of several estimates is too large.

    Args:
        reference: Reference that gives the noise.
        data: Periods of measured data, which decide the statistics and their precision.
        after: Days of one model.
        before: The same days of the other model.

    Returns:
        Standard deviations; 0 where chance turns the estimate of the square negative.
    """
    third = len(after) // 3
    choosing = _squares(reference, data, after[:third], before[:third])
    squares = _squares(reference, data, after[third:], before[third:])
    return math.sqrt(max(0.0, squares[max(choosing, key=choosing.__getitem__)]))


def _squares(
    reference: Reference, data: Sequence[Tally], after: Sequence[Tally], before: Sequence[Tally]
) -> dict[str, float]:
    """Return the estimate of `separation` for every block, from all of the days."""
    halves = [change_between(reference.pools, after[i::2], before[i::2])[0] for i in (0, 1)]
    sums = reference.pools.pool(sum_of(data))
    squares: dict[str, float] = {}
    for name, block in reference.blocks.items():
        weight = sums[name][..., 1] / len(data)
        noise = np.sqrt(block.noise(weight, len(data)))
        groups = correlation_groups(block.used & (weight >= 1.0), block.correlation)
        one, two = (whitened(half[name] / noise, groups) for half in halves)
        squares[name] = float(one @ two)
    return squares
