"""Folders of runs of `transfer`, and stand-ins for what a test of training need not play.

`q_values` looks into a trained policy.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter

from ugat_marl.data import Metrics, Scores
from ugat_marl.effects import Domain, domain_label
from ugat_marl.envs import Observations
from ugat_marl.experiments import Evaluation, Job, TransferConfig
from ugat_marl.experiments.jobs import JOB, perform
from ugat_marl.experiments.scores import Result
from ugat_marl.grounding import FitConfig, UgatConfig
from ugat_marl.policies import DQNConfig, NetworkPolicy
from ugat_marl.progress import Silent
from ugat_marl.scenarios import Scenario

JOBS = "ugat_marl.experiments.jobs"

SMALL = TransferConfig(
    scenario="single-v1",
    real="V4",
    duration_s=100,
    evaluation_seeds=1,
    tuning_seeds=1,
    control=False,
    learner="dqn",
    ugat=UgatConfig(
        grounding="phase",
        pretrain_episodes=2,
        iterations=2,
        grounded_episodes=2,
        sim_rollouts=2,
        real_rollouts=2,
        least_accuracy=None,  # so little training proves nothing
        fit=FitConfig(epochs=2),
    ),
    dqn=DQNConfig(warmup_decisions=5, epsilon_decay_decisions=50),
)
"""A run that takes a second or two."""

FITTED = UgatConfig("street", pretrain_episodes=2, grounded_episodes=2)
"""Settings of a run in a fitted street, as short as `SMALL`; `street` is each test's own."""


def checkpoint_of(run: Path) -> Path:
    """The checkpoint of the run's grounded training."""
    (folder,) = run.glob("trainings/*/checkpoint")
    return folder


def weights(run: Path, name: str) -> np.ndarray[Any, Any]:
    """The weights of a policy of the run."""
    return NetworkPolicy.load(run / "policies" / f"{name}.pt").parameters


def numbers(run: Path) -> dict[tuple[int, str], float]:
    """What the run logged in its iterations, by iteration and name."""
    rows = Metrics.read(run / "metrics.parquet").rows
    return {(step, name): value for stage, step, name, value in rows if stage == "iteration"}


def search_few_rules(patch: pytest.MonkeyPatch, *rules: str) -> None:
    """Let only these rules compete for the best one."""
    patch.setattr(f"{JOBS}.STANDARD_RULES", rules)


def play_nothing(patch: pytest.MonkeyPatch) -> None:
    """Let every evaluation give the same scores at once, and the programme be the best rule."""

    def evaluation_of(
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

    def best_rule(*_: Any, **__: Any) -> str:
        return "programme"

    patch.setattr(f"{JOBS}.evaluation_of", evaluation_of)
    patch.setattr(f"{JOBS}.best_rule", best_rule)


def perform_in_this_process(patch: pytest.MonkeyPatch) -> None:
    """Let the driver perform its jobs here, one at a time: an interpreter for each takes longer."""
    one_at_a_time = threading.Lock()

    def perform_job(folder: str, *_: object) -> None:
        job = TypeAdapter(Job).validate_json(Path(folder, JOB).read_bytes())
        with one_at_a_time:
            perform(job, Path(folder), Silent())

    patch.setattr("ugat_marl.experiments.driver._perform_apart", perform_job)


def q_values(policy: NetworkPolicy, observations: Observations) -> dict[str, NDArray[np.float32]]:
    """The values of every agent's actions, ``(actions,)``; Q is in scaled reward."""
    agents = policy.agents
    values = policy._network(torch.from_numpy(agents.stack(observations)).unsqueeze(1))
    rows = zip(agents.names, agents.action_counts, values.squeeze(1), strict=True)
    return {name: row[:count].numpy() for name, count, row in rows}
