"""Tables of the UGAT paper and further tables: their settings and their jobs.

`settings_of` lists the settings of a table. `Planner` makes a job of each setting and seed; a
setting that depends on the real domain gets a job per domain. `compare` performs the jobs and
returns a `Comparison`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from ugat_marl.effects import LateGreen, domain_label, domain_path, load_scenario, parse_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError, UnknownNameError, require_distinct, require_least
from ugat_marl.experiments.comparison import Comparison, Trial
from ugat_marl.experiments.driver import perform_all, record_of
from ugat_marl.experiments.evaluation import require_distinct_domains
from ugat_marl.experiments.jobs import LEARNER, Job, evaluation_seeds, worlds_of
from ugat_marl.experiments.row_names import (
    CONTROL,
    DIRECT,
    FINE_TUNED,
    GROUNDED_NAME,
    ORACLE,
    PENALTY,
    RANDOM_DELAY,
    RANDOMISED,
    RULE,
    SEEING_ORACLE,
    STREET,
    UNTRAINED,
    short_name,
    variant_name,
)
from ugat_marl.experiments.settings import SEEN_COMMANDS, LearnerSpec, Setting
from ugat_marl.experiments.training import check_worlds
from ugat_marl.experiments.tuning import BUDGET, LEAST_BUDGET
from ugat_marl.grounding import (
    MATCHED_REWARDS,
    USUAL_REWARD,
    FitConfig,
    GateConfig,
    InputsConfig,
    StreetConfig,
    TimedConfig,
    UgatConfig,
    as_published,
    published_reward,
    refuse_unused,
    require_preset,
)
from ugat_marl.parallel import Workers
from ugat_marl.policies import (
    DQN_NAME,
    UNIVERSAL_NAME,
    DQNConfig,
    observed_options,
    require_device_name,
)
from ugat_marl.progress import Reporter

SEVERAL = 5
"""Number of networks of f in the rows that compare u of h with u of h after f."""

TABLES = ("main", "ablation", "alpha", "uncertainty", "gap")

# --- rows ---------------------------------------------------------------------------------------


def settings_of(
    table: str,
    ugat: UgatConfig,
    sim: str,
    groundings: Sequence[str] = (),
    constants: Sequence[int] = (1, 2, 3, 4, 5, 6),
    learner: LearnerSpec | None = None,
) -> list[Setting]:
    """Return the rows of a table, without those that would train what one before them trains.

    Args:
        table: One of `TABLES`.
        ugat: Settings that the rows share.
        sim: The simulation.
        groundings: Kinds of grounding to try: "phase", "timed", "street"; empty for all that the
            table can have. "alpha" and "uncertainty" need a gate, which "street" has not.
        constants: Constant delays in s that "main" sweeps.
        learner: The learner of all rows; None for "universal".

    Raises:
        OptionError: A grounding, delay or table does not exist.
    """
    gated = table in ("alpha", "uncertainty")
    groundings = groundings or [g for g in GROUNDED_NAME if g != "street" or not gated]
    for grounding in groundings:
        if grounding not in GROUNDED_NAME:
            raise OptionError(f"grounding {grounding!r}: allowed are {', '.join(GROUNDED_NAME)}")
    if wrong := [seconds for seconds in constants if seconds < 1]:
        raise OptionError(f"constants holds {wrong[0]}: delays are whole seconds, at least 1")
    require_distinct(constants=constants)
    # Phase grounding is the paper's: it uses f and h from the start, however accurate they are.
    least = {name: None if name == "phase" else ugat.least_accuracy for name in GROUNDED_NAME}
    alone = replace(ugat, timed=replace(ugat.timed, match=False))  # matching is a row of its own
    bases = {g: replace(alone, grounding=g, least_accuracy=least[g]) for g in groundings}
    direct, rule = Setting(DIRECT, "direct"), Setting(RULE, "rule")
    if table == "main":
        rows = [direct, *_grounded(bases), *_controls(ugat, sim, constants)]
        if learner is not None and learner.dqn.start is not None:
            # no lessons of its own: the rule of another network is in its weights
            rows.append(Setting(UNTRAINED, "untrained", lessons=False))
        if "street" in bases and not observed_options((learner or LearnerSpec()).name):
            rows.append(Setting(SEEING_ORACLE, "scratch", commands=SEEN_COMMANDS))
        rows.append(rule)
    elif table == "ablation":
        rows = [direct, Setting(CONTROL, "further", sim)]
        rows += [row for name, base in bases.items() for row in _ablated(name, base)]
    elif table == "alpha":
        rows = [direct, *(row for name, base in bases.items() for row in _alphas(name, base))]
    elif table == "uncertainty":
        rows = [direct, *(row for name, base in bases.items() for row in _methods(name, base))]
    elif table == "gap":
        rows = [direct, rule]
    else:
        raise OptionError(f"table {table!r}: allowed are {', '.join(TABLES)}")
    return [
        replace(row, learner=learner or LearnerSpec())
        for number, row in enumerate(rows)
        if row.ugat is None or all(row.ugat != other.ugat for other in rows[:number])
    ]


def constant_name(seconds: int) -> str:
    """Return the name of the row of a constant delay."""
    return f"constant delay {seconds} s"


def matched_name(grounding: str) -> str:
    """Return the name of the row of a grounding that matches rewards."""
    return variant_name(grounding, "rewards matched")


def late_in(sim: str, seconds: int) -> str:
    """Return the simulation with every green late by a constant delay in s.

    Raises:
        OptionError: The simulation is a separate scenario, to which no effect can be added by
            name, or has late greens of its own.
    """
    if domain_path(sim) is not None:
        raise OptionError(
            f"sim = {sim!r} is a scenario of its own, in which no greens can be delayed: give "
            "--constants without any number"
        )
    if any(isinstance(effect, LateGreen) for effect in parse_domain(sim)):
        raise OptionError(
            f"sim = {sim!r} has late greens of its own, which constant delays would replace: give "
            "--constants without any number"
        )
    late = f"late_green=*,{seconds}"
    return late if domain_label(sim) == "sim" else f"{domain_label(sim)}+{late}"


def _ugat(name: str, ugat: UgatConfig) -> Setting:
    return Setting(name, "grounded", ugat=ugat)


def _grounded(bases: Mapping[str, UgatConfig]) -> list[Setting]:
    rows = [_ugat(_grounded_name(name, base.gate), base) for name, base in bases.items()]
    return rows + [row for name, base in bases.items() for row in _matching(name, base)]


def _grounded_name(grounding: str, gate: GateConfig) -> str:
    """Return the name of the row of a grounding, which tells an α that does not follow u."""
    other = {"static": f"α = {gate.static_alpha:g}", "infinite": "no gate"}.get(gate.mode)
    if other is None or grounding == "street":
        return GROUNDED_NAME[grounding]
    return variant_name(grounding, other)


def _matching(name: str, base: UgatConfig) -> list[Setting]:
    """Return timed grounding that matches rewards; nothing for phase grounding, which cannot."""
    ugat = replace(base, timed=replace(base.timed, match=True))
    return [_ugat(matched_name(name), ugat)] * ugat.matches


def _controls(ugat: UgatConfig, sim: str, constants: Sequence[int]) -> list[Setting]:
    seen = ugat.iterations * ugat.real_rollouts
    return [
        Setting(CONTROL, "further", sim),
        Setting(RANDOMISED, "randomised"),
        Setting(RANDOM_DELAY, "delays", sim),
        Setting(PENALTY, "penalty", sim),
        *(Setting(constant_name(s), "further", late_in(sim, s)) for s in constants),
        Setting(FINE_TUNED, "further", episodes=seen, lessons=False),
        Setting(ORACLE, "scratch"),
    ]


def _ablated(name: str, base: UgatConfig) -> list[Setting]:
    """Return Table 3 of the paper (static α, no uncertainty) and rows that change another part."""
    if name == "street":
        return [_ugat(row, replace(base, street=x)) for row, x in _streets(base.street).items()]
    ungated = replace(base, gate=replace(base.gate, mode="infinite"))
    variants = {
        _grounded_name(name, base.gate): base,
        variant_name(name, "α = 0.5"): replace(base, gate=_static(base, 0.5)),
        variant_name(name, "α from the first fit on"): replace(
            base, gate=replace(base.gate, start="fitted")
        ),
        variant_name(name, "no gate"): ungated,
        variant_name(name, "no uncertainty (GAT)"): replace(
            ungated, fit=replace(base.fit, uncertainty="none")
        ),
    }
    proven = replace(base, least_accuracy=0.0)
    if base != proven:
        variants[variant_name(name, "where f and h are proven")] = proven
    variants |= _departures(name, base)
    rows = [_ugat(variant, ugat) for variant, ugat in variants.items()]
    return [*rows, _other_answers(name, base), *_matching(name, base)]


def _streets(base: StreetConfig) -> dict[str, StreetConfig]:
    """Return fitted streets by their rows: the parts, each alone, and all with a residual."""
    residual = base.residual
    plain = replace(base, residual=replace(residual, kind="none"))
    rows = {STREET: plain}
    rows |= {f"{STREET}: {part} alone": replace(plain, parts=(part,)) for part in base.parts}
    return rows | {
        residual_name("phase"): replace(base, residual=replace(residual, kind="phase")),
        residual_name("timed"): replace(base, residual=replace(residual, kind="timed")),
    }


def residual_name(kind: str) -> str:
    """Return the name of the row of a fitted street with a residual."""
    return f"{STREET}: all parts and residual, {kind}"


def _departures(name: str, base: UgatConfig) -> dict[str, UgatConfig]:
    """Return rows for the choices of docs/explanation/departures.md that concern f and h."""
    several = replace(base, forward=replace(base.forward, members=SEVERAL))
    of_h = replace(several, gate=replace(base.gate, uncertainty_of="h"))
    return {
        variant_name(name, "own heads"): replace(base, inverse=replace(base.inverse, head="own")),
        variant_name(name, "several f, u of h"): of_h,
        variant_name(name, "several f, u of h after f"): several,
        variant_name(name, "KL weight 1"): replace(base, fit=replace(base.fit, kl_weight=1.0)),
        variant_name(name, "no off-data loss"): replace(
            base, fit=replace(base.fit, off_data_weight=0.0)
        ),
    }


def _other_answers(name: str, base: UgatConfig) -> Setting:
    """Return phase grounding with h fitted to smoothed pairs, or timed grounding without h."""
    if name == "phase":
        smoothed = replace(base, fit=replace(base.fit, pairs="smoothed"))
        return _ugat(variant_name(name, "h on smoothed pairs"), smoothed)
    constants = replace(base, timed=replace(base.timed, answer="constant"))
    return _ugat(variant_name(name, "lost times without h"), constants)


def _alphas(name: str, base: UgatConfig) -> list[Setting]:
    _require_gate(name)
    alphas = {0.2, 0.4, 0.5, 0.6, 0.8}  # those of the paper
    if base.gate.mode == "static":
        alphas.add(float(base.gate.static_alpha))
    dynamic = replace(base, gate=replace(base.gate, mode="dynamic"))
    pooled = replace(dynamic, gate=replace(dynamic.gate, scope="pooled"))
    return [
        *(
            _ugat(variant_name(name, f"α = {a}"), replace(base, gate=_static(base, a)))
            for a in sorted(alphas)
        ),
        _ugat(GROUNDED_NAME[name], dynamic),
        _ugat(variant_name(name, "α pooled over the network"), pooled),
    ]


def _require_gate(name: str) -> None:
    """Refuse a grounding without a gate.

    Raises:
        OptionError: The grounding has none.
    """
    if name == "street":
        raise OptionError("a fitted street has no gate: give --groundings phase timed")


def _static(base: UgatConfig, alpha: float) -> GateConfig:
    return replace(base.gate, mode="static", static_alpha=alpha)


def _methods(name: str, base: UgatConfig) -> list[Setting]:
    _require_gate(name)
    methods: dict[str, FitConfig] = {
        "evidential": replace(base.fit, uncertainty="edl"),
        "Concrete Dropout": replace(base.fit, uncertainty="dropout"),
        "Deep Ensembles": replace(base.fit, uncertainty="ensemble"),
        "none (GAT)": replace(base.fit, uncertainty="none"),
    }
    return [
        _ugat(variant_name(name, method), replace(base, fit=fit)) for method, fit in methods.items()
    ]


# --- tables -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PaperConfig:
    """Options of a table: its trainings and their evaluation.

    Attributes:
        scenario: Scenarios, one table each.
        domains: The real domains; default: V1 to V4; for "ablation" and "alpha" only V1, as in
            the paper.
        sim: The simulation to train in.
        seeds: Number of trainings of every setting, each with its own seed.
        first_seed: First training seed; the others follow it.
        episodes: Episodes of plain training before the first iteration.
        iterations: Repetitions of roll-outs, fits and grounded training.
        grounded_episodes: Episodes of grounded training per iteration.
        sim_rollouts: Episodes added to D_sim per iteration.
        real_rollouts: Episodes added to D_real per iteration.
        preset: "paper" for Algorithm 1 exactly as published: phase grounding, the reward queue, the
            learner dqn. Of what is not given, it has 60 plain episodes, 4 iterations, 10 grounded
            episodes, and 3 roll-outs each in sim and on the street.
        groundings: Kinds of grounding: phase, timed, street; default: all that the table can have.
        constants: Constant delays in s that "main" sweeps.
        rows: Names of the rows to train; phase stands for the paper's UGAT, and direct transfer is
            always trained. Default: all rows.
        evaluation_seeds: Number of evaluation episodes of each policy in each domain.
        rule_budget: Most episodes to tune one rule in one domain.
        observation: Kind of observation; default: the one that the learner needs, or count.
        reward: Kind of reward.
        neighbours: Agents also observe intersections up to this many roads away.
        duration_s: Length of an episode in s; default: the scenario's own.
        learner: Learner of all rows: universal or dqn, the suite's own, or a baseline
            (docs/how-to/learners.md), or your own as my_module:MyLearner; default: universal, and
            dqn with the preset "paper".
        learner_settings: Settings of a baseline as NAME=VALUE, such as learning_rate=0.001; commas
            separate the parts of a tuple.
        device: Device for the learner's updates and the fits: cpu, cuda, or cuda:N; all trainings
            share it.
        dqn: Settings of the learners universal and dqn.
        inputs: Inputs of f and h beside the intersection's own state and action.
        fit: Settings of the fit of f and h; a row may replace some.
        gate: Settings of the gate and its threshold; a row may replace some.
        timed: Settings of timed grounding; a row may replace some.
        street: Settings of the fit of a street; a row may replace some.
    """

    scenario: tuple[str, ...] = ("single-v1",)
    domains: tuple[str, ...] = ()
    sim: str = "sim"
    seeds: int = 5
    first_seed: int = 0
    episodes: int = UgatConfig.pretrain_episodes
    iterations: int = UgatConfig.iterations
    grounded_episodes: int = UgatConfig.grounded_episodes
    sim_rollouts: int = UgatConfig.sim_rollouts
    real_rollouts: int = UgatConfig.real_rollouts
    preset: Literal["paper"] | None = None
    groundings: tuple[str, ...] = ()
    constants: tuple[int, ...] = (1, 2, 3, 4, 5, 6)
    rows: tuple[str, ...] = ()
    evaluation_seeds: int = 5
    rule_budget: int = BUDGET
    observation: str | None = None
    reward: str = USUAL_REWARD
    neighbours: int = 0
    duration_s: float | None = None
    learner: str = ""
    learner_settings: tuple[str, ...] = ()
    device: str = "cpu"
    dqn: DQNConfig = field(default_factory=DQNConfig)
    inputs: InputsConfig = field(default_factory=InputsConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    timed: TimedConfig = field(default_factory=TimedConfig)
    street: StreetConfig = field(default_factory=StreetConfig)

    def __post_init__(self) -> None:
        require_preset(self.preset)
        if self.preset is not None:
            self._take_published()
        if not self.learner:
            object.__setattr__(self, "learner", UNIVERSAL_NAME)
        object.__setattr__(self, "sim", domain_label(self.sim))  # V4 and snow are one simulation
        require_least(0, first_seed=self.first_seed)
        require_least(1, seeds=self.seeds, evaluation_seeds=self.evaluation_seeds)
        require_least(1, episodes=self.episodes)
        require_least(LEAST_BUDGET, rule_budget=self.rule_budget)
        require_device_name(self.device)
        if not self.scenario:
            raise OptionError("scenario is empty; name one, such as single-v1")
        require_distinct_domains(self.domains)
        if self.sim in map(domain_label, self.domains):
            raise OptionError(f"domain {self.sim!r} is the simulation itself; name real ones")
        if self.timed.match:
            raise OptionError("rewards are matched in a row of its own; leave timed.match out")
        _ = self.ugat  # it checks its options when it is made
        # direct transfer alone starts from nothing
        if not self.spec.savable and set(self.rows) != {DIRECT}:
            raise OptionError(
                f"learner {self.learner!r}: rows of a table start from what direct transfer has "
                "learnt; give its class the methods save(path) and load(path)"
            )

    def _take_published(self) -> None:
        """Set what Algorithm 1 as published decides.

        Raises:
            OptionError: Another option was given for it.
        """
        if {*self.groundings} - {"phase"}:
            raise OptionError(f"preset paper has phase grounding alone, not {self.groundings}")
        published = self.ugat
        values: dict[str, Any] = {
            "groundings": ("phase",),
            "reward": published_reward(self.reward),
            "learner": self.learner or DQN_NAME,
            "episodes": published.pretrain_episodes,
            "iterations": published.iterations,
            "grounded_episodes": published.grounded_episodes,
            "sim_rollouts": published.sim_rollouts,
            "real_rollouts": published.real_rollouts,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def ugat(self) -> UgatConfig:
        """Settings of the algorithm that all rows share."""
        given = UgatConfig(
            pretrain_episodes=self.episodes,
            iterations=self.iterations,
            grounded_episodes=self.grounded_episodes,
            sim_rollouts=self.sim_rollouts,
            real_rollouts=self.real_rollouts,
            inputs=self.inputs,
            fit=self.fit,
            gate=self.gate,
            timed=self.timed,
            street=self.street,
        )
        return given if self.preset is None else as_published(given)

    @property
    def spec(self) -> LearnerSpec:
        """The learner of all rows."""
        return LearnerSpec(self.learner, self.learner_settings, self.dqn)

    @property
    def all_episodes(self) -> int:
        """All training episodes of a policy that goes beyond direct transfer."""
        return self.episodes + self.iterations * self.grounded_episodes

    def targets(self, table: str) -> list[str]:
        """Return the real domains of a table."""
        default = ("V1",) if table in ("ablation", "alpha") else ("V1", "V2", "V3", "V4")
        domains = [domain_label(domain) for domain in self.domains or default]
        if left := [domain for domain in domains if domain != self.sim]:
            return left
        raise OptionError(
            f"every domain of table {table!r} is the simulation itself (sim = {self.sim!r}); "
            "name other domains"
        )

    def settings(self, table: str) -> list[Setting]:
        """Return the rows of a table; rows that match rewards only if the reward allows it.

        Raises:
            UnknownNameError: The table has no row of that name.
        """
        if table == "gap" and {*self.groundings} - {"phase"}:  # which the preset "paper" sets
            raise OptionError("table 'gap' has no grounding; leave groundings out")
        if table != "main" and tuple(self.constants) != PaperConfig.constants:
            raise OptionError(f"table {table!r} has no constants, only 'main' has; leave them out")
        rows = settings_of(table, self.ugat, self.sim, self.groundings, self.constants, self.spec)
        if self.reward not in MATCHED_REWARDS:
            rows = [setting for setting in rows if not setting.matches]
        names = {setting.name for setting in rows}
        full = {short_name(name): name for name in names}
        wanted = {DIRECT, *(full.get(row, row) for row in self.rows)}
        for row in sorted(wanted - names):
            raise UnknownNameError(f"row of table {table!r}:", row, names)
        return [row for row in rows if not self.rows or row.name in wanted]


def compare(
    table: str,
    scenario: str,
    config: PaperConfig,
    folder: Path,
    workers: Workers,
    reporter: Reporter,
) -> Comparison:
    """Perform the unfinished jobs of a table and return the whole table.

    Args:
        table: One of `TABLES`.
        scenario: One of the scenarios.
        config: Options of the table.
        folder: Folder that holds the jobs' folders; finished jobs are reused.
        workers: Jobs at a time, or an executor.
        reporter: Shows progress.
    """
    loaded = load_scenario(scenario, config.duration_s)
    rows = config.settings(table)
    if config.preset is None:  # a preset also sets what a table without grounding leaves alone
        refuse_unused(config.ugat, {name for row in rows if row.ugat for name in row.ugat.used})
    config.spec.factory(config.device)  # a missing library is an error now, not in a job's log
    for target in config.targets(table):
        # an error now, not in an hour
        check_worlds(loaded, config.sim, target, duration_s=config.duration_s)
    planner = Planner(table, scenario, config)
    plan = [job for row in rows for job in planner.jobs(row)]
    grounded = [job for job in plan if job.setting.ugat is not None]
    _refuse_impossible([job for job in grounded if job.seed == config.first_seed])
    perform_all(
        planner.bases + plan, folder, workers=workers, reporter=reporter, title=f"paper {table}"
    )
    trials = [trial for row in rows for trial in planner.trials(row, folder)]
    late = [constant_name(seconds) for seconds in config.constants]
    return Comparison(
        loaded.id,
        loaded.hash,
        config.sim,
        tuple(trials),
        {"learner": config.learner},
        constants=tuple(row.name for row in rows if row.name in late),
        grounded=tuple(row.name for row in rows if row.recipe == "grounded"),
    )


def _refuse_impossible(jobs: Sequence[Job]) -> None:
    """Refuse jobs before plain training that would be refused after it.

    Args:
        jobs: Jobs of grounded rows of one table; they have sim and options in common.

    Raises:
        OptionError: A job cannot be performed, see `worlds_of`.
    """
    if not jobs:
        return
    options = dict[str, Any](jobs[0].options)
    with contextlib.closing(parallel_env(jobs[0].loaded(), jobs[0].sim, **options)) as env:
        for job in jobs:
            worlds_of(job, env, None)


class Planner:
    """The jobs of a table: rows x domains x seeds.

    Args:
        table: One of `TABLES`.
        scenario: One of the scenarios.
        config: Options of the table.
    """

    def __init__(self, table: str, scenario: str, config: PaperConfig) -> None:
        self._scenario = scenario
        self._config = config
        self._targets = config.targets(table)
        self._seeds = range(config.first_seed, config.first_seed + config.seeds)
        direct = Setting(DIRECT, "direct", learner=config.spec)
        self._bases = {seed: self._job(direct, None, seed) for seed in self._seeds}

    @property
    def bases(self) -> list[Job]:
        """Jobs of plain training, one per seed; other jobs start from them."""
        return list(self._bases.values())

    def jobs(self, row: Setting) -> list[Job]:
        """Return all jobs of a row."""
        return [job for _, job in self._columns(row)]

    def trials(self, row: Setting, folder: Path) -> list[Trial]:
        """Return the episodes of a row's finished jobs, column by column.

        Args:
            row: A setting of the table.
            folder: Folder that holds the jobs' folders.
        """
        trials: list[Trial] = []
        for target, job in self._columns(row):
            record = record_of(job, folder)
            assert record is not None
            for domain in sorted({self._config.sim, target}):
                scores = record.played(job, job.episodes, domain)
                for seed, episode in zip(job.evaluation_seeds, scores, strict=True):
                    trials.append(
                        Trial(row.name, target, domain_label(domain), job.seed, seed, episode)
                    )
        return trials

    def _columns(self, row: Setting) -> list[tuple[str, Job]]:
        seeds: Sequence[int | None] = [None] if row.recipe == "rule" else list(self._seeds)
        return [
            (target, self._job(row, target if row.knows_target else None, seed))
            for target in self._targets
            for seed in seeds
        ]

    def _job(self, row: Setting, target: str | None, seed: int | None) -> Job:
        config = self._config
        base = self._bases[seed] if row.begins_with_direct and seed is not None else None
        return Job(
            setting=row,
            scenario=self._scenario,
            sim=config.sim,
            target=target,
            seed=seed,
            episodes=self._episodes(row),
            start=None if base is None else f"{base.name}/{LEARNER}",
            start_episodes=0 if base is None else base.episodes,
            options=config.spec.env_options(
                config.observation,
                reward=config.reward,
                neighbours=config.neighbours,
                duration_s=config.duration_s,
            ),
            rule_budget=config.rule_budget if row.recipe == "rule" else None,
            domains=(config.sim, target) if target else (config.sim, *self._targets),
            evaluation_seeds=evaluation_seeds(config.evaluation_seeds),
            device=config.device,
        )

    def _episodes(self, row: Setting) -> int:
        """Return the number of training episodes in all."""
        config = self._config
        if row.episodes is not None:
            return config.episodes + row.episodes
        fixed = {"direct": config.episodes, "rule": 0, "untrained": 0}
        return fixed.get(row.recipe, config.all_episodes)
