"""Learning curves: learners trained and judged in one domain, beside rules tuned there.

Each learner is a setting. Each of its trainings is a job that is judged every few episodes. Each
rule is a job, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from ugat_marl.errors import UgatMarlError, require_distinct, require_least
from ugat_marl.experiments.driver import perform_all, record_of
from ugat_marl.experiments.jobs import RULE_FILE, Job, JobRecord, evaluation_seeds
from ugat_marl.experiments.row_names import RULE
from ugat_marl.experiments.settings import LearnerSpec, Setting
from ugat_marl.experiments.tuning import LEAST_BUDGET
from ugat_marl.parallel import Workers
from ugat_marl.policies import BASELINES, SUITE_LEARNERS, learner_library
from ugat_marl.progress import Reporter
from ugat_marl.scenarios import Scenario

PROGRAMME, FIXED_TIME = "programme", "fixed time, tuned"


@dataclass(frozen=True)
class Curve:
    """Greedy evaluations in the course of one training.

    Attributes:
        learner: Name of the setting.
        library: Library that implements the learner, with its version; "" for none.
        seed: Seed of the training.
        att_s: Mean travel time over the evaluation seeds in s, by number of training episodes.
        speed: Decisions per second in training, learning included; a decision is one of all agents
            together.
        own_ms: Processor time per decision outside the simulation, in ms.
    """

    learner: str
    library: str
    seed: int
    att_s: Mapping[int, float]
    speed: float = 0.0
    own_ms: float = 0.0

    @classmethod
    def of(cls, job: Job, record: JobRecord, scenario: Scenario) -> Curve:
        """Return the curve of a finished job that is judged in a single domain.

        Args:
            job: A training.
            record: Record of the job.
            scenario: Scenario of the job; it gives the number of decisions per episode.
        """
        (domain,) = job.domains
        assert job.seed is not None
        decisions = record.episodes * scenario.with_duration(job.duration_s).decisions
        return cls(
            job.setting.name,
            learner_library(job.setting.learner.name),
            job.seed,
            {m: fmean(s.att_s for s in record.played(job, m, domain)) for m in job.marks},
            decisions / record.seconds if record.seconds else 0.0,
            1000 * record.own_seconds / decisions if decisions else 0.0,
        )

    @property
    def final_s(self) -> float:
        """Travel time in the last evaluation, in s."""
        return list(self.att_s.values())[-1]

    @property
    def best_s(self) -> float:
        """Smallest travel time of all evaluations, in s."""
        return min(self.att_s.values())

    def mean_of_last_s(self, count: int) -> float:
        """Return the mean travel time of the last `count` evaluations, in s."""
        return fmean(list(self.att_s.values())[-count:])


@dataclass(frozen=True)
class LearningCurves:
    """Learning curves of all learners on a scenario, and the rules beside them.

    Attributes:
        scenario: Id of the scenario.
        domain: Domain in which the learners are trained and judged.
        curves: Trainings that have all their evaluations.
        rules: Mean travel time in s by spelling of the rule; the network's programme first, then
            fixed time.
        best: Spelling of the best rule, chosen on separate tuning episodes.
        failures: Reason of failure, by name of the job that failed or of the learner whose library
            is missing.
    """

    scenario: str
    domain: str
    curves: tuple[Curve, ...]
    rules: Mapping[str, float]
    best: str
    failures: Mapping[str, str]


@dataclass(frozen=True)
class CurvesConfig:
    """Options of learning curves.

    Attributes:
        learners: Names of learners; default: all.
        seeds: Number of trainings of each learner, with the seeds 0, 1, ...
        episodes: Episodes of each training.
        evaluate_every: Episodes from one evaluation to the next.
        evaluation_seeds: Number of episodes of each evaluation; all learners and rules play the
            same ones.
        rule_budget: Most episodes to tune one rule.
        domain: Domain in which learners are trained and judged.
        duration_s: Length of an episode in s; default: the scenario's own.
    """

    learners: tuple[str, ...] = (*SUITE_LEARNERS, *BASELINES)
    seeds: int = 3
    episodes: int = 30
    evaluate_every: int = 10
    evaluation_seeds: int = 5
    rule_budget: int = 24
    domain: str = "sim"
    duration_s: float | None = None

    def __post_init__(self) -> None:
        require_least(1, seeds=self.seeds, episodes=self.episodes)
        require_least(1, evaluate_every=self.evaluate_every, evaluation_seeds=self.evaluation_seeds)
        require_least(LEAST_BUDGET, rule_budget=self.rule_budget)
        require_distinct(learners=self.learners)
        _ = self.settings  # raises an error for an unknown learner

    @property
    def settings(self) -> list[Setting]:
        """One setting per learner, with the learner's name."""
        return [Setting(n, "direct", learner=LearnerSpec(n)) for n in self.learners]

    def job(self, scenario: str, setting: Setting, seed: int | None) -> Job:
        """Return the job of a learner, or of a rule.

        Args:
            scenario: Scenario as a user names it.
            setting: One of `settings`, or the setting of a rule.
            seed: Seed of the training; None for a rule.
        """
        is_rule = setting.recipe == "rule"
        tuned = is_rule and setting.name != PROGRAMME
        return Job(
            setting,
            scenario,
            sim=self.domain,
            seed=seed,
            episodes=0 if is_rule else self.episodes,
            every=0 if is_rule else self.evaluate_every,
            options=setting.learner.env_options(None, duration_s=self.duration_s),
            rule_budget=self.rule_budget if tuned else None,
            domains=(self.domain,),
            evaluation_seeds=evaluation_seeds(self.evaluation_seeds),
        )

    def trainings(self, scenario: str) -> list[Job]:
        """Return the jobs of all trainings on a scenario, ordered by seed, then by learner."""
        pairs = [(seed, setting) for seed in range(self.seeds) for setting in self.settings]
        return [self.job(scenario, setting, seed) for seed, setting in pairs]

    def rules(self, scenario: str) -> list[Job]:
        """Return the jobs of the network's own programme, of fixed time and of the best rule."""
        settings = (
            Setting(PROGRAMME, "rule", rules=("programme",)),
            Setting(FIXED_TIME, "rule", rules=("fixed-time",)),
            Setting(RULE, "rule"),
        )
        return [self.job(scenario, setting, None) for setting in settings]


def learn_curves(
    scenario: Scenario,
    spelling: str,
    config: CurvesConfig,
    folder: Path,
    workers: Workers,
    reporter: Reporter,
) -> LearningCurves:
    """Perform the unfinished jobs and return all curves.

    A missing library or a failed job does not stop the other jobs.

    Args:
        scenario: The network and its traffic.
        spelling: The scenario as a user names it.
        config: Options.
        folder: Folder that holds the jobs' folders; finished jobs are reused.
        workers: Jobs at a time, or an executor.
        reporter: Shows progress.
    """
    failures: dict[str, str] = {}
    trainings = [job for job in config.trainings(spelling) if _can_be_made(job, failures)]
    rules = config.rules(spelling)
    plan = [*trainings, *rules]
    failures |= perform_all(
        plan, folder, workers=workers, reporter=reporter, title="training", keep_going=True
    )
    records = {job.name: record_of(job, folder) for job in plan}
    curves = [
        Curve.of(job, r, scenario) for job in trainings if (r := records[job.name]) is not None
    ]
    att_s: dict[str, float] = {}
    best = ""
    for job in rules:
        if (record := records[job.name]) is not None:
            rule = (folder / job.name / RULE_FILE).read_text()
            att_s[rule] = fmean(s.att_s for s in record.played(job, 0, config.domain))
            best = rule if job.setting.name == RULE else best
    return LearningCurves(scenario.id, config.domain, tuple(curves), att_s, best, failures)


def _can_be_made(job: Job, failures: dict[str, str]) -> bool:
    """Return False, and add the reason to `failures`, if the learner cannot be made."""
    try:
        job.setting.learner.factory()
    except UgatMarlError as error:
        failures[job.setting.name] = " ".join(str(error).split())
        return False
    return True
