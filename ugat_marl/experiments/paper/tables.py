"""A table of the paper: what is trained for it, and what it says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ugat_marl.effects import describe, load_scenario
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments.comparison import Comparison, Trial
from ugat_marl.experiments.paper.job import Job
from ugat_marl.experiments.paper.runner import Planned, done, perform_all
from ugat_marl.experiments.paper.settings import Kind, Setting, settings_of
from ugat_marl.experiments.recipes import check_worlds
from ugat_marl.experiments.transfers import DIRECT, EVALUATION_SEED
from ugat_marl.experiments.tuning import BUDGET, LEAST_BUDGET
from ugat_marl.grounding import (
    MATCHED_REWARD,
    FitConfig,
    GateConfig,
    InputsConfig,
    TimedConfig,
    UgatConfig,
)
from ugat_marl.parallel import Workers
from ugat_marl.policies import DQNConfig, require_device_name
from ugat_marl.progress import Reporter


@dataclass(frozen=True)
class PaperConfig:
    """What is trained, how often, and how it is judged.

    Attributes:
        scenario: Scenarios, one table each.
        domains: The real domains; default: V1 to V4, for "ablation" and "alpha" only V1, as in
            the paper.
        sim: The simulation to train in.
        seeds: Number of trainings of every setting, with the seeds 0, 1, ...
        first_seed: First of these seeds.
        episodes: Plain training before the first iteration.
        iterations: Rounds of rolling out, fitting and grounded training.
        grounded_episodes: Episodes of training per iteration.
        sim_rollouts: Episodes added to D_sim per iteration.
        real_rollouts: Episodes added to D_real per iteration.
        groundings: Kinds of grounding: phase, timed, or both.
        constants: Constant delays in s that "main" sweeps.
        rows: Names of the rows to train, and direct transfer with them; default: all of the table.
        evaluation_seeds: Episodes every policy is played for in each domain.
        rule_budget: Most episodes in which each rule is tuned in each domain.
        observation: What agents see.
        reward: What agents want.
        neighbours: How many roads away intersections are seen too.
        duration_s: Length of an episode in s; default: the scenario's own.
        device: Where updates and fits are computed: cpu, cuda, or cuda:N; all trainings share it.
        dqn: Settings of the learner.
        inputs: What f and h see beside the intersection's own state and action.
        fit: How f and h are fitted, but for what a row says itself.
        gate: How alpha is found, but for what a row says itself.
        timed: How greens are delayed, but for what a row says itself.
    """

    scenario: tuple[str, ...] = ("single-v1",)
    domains: tuple[str, ...] = ()
    sim: str = "sim"
    seeds: int = 5
    first_seed: int = 0
    episodes: int = 60
    iterations: int = 4
    grounded_episodes: int = 10
    sim_rollouts: int = 3
    real_rollouts: int = 3
    groundings: tuple[str, ...] = ("phase", "timed")
    constants: tuple[int, ...] = (1, 2, 3, 4, 5)
    rows: tuple[str, ...] = ()
    evaluation_seeds: int = 5
    rule_budget: int = BUDGET
    observation: str = "count"
    reward: str = "queue"
    neighbours: int = 0
    duration_s: float | None = None
    device: str = "cpu"
    dqn: DQNConfig = field(default_factory=DQNConfig)
    inputs: InputsConfig = field(default_factory=InputsConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    timed: TimedConfig = field(default_factory=TimedConfig)

    def __post_init__(self) -> None:
        for name in ("seeds", "evaluation_seeds", "episodes"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}: must be at least 1")
        if self.rule_budget < LEAST_BUDGET:
            raise OptionError(f"rule_budget = {self.rule_budget}: must be at least {LEAST_BUDGET}")
        require_device_name(self.device)
        if not self.scenario:
            raise OptionError("scenario is empty; name one, such as single-v1")
        names = [describe(domain) for domain in self.domains]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise OptionError(f"domain {twice[0]!r} is listed twice (rain is V3, snow is V4, ...)")
        if describe(self.sim) in names:
            raise OptionError(f"domain {self.sim!r} is the simulation itself; name real ones")
        if self.timed.match:
            raise OptionError("rewards are matched in a row of its own; leave timed.match out")
        _ = self.ugat  # refuses what is impossible

    @property
    def ugat(self) -> UgatConfig:
        """Settings of the algorithm that all rows share."""
        return UgatConfig(
            pretrain_episodes=self.episodes,
            iterations=self.iterations,
            grounded_episodes=self.grounded_episodes,
            sim_rollouts=self.sim_rollouts,
            real_rollouts=self.real_rollouts,
            inputs=self.inputs,
            fit=self.fit,
            gate=self.gate,
            timed=self.timed,
        )

    @property
    def all_episodes(self) -> int:
        """Episodes every policy but direct transfer is trained for in all."""
        return self.episodes + self.iterations * self.grounded_episodes

    def targets(self, table: str) -> list[str]:
        """The real domains of a table."""
        default = ("V1",) if table in ("ablation", "alpha") else ("V1", "V2", "V3", "V4")
        found = [describe(domain) for domain in self.domains or default]
        if left := [domain for domain in found if domain != describe(self.sim)]:
            return left
        raise OptionError(
            f"table {table!r} has {self.sim} alone, to which sim is set; name domains"
        )

    def settings(self, table: str) -> list[Setting]:
        """The rows of a table; without those that match rewards which cannot be matched.

        Raises:
            UnknownNameError: The table has no row of that name.
        """
        found = settings_of(table, self.ugat, self.sim, self.groundings, self.constants)
        if self.reward != MATCHED_REWARD:
            found = [setting for setting in found if not setting.ugat.matches]
        names = [setting.name for setting in found]
        for row in self.rows:
            if row not in names:
                raise UnknownNameError(f"row of table {table!r}:", row, names)
        return [item for item in found if not self.rows or item.name in (DIRECT, *self.rows)]


def compare(
    table: str,
    scenario: str,
    config: PaperConfig,
    folder: Path,
    workers: Workers,
    reporter: Reporter,
) -> Comparison:
    """Trains and plays whatever a table still lacks, and puts it together.

    Args:
        table: One of `settings.TABLES`.
        scenario: One of the scenarios.
        config: What is trained.
        folder: Where the folders of the jobs lie; finished ones are used again.
        workers: Jobs at a time, or an executor.
        reporter: Shows progress.
    """
    loaded = load_scenario(scenario)
    rows = config.settings(table)
    timed = any(row.kind == "grounded" and row.ugat.grounding == "timed" for row in rows)
    for target in config.targets(table):
        check_worlds(loaded, config.sim, target, timed)  # an error now, not in an hour
    planner = Planner(table, scenario, config)
    plan = [job for row in rows for job in planner.jobs(row)]
    perform_all(planner.bases + plan, folder, workers, reporter, f"paper {table}")
    trials = [trial for row in rows for trial in planner.trials(row, folder)]
    return Comparison(loaded.id, loaded.hash, describe(config.sim), tuple(trials), {"table": table})


class Planner:
    """The jobs of a table's rows."""

    def __init__(self, table: str, scenario: str, config: PaperConfig) -> None:
        self._scenario = scenario
        self._config = config
        self._targets = config.targets(table)
        self._seeds = range(config.first_seed, config.first_seed + config.seeds)
        plain = Setting(DIRECT, "direct")
        self._bases = {seed: self._planned(plain, None, seed) for seed in self._seeds}

    @property
    def bases(self) -> list[Planned]:
        """Plain training, one per seed: what other jobs start from."""
        return list(self._bases.values())

    def jobs(self, row: Setting) -> list[Planned]:
        """All jobs of a row."""
        return [planned for _, planned in self._columns(row)]

    def trials(self, row: Setting, folder: Path) -> list[Trial]:
        """What the finished jobs of a row say, column by column."""
        found: list[Trial] = []
        for target, planned in self._columns(row):
            scores = done(planned, folder)
            assert scores is not None
            sim, seed = self._config.sim, planned.job.seed
            for (domain, episode), own in sorted(scores.items()):
                if domain in (sim, target) and episode in planned.job.evaluation_seeds:
                    found.append(Trial(row.name, target, describe(domain), seed, episode, own))
        return found

    def _columns(self, row: Setting) -> list[tuple[str, Planned]]:
        seeds: Sequence[int | None] = [None] if row.kind == "rule" else list(self._seeds)
        return [
            (target, self._planned(row, target if row.knows_target else None, seed))
            for target in self._targets
            for seed in seeds
        ]

    def _planned(self, row: Setting, target: str | None, seed: int | None) -> Planned:
        config = self._config
        starts = row.kind in ("grounded", "further", "delays")
        job = Job(
            kind=row.kind,
            scenario=self._scenario,
            sim=config.sim,
            target=target,
            world=row.world,
            seed=seed,
            episodes=self._episodes(row),
            start=self._bases[seed].name if starts and seed is not None else None,
            options={
                "observation": config.observation,
                "reward": config.reward,
                "neighbours": config.neighbours,
                "duration_s": config.duration_s,
            },
            ugat=row.ugat if row.kind == "grounded" else None,
            dqn=config.dqn,
            rule_budget=config.rule_budget if row.kind == "rule" else 0,
            domains=(config.sim, target) if target else (config.sim, *self._targets),
            evaluation_seeds=tuple(EVALUATION_SEED + k for k in range(config.evaluation_seeds)),
            device=config.device,
        )
        return Planned.of(job)

    def _episodes(self, row: Setting) -> int:
        """Of training in all."""
        config = self._config
        by_kind: dict[Kind, int] = {"direct": config.episodes, "rule": 0, "grounded": 0}
        if row.episodes is not None:
            return config.episodes + row.episodes
        return by_kind.get(row.kind, config.all_episodes)
