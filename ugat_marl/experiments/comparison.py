"""Settings x training seeds x domains, compared with intervals over training seeds.

One training is one sample: the mean over its evaluation episodes. Intervals are Student's over
training seeds. Two settings are compared seed by seed: the same seed means the same initial
weights, the same episodes of plain training and the same traffic in the evaluation.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ugat_marl.data import MEASURES, Scores
from ugat_marl.experiments.statistics import Floats, Interval, PairedTest
from ugat_marl.policies import nan_last

LEAST_SHARE_ARRIVED = 0.9
"""An episode broke down if a smaller share of the vehicles due arrives."""


@dataclass(frozen=True)
class Trial:
    """One episode of one trained policy.

    Attributes:
        setting: Name of the setting.
        target: The real domain of the policy. Episodes of a policy that depends on no real domain
            are listed once per target.
        domain: Domain of the episode: the simulation or the target.
        training_seed: Seed of the training; None for a rule, which is not trained.
        seed: Seed of the episode.
        scores: Scores of the episode.
    """

    setting: str
    target: str
    domain: str
    training_seed: int | None
    seed: int
    scores: Scores


@dataclass(frozen=True)
class Comparison:
    """All trials of a table.

    Attributes:
        scenario: Id of the scenario.
        scenario_hash: Hash of the scenario.
        sim: Name of the simulation, as in the trials.
        trials: One per setting, target, domain, training seed and episode.
        notes: Further facts for the reader, by name.
        constants: Settings that sweep a constant delay.
        grounded: Settings trained by UGAT.
    """

    scenario: str
    scenario_hash: str
    sim: str
    trials: tuple[Trial, ...]
    notes: Mapping[str, str]
    constants: tuple[str, ...] = ()
    grounded: tuple[str, ...] = ()

    @property
    def settings(self) -> list[str]:
        """Names of the settings, in their order."""
        return list(dict.fromkeys(trial.setting for trial in self.trials))

    @property
    def targets(self) -> list[str]:
        """The real domains, in their order."""
        return list(dict.fromkeys(trial.target for trial in self.trials))

    @property
    def training_seeds(self) -> list[int]:
        """Seeds of the trainings, ascending."""
        return sorted({t.training_seed for t in self.trials if t.training_seed is not None})

    def seeds_of(self, setting: str, target: str) -> list[int]:
        """Return the seeds of a setting's trainings, ascending; all seeds for a rule."""
        return [seed for seed in self._by_seed(setting, target, "att_s") if seed is not None]

    def has(self, setting: str, target: str) -> bool:
        """Return True if there are trials of the setting for that domain."""
        return any(played[:2] == (setting, target) for played in self._scores)

    @functools.cached_property
    def _scores(self) -> Mapping[tuple[str, str, str], Mapping[int | None, Sequence[Scores]]]:
        """Scores of the episodes by setting, target and domain, then by training seed."""
        by_column: dict[tuple[str, str, str], dict[int | None, list[Scores]]] = {}
        for t in self.trials:
            seeds = by_column.setdefault((t.setting, t.target, t.domain), {})
            seeds.setdefault(t.training_seed, []).append(t.scores)
        return by_column

    def values(self, setting: str, target: str, measure: str, domain: str | None = None) -> Floats:
        """Return means over the episodes, one per training seed, ``(n,)``.

        A rule has the same value for every training seed.

        Args:
            setting: Name of the setting.
            target: The real domain of the policy.
            measure: A field of `Scores`.
            domain: Domain of the episodes; default: the target.
        """
        return np.array(list(self._by_seed(setting, target, measure, domain).values()))

    def _by_seed(
        self, setting: str, target: str, measure: str, domain: str | None = None
    ) -> Mapping[int | None, float]:
        """Return means over the episodes by training seed, ascending, as `values` does."""
        played = self._scores.get((setting, target, target if domain is None else domain), {})
        means = {
            seed: float(np.mean([getattr(scores, measure) for scores in played[seed]]))
            for seed in sorted(played, key=lambda s: s or 0)
        }
        if None not in means:
            return means
        return dict.fromkeys(self.training_seeds or [None], means[None])

    def _paired(self, one: str, other: str, target: str) -> tuple[Floats, Floats]:
        """Return the ATT of two settings for the training seeds that both have, in s, ``(n,)``."""
        first, second = (self._by_seed(name, target, "att_s") for name in (one, other))
        both = [seed for seed in first if seed in second]
        return np.array([first[s] for s in both]), np.array([second[s] for s in both])

    def episodes(self, setting: str, target: str) -> list[Scores]:
        """Return every episode in the target, of all training seeds."""
        wanted = setting, target, target
        return [t.scores for t in self.trials if (t.setting, t.target, t.domain) == wanted]

    def median_s(self, setting: str, target: str) -> float:
        """Return the median ATT of the episodes in the target, in s."""
        return float(np.median([scores.att_s for scores in self.episodes(setting, target)]))

    def unserved(self, setting: str, target: str) -> float:
        """Return the share of episodes in the target that broke down."""
        played = self.episodes(setting, target)
        failed = sum(scores.throughput < LEAST_SHARE_ARRIVED * scores.due for scores in played)
        return failed / len(played)

    def estimate(
        self, setting: str, target: str, measure: str, domain: str | None = None
    ) -> Interval:
        """Return mean and interval over training seeds."""
        return Interval.of(self.values(setting, target, measure, domain))

    def gaps(self, setting: str, target: str, measure: str) -> Floats:
        """Return the measure in the target minus that in the simulation, one per training seed."""
        there = self.values(setting, target, measure)
        return there - self.values(setting, target, measure, self.sim)

    def test(self, one: str, other: str, target: str) -> PairedTest:
        """Compare the ATT of two settings in a domain, by the training seeds that both have."""
        return PairedTest.of(*self._paired(one, other, target))

    def best(self, target: str, among: Sequence[str] | None = None) -> str:
        """Return the setting with the lowest mean ATT in a domain.

        The means are over the training seeds that all settings have, if there are such seeds: one
        seed may be better than another for every setting.
        """
        names = [name for name in among or self.settings if self.has(name, target)]
        values = {name: self._by_seed(name, target, "att_s") for name in names}
        shared = functools.reduce(operator.and_, (each.keys() for each in values.values()))

        def mean(name: str) -> float:
            own = values[name]
            return nan_last(np.mean([own[seed] for seed in shared or own.keys()]))

        return min(names, key=mean)

    def regret_s(self, setting: str, target: str) -> Floats:
        """Return the ATT minus that of the best setting there, in s, one per common seed."""
        mine, best = self._paired(setting, self.best(target), target)
        return mine - best

    def won_back(self, setting: str, target: str, direct: str) -> float:
        """Return the share of the regret of `direct` that a setting removes.

        1 - regret(setting) / regret(direct), both means over training seeds. The best setting has
        1. The share is nan where direct transfer has no regret.
        """
        start = Interval.of(self.regret_s(direct, target)).mean
        mine = Interval.of(self.regret_s(setting, target)).mean
        return 1.0 - mine / start if start > 0 else math.nan

    def reduction(self, setting: str, target: str, direct: str) -> float:
        """Return the share by which a setting reduces the gap of ATT of `direct` (paper, Table 2).

        1 - gap(setting) / gap(direct), both means over training seeds. The share is nan where
        direct transfer has no gap.
        """
        start = float(self.gaps(direct, target, "att_s").mean())
        mine = float(self.gaps(setting, target, "att_s").mean())
        return 1.0 - mine / start if start > 0 else math.nan

    def rows(self) -> list[dict[str, Any]]:
        """Return one flat row per setting and target: all measures, their gaps, the regret."""
        rows: list[dict[str, Any]] = []
        for setting in self.settings:
            for target in self.targets:
                if not self.has(setting, target):
                    continue
                row: dict[str, Any] = {
                    "scenario": self.scenario,
                    "setting": setting,
                    "domain": target,
                    "training_seeds": self.values(setting, target, "att_s").size,
                }
                columns: dict[str, Floats] = {}
                for measure in MEASURES:
                    columns[measure] = self.values(setting, target, measure)
                    columns[f"{measure}_sim"] = self.values(setting, target, measure, self.sim)
                    columns[f"{measure}_gap"] = self.gaps(setting, target, measure)
                columns["backlog"] = self.values(setting, target, "backlog")
                columns["regret_s"] = self.regret_s(setting, target)
                for name, values in columns.items():
                    interval = Interval.of(values)
                    row |= {
                        name: interval.mean,
                        f"{name}_low": interval.low,
                        f"{name}_high": interval.high,
                    }
                rows.append(row)
        return rows
