"""Training of a baseline's file: its learner on one scenario, and its evaluation.

This training is not a job of the driver. A job names its learner in the catalogue, so that another
process can make it from the job's description. A file of baselines/ makes its learner by a function
of its own, so that a copy of the file, changed, trains without a row in the catalogue. Both run the
same loop (`training.train_through`) and the same evaluation. ``ugat-marl train --learner`` and the
tables train the learners of the catalogue as jobs.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ugat_marl.effects import load_scenario
from ugat_marl.envs import AnyParallelEnv, parallel_env
from ugat_marl.errors import OutputError, require_least
from ugat_marl.experiments.evaluation import FixedPolicy, evaluation_of
from ugat_marl.experiments.jobs import evaluation_seeds
from ugat_marl.experiments.training import train_through
from ugat_marl.files import json_values, require_writable, write_whole
from ugat_marl.policies import EpisodeCallback, NetworkPolicy

KEPT = ("policy.pt", "learner.pt", "result.json")
"""Files of a training: its policy, its learner and its results."""


@dataclass(frozen=True)
class BaselineArgs:
    """Options that every baseline has.

    Attributes:
        scenario: Id or path of the scenario.
        domain: Domain in which to train and to judge.
        duration_s: Length of an episode in s; none: the scenario's own.
        episodes: Number of training episodes.
        seed: Root of every random choice.
        evaluate_every: Episodes from one evaluation to the next; 0: only at the end.
        evaluation_seeds: Number of episodes of an evaluation, always the same; 0: none.
        out: Folder for policy.pt, learner.pt and result.json.
    """

    scenario: str = "grid2x2-v1"
    domain: str = "sim"
    duration_s: float | None = None
    episodes: int = 100
    seed: int = 0
    evaluate_every: int = 0
    evaluation_seeds: int = 5
    out: Path | None = None

    def __post_init__(self) -> None:
        require_least(1, episodes=self.episodes)
        require_least(0, evaluate_every=self.evaluate_every, evaluation_seeds=self.evaluation_seeds)


class BaselineResult(NamedTuple):
    """Result of a training.

    Attributes:
        policy: The trained policy.
        returns: Return of each training episode.
        att_s: ATT of each evaluation seed in s, by number of training episodes.
    """

    policy: NetworkPolicy
    returns: list[float]
    att_s: dict[int, list[float]]


def train_baseline(
    args: BaselineArgs,
    make: Callable[[AnyParallelEnv], Any],
    on_episode: EpisodeCallback | None = None,
) -> BaselineResult:
    """Train and evaluate; write the results if `args.out` is given.

    Args:
        args: Options of the training.
        make: Makes the learner for an environment.
        on_episode: Called after every episode of training.
    """
    scenario, length = load_scenario(args.scenario, args.duration_s), args.duration_s
    require_least(0, seed=args.seed)
    if args.out is not None:
        require_writable(args.out / "policy.pt")
        if there := [name for name in KEPT if (args.out / name).exists()]:
            raise OutputError(
                f"{args.out}: holds {there[0]} of a training already; give another --out"
            )
    returns: list[float] = []
    att_s: dict[int, list[float]] = {}

    def note(episode: int, numbers: Mapping[str, float]) -> None:
        returns.append(numbers["return"])
        if on_episode is not None:
            on_episode(episode, numbers)

    seeds = evaluation_seeds(args.evaluation_seeds)
    every = args.evaluate_every or max(1, args.episodes)
    marks = (*range(every, args.episodes, every), args.episodes)
    with contextlib.closing(parallel_env(scenario, domain=args.domain, duration_s=length)) as env:
        learner = make(env)
        for mark, policy in train_through(learner, env, marks, args.seed, on_episode=note):
            if seeds:
                played = {"it": FixedPolicy(policy)}
                evaluation = evaluation_of(
                    scenario, played, [args.domain], seeds, duration_s=length
                )
                att_s[mark] = [result.scores.att_s for result in evaluation.results]
        result = BaselineResult(learner.policy(), returns, att_s)
    if args.out is not None:
        policy, state, results = (args.out / name for name in KEPT)
        result.policy.save(policy)
        learner.save(state)
        content = json_values({"args": asdict(args), "returns": returns, "att_s": att_s})
        write_whole(results, json.dumps(content, default=str, allow_nan=False) + "\n")
    return result
