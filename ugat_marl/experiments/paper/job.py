"""One training and its evaluation, in a folder of its own and, as a program, a process of its own.

``python -m ugat_marl.experiments.paper.job FOLDER`` does what ``FOLDER/job.json`` says. It ends
when its standard input does, so that no training outlives the command that wanted it.
"""

from __future__ import annotations

import functools
import hashlib
import json
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from rich.console import Console

from ugat_marl.data import Run, Scores, remove_temporaries, versions_of
from ugat_marl.effects import in_domain, load_scenario
from ugat_marl.envs import AnyParallelEnv, parallel_env
from ugat_marl.errors import UgatMarlError
from ugat_marl.experiments.evaluation import evaluate, fixed_policy, rule_factory
from ugat_marl.experiments.paper.settings import Kind
from ugat_marl.experiments.queues import QUEUES, QueueRecord
from ugat_marl.experiments.randomised import randomised_env
from ugat_marl.experiments.recipes import simulated_worlds, train_until
from ugat_marl.experiments.tuning import tuned_rules
from ugat_marl.files import write_whole
from ugat_marl.grounding import RandomDelays, State, Ugat, UgatConfig, neighbours_of
from ugat_marl.policies import DQN, DQNConfig, NetworkPolicy, Policy, device_of
from ugat_marl.progress import Bars, Reporter
from ugat_marl.simulation import end_with_input

JOB, SCORES, POLICY, LEARNER, RULE = (
    "job.json", "scores.json", "policy.pt", "learner.pt", "rule.txt",
)  # fmt: skip
MOST_DELAY_S = 5
"""Longest of the random delays of "delays"."""


@dataclass(frozen=True)
class Job:
    """A training, and where and when its policy is played.

    Attributes:
        kind: As in `Setting`.
        scenario: As a user names it.
        sim: The simulation.
        target: The real domain, if the policy depends on it.
        world: Domain to train in, for "further" and "scratch".
        seed: Of the training.
        episodes: Of training, those of `start` included; "grounded" goes by `ugat`.
        start: Folder, beside this job's, of the plain training it begins with; None if it has none.
        options: Of the environments.
        ugat: For "grounded".
        dqn: Settings of the learner.
        rule_budget: Most episodes in which each rule is tuned, for "rule".
        domains: Where the policy is played; not part of the job's identity.
        evaluation_seeds: When it is played; not part of the identity either.
        device: Where it is trained; nor is that, as results agree within tolerance.
    """

    kind: Kind
    scenario: str
    sim: str
    target: str | None
    world: str | None
    seed: int | None
    episodes: int
    start: str | None
    options: dict[str, str | int | float | None]
    ugat: UgatConfig | None
    dqn: DQNConfig
    rule_budget: int
    domains: tuple[str, ...] = ()
    evaluation_seeds: tuple[int, ...] = field(default=())
    device: str = "cpu"

    @property
    def identity(self) -> dict[str, Any]:
        """What decides the policy: a job with the same is the same job."""
        settings = asdict(self)
        for other in ("domains", "evaluation_seeds", "scenario", "device"):
            settings.pop(other)
        worlds = sorted({world for world in (self.sim, self.target, self.world) if world})
        hashes = {world: _hash(self.scenario, world) for world in worlds}
        versions = versions_of("eclipse-sumo", "torch")
        return {**settings, "worlds": hashes, "versions": versions}

    @property
    def digest(self) -> str:
        """Ten letters for `identity`."""
        text = json.dumps(self.identity, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:10]


@functools.cache
def _hash(scenario: str, domain: str) -> str:
    return in_domain(load_scenario(scenario), domain).hash


Played = dict[tuple[str, int], Scores]
"""Scores by domain and seed."""


def read_scores(folder: Path) -> Played:
    """What a job's policy has scored so far; nothing if it was not played or the file is broken."""
    try:
        rows = json.loads((folder / SCORES).read_text())
        return {(row.pop("domain"), int(row.pop("seed"))): Scores(**row) for row in rows}
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}


def perform(job: Job, folder: Path, reporter: Reporter) -> None:
    """Trains what is not trained yet, plays what was not played yet."""
    known = read_scores(folder)
    missing = {
        domain: [seed for seed in job.evaluation_seeds if (domain, seed) not in known]
        for domain in job.domains
    }
    if not any(missing.values()):
        return
    if job.kind == "rule":
        factory = rule_factory(_rule(job, folder))
    else:
        factory = fixed_policy(_policy(job, folder, reporter))
    scenario = load_scenario(job.scenario)
    for domain, seeds in missing.items():
        if not seeds:
            continue
        queues = QueueRecord()
        found = evaluate(
            scenario,
            {"policy": factory},
            [domain],
            seeds,
            duration_s=_duration(job),
            workers=1,
            reporter=reporter,
            title=f"evaluating in {domain}",
            watch=queues.watch,
        )
        known |= {(domain, result.seed): result.scores for result in found.results}
        rows = [{"domain": d, "seed": s, **asdict(scores)} for (d, s), scores in known.items()]
        queues.write(folder / QUEUES, keep=True)  # before what says that these were played
        write_whole(folder / SCORES, json.dumps(rows, indent=1) + "\n")


def _rule(job: Job, folder: Path) -> str:
    """The rule that is best in the target, each tuned there, on seeds of its own."""
    assert job.target is not None
    saved = folder / RULE
    if not saved.exists():
        found = tuned_rules(
            load_scenario(job.scenario),
            [job.target],
            job.rule_budget,
            duration_s=_duration(job),
            workers=1,
        )
        write_whole(saved, "\n".join(found.values()))
    return saved.read_text()


def _duration(job: Job) -> float | None:
    duration_s = job.options["duration_s"]
    return None if duration_s is None else float(duration_s)


def _policy(job: Job, folder: Path, reporter: Reporter) -> Policy:
    """The trained policy; an interrupted training goes on."""
    saved = folder / POLICY
    if saved.exists():
        return NetworkPolicy.load(saved)
    learner = _grounded(job, folder, reporter) if job.ugat else _plain(job, folder, reporter)
    policy = learner.policy()
    policy.save(saved)
    return policy


def _plain(job: Job, folder: Path, reporter: Reporter) -> DQN:
    assert job.seed is not None
    env = _world(job)
    try:
        learner = DQN.of(env, job.dqn, job.seed, device=device_of(job.device))
        progress = folder / LEARNER
        before = _start(job, folder)
        if progress.exists():
            learner.load(progress)
        elif before is not None:
            learner.load(before)
        title = f"training: {job.kind}"
        train_until(learner, env, job.episodes, job.seed, progress, reporter, title)
    finally:
        env.close()
    return learner


def _grounded(job: Job, folder: Path, reporter: Reporter) -> DQN:
    assert job.ugat is not None
    assert job.target is not None
    assert job.seed is not None
    scenario = load_scenario(job.scenario)
    options: dict[str, Any] = dict(job.options)
    env = parallel_env(scenario, job.sim, **options)
    run = Run(folder, job.identity, resume=True, reporter=reporter)
    sim, real = simulated_worlds(scenario, job.sim, job.target, job.ugat, options, workers=1)
    try:
        learner = DQN.of(env, job.dqn, job.seed, device=device_of(job.device))
        before = _start(job, folder)
        assert before is not None
        learner.load(before)
        transform = job.ugat.transform(env.layouts, job.seed, neighbours_of(env))
        state = State(learner, transform, learner.policy(), pretrained=job.ugat.pretrain_episodes)
        state.restore(run, NetworkPolicy.load)
        Ugat(env, sim, real, job.ugat, job.seed, run, device=job.device).train(state)
    finally:
        for made in (env, sim, real, run):
            made.close()
    return learner


def _start(job: Job, folder: Path) -> Path | None:
    return None if job.start is None else folder.parent / job.start / LEARNER


def _world(job: Job) -> AnyParallelEnv:
    """Where plain training takes place."""
    options: dict[str, Any] = dict(job.options)
    scenario = load_scenario(job.scenario)
    if job.kind == "randomised":
        return randomised_env(scenario, options, job.sim)
    env = parallel_env(scenario, job.world or job.target or job.sim, **options)
    return RandomDelays(env, MOST_DELAY_S) if job.kind == "delays" else env


def main(folder: Path) -> int:
    """Performs the job in a folder; returns the exit code."""
    end_with_input()
    remove_temporaries(folder)
    try:
        job = TypeAdapter(Job).validate_json((folder / JOB).read_bytes())
        perform(job, folder, Bars(Console(width=100)))
    except UgatMarlError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
