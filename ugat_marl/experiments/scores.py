"""Scores of policies in domains, seed by seed, with gaps and regrets.

The gap of a policy is its score in a domain minus its score in the first domain, usually ``sim``,
seed by seed. A part of the gap is physics: slow vehicles are slow under any policy. The regret is
the ATT of the policy minus that of the best policy known in the domain: the part of a loss that
transfer can win back.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data import MEASURES, Scores, json_damage, mean_delay_s, with_hashes
from ugat_marl.errors import CheckpointError
from ugat_marl.experiments.statistics import Interval
from ugat_marl.files import MALFORMED, json_values, read_json, write_whole
from ugat_marl.policies import nan_last

_MAPPINGS = ("hidden", "approaches")
"""Fields of `Scores` that are no single number."""


def best_rule_note(domain: str) -> str:
    """Return the name of the note of an evaluation that holds the best rule of a domain."""
    return f"best rule in {domain}"


def rule_policy(rule: str) -> str:
    """Return the name of a rule among the policies of an evaluation."""
    return f"rule {rule}"


def seconds_text(time_s: float) -> str:
    """Return a travel time with three digits, or in whole seconds."""
    return f"{time_s:.0f}" if abs(time_s) >= 99.95 else f"{time_s:.3g}"


@dataclass(frozen=True)
class Result:
    """One episode of a policy in a domain.

    Attributes:
        policy: Name of the policy.
        domain: Name of the domain.
        seed: Seed of the episode.
        scores: Scores of the episode.
    """

    policy: str
    domain: str
    seed: int
    scores: Scores


@dataclass(frozen=True)
class Estimate(Interval):
    """A mean over seeds with its interval, and the median."""

    median: float

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> Estimate:
        """Return the estimate from one value per seed."""
        interval = Interval.of(values)
        return cls(interval.mean, interval.low, interval.high, float(np.median(values)))


@dataclass(frozen=True)
class Evaluation:
    """All episodes of an evaluation.

    Attributes:
        scenario: Id of the scenario.
        scenario_hash: Hash of the scenario.
        results: One per policy, domain and seed.
        notes: Further facts for the reader by name, such as the best rule of a domain.
    """

    scenario: str
    scenario_hash: str
    results: tuple[Result, ...]
    notes: Mapping[str, str]

    @property
    def policies(self) -> list[str]:
        """Names of the policies, in the order they were evaluated."""
        return list(dict.fromkeys(result.policy for result in self.results))

    @property
    def domains(self) -> list[str]:
        """Names of the domains, in the order they were evaluated."""
        return list(dict.fromkeys(result.domain for result in self.results))

    @property
    def seeds(self) -> list[int]:
        """Seeds of the episodes, in the order they were played."""
        return list(dict.fromkeys(result.seed for result in self.results))

    def best_rule(self, domain: str) -> str | None:
        """Return the best rule of a domain, such as ``"sotl:1:2"``; None if none is noted."""
        return self.notes.get(best_rule_note(domain))

    def best_rule_policy(self, domain: str) -> str | None:
        """Return the name of the policy that is the best rule; None if no rule is noted."""
        rule = self.best_rule(domain)
        return None if rule is None else rule_policy(rule)

    def values(self, policy: str, domain: str, measure: str) -> NDArray[np.float64]:
        """Return one value per seed, in the order of the seeds."""
        results = [r for r in self.results if r.policy == policy and r.domain == domain]
        results.sort(key=lambda result: result.seed)
        return np.array([_measured(result.scores, measure) for result in results])

    def estimate(self, policy: str, domain: str, measure: str) -> Estimate:
        """Return mean and interval of a measure."""
        return Estimate.of(self.values(policy, domain, measure))

    def gap(self, policy: str, domain: str, measure: str) -> Estimate:
        """Return the measure in `domain` minus that in the first domain, paired by seed."""
        real = self.values(policy, domain, measure)
        return Estimate.of(real - self.values(policy, self.domains[0], measure))

    def approaches(self, policy: str, domain: str) -> dict[str, tuple[float, float]]:
        """Return, for each approach, vehicles per episode and mean control delay in s.

        The delay is the mean over all vehicles of all episodes. Where nobody passed it is infinite
        if vehicles waited, and nan if none came. Empty if it was not measured.
        """
        played = [r.scores for r in self.results if r.policy == policy and r.domain == domain]
        pairs: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for scores in played:
            for road, pair in scores.approaches.items():
                pairs[road].append(pair)
        delays: dict[str, tuple[float, float]] = {}
        for road, own in pairs.items():
            passed = sum(count for count, _ in own)
            starved = not passed and any(lost_s > 0.0 for _, lost_s in own)
            delays[road] = (passed / len(played), math.inf if starved else mean_delay_s(own))
        return delays

    def regret(self, policy: str, domain: str) -> Estimate:
        """Return the ATT of a policy minus that of the best policy there, in s, paired by seed."""
        best = min(
            self.policies, key=lambda name: nan_last(self.estimate(name, domain, "att_s").mean)
        )
        mine = self.values(policy, domain, "att_s")
        return Estimate.of(mine - self.values(best, domain, "att_s"))

    def _hidden(self, domain: str) -> list[str]:
        """Return the names of the hidden measures, which only domains with an objective have."""
        played = (result.scores for result in self.results if result.domain == domain)
        return list(dict.fromkeys(name for scores in played for name in scores.hidden))

    def as_dict(self) -> dict[str, Any]:
        """Return the summary and every episode, as values for JSON."""
        summary: list[dict[str, Any]] = []
        for policy in self.policies:
            for domain in self.domains:
                row: dict[str, Any] = {"policy": policy, "domain": domain}
                row["backlog"] = asdict(self.estimate(policy, domain, "backlog"))
                for measure in MEASURES:
                    row[measure] = asdict(self.estimate(policy, domain, measure))
                    if domain != self.domains[0]:
                        row[f"{measure}_gap"] = asdict(self.gap(policy, domain, measure))
                for measure in self._hidden(domain):
                    row[measure] = asdict(self.estimate(policy, domain, measure))
                row["regret_s"] = asdict(self.regret(policy, domain))
                summary.append(row)
        return {
            "scenario": self.scenario,
            "scenario_hash": self.scenario_hash,
            "notes": dict(self.notes),
            "summary": summary,
            "episodes": [
                {"policy": r.policy, "domain": r.domain, "seed": r.seed, **asdict(r.scores)}
                for r in self.results
            ],
        }

    def frame(self) -> pl.DataFrame:
        """Return one row per policy and domain: means over the seeds, with intervals.

        Returns:
            Columns ``policy``, ``domain``, ``episodes``, ``att_s`` (average travel time in s),
            ``low_s`` and ``high_s`` (its interval, 95 %), ``gap_s`` (minus that in the first
            domain, s) and ``regret_s`` (minus that of the best policy in this domain, s). What is
            not known is null, such as the interval of a single episode.
        """
        rows: list[dict[str, Any]] = []
        for domain in self.domains:
            for policy in self.policies:
                att = self.estimate(policy, domain, "att_s")
                rows.append(
                    {
                        "policy": policy,
                        "domain": domain,
                        "episodes": len(self.values(policy, domain, "att_s")),
                        "att_s": att.mean,
                        "low_s": att.low,
                        "high_s": att.high,
                        "gap_s": self.gap(policy, domain, "att_s").mean,
                        "regret_s": self.regret(policy, domain).mean,
                    }
                )
        return pl.DataFrame(rows).fill_nan(None)

    def episodes_frame(self) -> pl.DataFrame:
        """Return one row per episode: policy, domain, seed, and a column for every measure."""
        rows = [
            {"policy": r.policy, "domain": r.domain, "seed": r.seed}
            | {name: value for name, value in asdict(r.scores).items() if name not in _MAPPINGS}
            | dict(r.scores.hidden)
            for r in self.results
        ]
        return pl.DataFrame(rows, infer_schema_length=None)

    def write(self, path: Path) -> None:
        """Write `as_dict` as JSON atomically; nan becomes null."""
        hashed = with_hashes(json_values(self.as_dict()), "episodes")
        content = json.dumps(hashed, indent=1, allow_nan=False)
        write_whole(path, content + "\n")

    @classmethod
    def read(cls, path: Path) -> Evaluation:
        """Read an evaluation that `write` wrote; null and missing values become nan.

        Raises:
            CheckpointError: The file is missing, cut short or of another form.
        """
        try:
            content = read_json(path, CheckpointError)
            damaged = json_damage(content, "episodes")
            results = _whole(tuple(result_of(row) for row in content["episodes"]))
            notes = {str(key): str(text) for key, text in content["notes"].items()}
            scenario, its_hash = str(content["scenario"]), str(content["scenario_hash"])
            evaluation = cls(scenario, its_hash, results, notes)
        except MALFORMED as error:
            raise CheckpointError(
                f"{path}: not the table of a run ({error!r}); it may have been cut short"
            ) from None
        if damaged:
            raise CheckpointError(f"{path}: damaged, {damaged}")
        return evaluation


@dataclass(frozen=True)
class RuleTrial:
    """Result of one rule with its parameters in a race.

    Attributes:
        spec: Spelling of the rule.
        att_s: Mean ATT over its episodes, in s.
        episodes: Number of its episodes; rules that dropped out early have fewer.
    """

    spec: str
    att_s: float
    episodes: int


@dataclass(frozen=True)
class Tuned:
    """Result of the tuning of a rule.

    Attributes:
        rule: Name of the rule.
        domain: Name of the domain.
        trials: All parameters tried, the best first.
    """

    rule: str
    domain: str
    trials: tuple[RuleTrial, ...]

    @property
    def best(self) -> RuleTrial:
        """The trial with the best parameters."""
        return self.trials[0]

    @property
    def episodes(self) -> int:
        """Number of episodes of all trials."""
        return sum(trial.episodes for trial in self.trials)


def result_of(row: Mapping[str, Any]) -> Result:
    """Return an episode from its row in a record; null and missing values become nan."""
    numbers = {
        measure.name: _number(row.get(measure.name))
        for measure in fields(Scores)
        if measure.name not in _MAPPINGS
    }
    approaches = {
        str(road): (_number(pair[0]), _number(pair[1]))
        for road, pair in (row.get("approaches") or {}).items()
    }
    hidden = {str(name): _number(value) for name, value in (row.get("hidden") or {}).items()}
    scores = Scores(**numbers, hidden=hidden, approaches=approaches)
    return Result(str(row["policy"]), str(row["domain"]), int(row["seed"]), scores)


def _whole(results: tuple[Result, ...]) -> tuple[Result, ...]:
    """Raise an error unless every policy plays every seed in every domain, once."""
    played = {(result.policy, result.domain, result.seed) for result in results}
    policies, domains, seeds = (len(set(part)) for part in zip(*played, strict=True))
    if len(played) < policies * domains * seeds:
        raise ValueError("some episodes are missing")
    if len(played) < len(results):
        raise ValueError("an episode is there twice")
    return results


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _measured(scores: Scores, measure: str) -> float:
    """Return a measure, which may be hidden; nan if it was not measured."""
    if hasattr(scores, measure):
        return getattr(scores, measure)
    return scores.hidden.get(measure, math.nan)
