"""Folders of runs of `transfer`, and stand-ins for what a test of training need not play."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.data import Scores
from ugat_marl.effects import Domain, domain_label
from ugat_marl.experiments import Evaluation
from ugat_marl.experiments.scores import Result
from ugat_marl.scenarios import Scenario

JOBS = "ugat_marl.experiments.jobs"


def checkpoint_of(run: Path) -> Path:
    """The checkpoint of the run's grounded training."""
    (folder,) = run.glob("trainings/*/checkpoint")
    return folder


def search_few_rules(patch: pytest.MonkeyPatch, *rules: str) -> None:
    """Let only these rules compete for the best one."""
    patch.setattr(f"{JOBS}.STANDARD_RULES", rules)


def play_nothing(patch: pytest.MonkeyPatch) -> None:
    """Let every evaluation give the same scores at once, and the programme be the best rule."""

    def evaluate(
        scenario: Scenario,
        policies: Mapping[str, Any],
        domains: Sequence[Domain],
        seeds: Sequence[int],
        **_: Any,
    ) -> Evaluation:
        scores = Scores(1, 1, 1, 1, 1, 1, 1, 1, 1, 1)
        results = [
            Result(policy, domain_label(domain), seed, scores)
            for policy in policies
            for domain in domains
            for seed in seeds
        ]
        return Evaluation(scenario.id, scenario.hash, tuple(results), {})

    def best_rules(_: Scenario, domains: Sequence[Domain], **__: Any) -> dict[str, str]:
        return {domain_label(domain): "programme" for domain in domains}

    patch.setattr(f"{JOBS}.evaluate", evaluate)
    patch.setattr(f"{JOBS}.best_rules", best_rules)
