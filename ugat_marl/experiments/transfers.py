"""Command ``train``: UGAT and the settings compared with it, judged in both domains.

UGAT, each setting and the best rule of each domain are jobs, which `jobs.perform` trains, judges
and resumes. Plain training is the first stage of UGAT's job, as line 1 of Algorithm 1. A separate
job would divide the metrics of one training between two folders.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from ugat_marl.data import (
    CHECKPOINT_FOLDER,
    METRICS_FILE,
    LogCallback,
    TransitionLog,
    installed_versions,
    lock_folder,
    other_versions,
    write_identity,
    write_settings,
)
from ugat_marl.effects import domain_label, load_scenario, scenario_in_domain
from ugat_marl.envs import AgentSet, TrafficEnv, parallel_env
from ugat_marl.errors import (
    CheckpointError,
    OptionError,
    ScenarioError,
    require_distinct,
    require_least,
)
from ugat_marl.experiments.driver import perform_here
from ugat_marl.experiments.jobs import (
    DIRECT_POLICY,
    POLICY,
    RULE_FILE,
    SCORES,
    Job,
    JobRecord,
    evaluation_seeds,
    file_names,
    worlds_of,
)
from ugat_marl.experiments.plans import described_plan, jobs_beside, work_of
from ugat_marl.experiments.queues import QUEUES, write_queues
from ugat_marl.experiments.row_names import (
    CONTROL,
    CORRECTED,
    FINE_TUNED,
    GROUNDED_NAME,
    ORACLE,
    RANDOM_DELAY,
    RANDOMISED,
    RULE,
)
from ugat_marl.experiments.scores import Evaluation, Result, best_rule_note, rule_policy
from ugat_marl.experiments.settings import LearnerSpec, Setting
from ugat_marl.experiments.tuning import LEAST_BUDGET
from ugat_marl.files import file_hash, require_writable, write_whole
from ugat_marl.grounding import (
    DIRECT_LEARNER,
    USUAL_REWARD,
    NegativeControl,
    UgatConfig,
    as_published,
    published_reward,
    refuse_unused,
    require_negative_control,
    require_preset,
)
from ugat_marl.parallel import Workers
from ugat_marl.policies import (
    DQN_NAME,
    STANDARD_RULES,
    TUNED_RULES,
    UNIVERSAL_NAME,
    DQNConfig,
    check_own_learner,
    is_own,
    require_device_name,
)
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario
from ugat_marl.simulation import kept_warm

TRAININGS = "trainings"
"""Folder in a run's folder; it holds the folders of the jobs."""

ADDED = ("control", "further", "randomised", "random_delay_s", "fine_tuned", "oracle")
"""Options that add policies to the table and change no other policy."""


@dataclass(frozen=True)
class TransferConfig:
    """Options of ``train``: what to train, where, and how to judge it.

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        real: The real domain: V1..V4 or an alias, effect=value+..., or a scenario directory. "none"
            needs `real_log`: only the log is known of the real domain.
        sim: The simulation to train in; "sim", or a domain like `real`.
        preset: "paper" for Algorithm 1 exactly as published; it decides the reward (queue) and all
            settings of the algorithm. Of what is not given, it has 60 plain episodes, 4 iterations,
            10 grounded episodes, and 3 roll-outs each in sim and on the street.
        real_log: Transition log that replaces the roll-outs in the real domain.
        seed: Root of every random choice in training.
        observation: Kind of observation: count, queue, pressure, waiting, density, movements;
            default: movements for the learner universal, and count for others.
        reward: Kind of reward: total-queue, queue, pressure, waiting.
        neighbours: Agents also observe intersections up to this many roads away.
        duration_s: Length of an episode in s; default: the scenario's own.
        evaluation_seeds: Number of evaluation episodes of each policy in each domain.
        tuning_seeds: Number of episodes on which the best rule is chosen.
        rule_budget: Most episodes to tune each rule in each domain before the best is chosen;
            default: no tuning, but the usual settings of each rule.
        control: Also train direct transfer for as many further episodes in plain sim.
        further: Domains in which direct transfer is trained further, as long as the control, with
            one policy each. "late_green=*,3" delays all greens by 3 s; "V4" fine-tunes in the real
            domain itself.
        corrected: A corrected scenario of `ugat-marl diagnose`, or any other domain: also train
            there from scratch, for as many episodes as the method in all.
        randomised: Also train from scratch, for as many episodes as the method in all. Each
            episode is in another world, drawn from the ranges of the effects.
        random_delay_s: Also train direct transfer further, as long as the control, while greens
            begin late by random whole seconds up to this value.
        fine_tuned: Also train direct transfer further in the real domain, for as many episodes as
            the method records there.
        oracle: Also train from scratch in the real domain, for as many episodes as the method in
            all.
        negative_control: What the log of the street is replaced by; grounding must win nothing with
            it. "same-world" records D_real in the simulation, "shuffled" permutes the outcomes in
            D_real, "noise" replaces f by noise; the last two with phase or timed.
        learner: The learner: universal or dqn, the suite's own, a baseline, or your own as
            my_module:MyLearner (docs/how-to/learners.md); default: universal, and dqn with the
            preset "paper".
        learner_settings: Settings of a baseline or of your own learner as NAME=VALUE, such as
            learning_rate=0.001; commas separate the parts of a tuple.
        device: Device for the learner's updates and the fits of f and h: cpu, cuda, or cuda:N.
        ugat: Settings of the algorithm.
        dqn: Settings of the learners universal and dqn.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    real: str = "V4"
    sim: str = "sim"
    preset: Literal["paper"] | None = None
    real_log: Path | None = None
    seed: int = 0
    observation: str | None = None
    reward: str = USUAL_REWARD
    neighbours: int = 0
    duration_s: float | None = None
    evaluation_seeds: int = 5
    tuning_seeds: int = 2
    rule_budget: int | None = None
    control: bool = True
    further: tuple[str, ...] = ()
    corrected: str | None = None
    randomised: bool = False
    random_delay_s: int | None = None
    fine_tuned: bool = False
    oracle: bool = False
    negative_control: NegativeControl = "none"
    learner: str = ""
    learner_settings: tuple[str, ...] = ()
    device: str = "cpu"
    ugat: Annotated[UgatConfig, arg(name="")] = field(default_factory=UgatConfig)
    dqn: DQNConfig = field(default_factory=DQNConfig)

    def __post_init__(self) -> None:
        require_preset(self.preset)
        if self.preset is not None:
            object.__setattr__(self, "ugat", as_published(self.ugat))
            object.__setattr__(self, "reward", published_reward(self.reward))
        if not self.learner:
            usual = UNIVERSAL_NAME if self.preset is None else DQN_NAME
            object.__setattr__(self, "learner", usual)
        for name in ("real", "sim"):  # V4 and snow are one run
            object.__setattr__(self, name, domain_label(getattr(self, name)))
        object.__setattr__(self, "further", tuple(map(domain_label, self.further)))
        if self.corrected is not None:
            object.__setattr__(self, "corrected", domain_label(self.corrected))
        require_least(0, seed=self.seed)
        require_least(1, evaluation_seeds=self.evaluation_seeds, tuning_seeds=self.tuning_seeds)
        require_least(LEAST_BUDGET, rule_budget=self.rule_budget)
        if self.real == self.sim and self.negative_control != "same-world":
            raise OptionError(
                f"real = {self.real!r} is the simulation itself; name another domain, such as V4, "
                'or ask for the negative control "same-world"'
            )
        require_distinct(further=self.further)
        if self.sim in self.further:  # one training, with queues under the name of one row
            raise OptionError(
                f"further = {self.sim} is what the control does ({CONTROL!r}); use the control "
                "for it, and leave it out of further"
            )
        if self.corrected is not None and self.corrected == self.sim:
            raise OptionError(
                f"corrected = {self.corrected!r} is the simulation itself; name the scenario that "
                "`ugat-marl diagnose` wrote, or another domain"
            )
        if self.real == "none" and self.real_log is None:
            raise OptionError(
                'real = "none" needs real_log, a log of the street; or name a real domain'
            )
        self._refuse_impossible_controls()

    def _refuse_impossible_controls(self) -> None:
        _ = self.spec  # raises an error for an unknown learner, or settings of another one
        require_device_name(self.device)
        require_negative_control(self.negative_control)
        if self.negative_control == "same-world" and self.real_log is not None:
            raise OptionError(
                'the negative control "same-world" has no street, real_log is of one; '
                "leave out one of them"
            )
        require_least(1, random_delay_s=self.random_delay_s)
        continues = {
            "further": bool(self.further),
            "random_delay_s": self.random_delay_s is not None,
            "fine_tuned": self.fine_tuned,
        }
        for name, asked in continues.items():
            if asked and not self.spec.savable:
                raise OptionError(
                    f"{name} starts from the learner of direct transfer, and {self.learner!r} "
                    "cannot be kept: give its class the methods save(path) and load(path)"
                )
        for name in ("fine_tuned", "oracle"):
            if getattr(self, name) and len(self.domains) < 2:
                raise OptionError(f"{name} needs a real domain to train in, not {self.real!r}")
        for who, acts in (("fine_tuned", self.fine_tuned), ("timed match", self.ugat.matches)):
            if acts and self.real_log is not None:
                raise OptionError(f"{who} acts in the real domain, which a real_log does not allow")

    @property
    def spec(self) -> LearnerSpec:
        """The learner of all policies."""
        return LearnerSpec(self.learner, self.learner_settings, self.dqn)

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON; settings of the learner that were not given are its own."""
        return {**asdict(self), "dqn": asdict(self.spec.dqn)}

    @property
    def settings(self) -> list[Setting]:
        """Settings trained in addition to direct transfer and UGAT."""
        seen, spec = self.ugat.iterations * self.ugat.real_rollouts, self.spec
        rows: list[Setting] = []
        if self.control:
            rows.append(Setting(CONTROL, "further", self.sim, spec))
        rows += [Setting(f"further in {d}", "further", d, spec) for d in self.further]
        if (most_s := self.random_delay_s) is not None:
            name = f"{RANDOM_DELAY} 0-{most_s} s"
            rows.append(Setting(name, "delays", self.sim, spec, most_delay_s=most_s))
        if self.fine_tuned:
            rows.append(Setting(FINE_TUNED, "further", None, spec, episodes=seen, lessons=False))
        if self.randomised:
            rows.append(Setting(RANDOMISED, "randomised", None, spec))
        if self.corrected is not None:
            rows.append(Setting(CORRECTED, "scratch", self.corrected, spec))
        if self.oracle:
            rows.append(Setting(ORACLE, "scratch", None, spec))
        return rows

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of every environment of the experiment."""
        return self.spec.env_options(
            self.observation,
            reward=self.reward,
            neighbours=self.neighbours,
            duration_s=self.duration_s,
        )

    @property
    def domains(self) -> list[str]:
        """Domains in which the policies are judged."""
        only = self.real in ("none", self.sim)
        return [self.sim] if only else [self.sim, self.real]

    @property
    def episodes(self) -> int:
        """All training episodes of UGAT; the control and corrected sim get the same number."""
        return self.ugat.pretrain_episodes + self.ugat.iterations * self.ugat.grounded_episodes


@kept_warm()
def transfer(
    config: TransferConfig,
    directory: Path,
    *,
    resume: bool = False,
    reporter: Reporter | None = None,
    workers: Workers = None,
    on_log: LogCallback | None = None,
) -> Evaluation:
    """Perform the jobs of a run, and write its table and its results to `directory`.

    Args:
        config: Options of the run.
        directory: Folder of the run. It receives ``table.json``, ``queues.parquet``,
            ``metrics.parquet``, ``policies`` and the options. The jobs' folders are in
            ``trainings``: with checkpoints, TensorBoard files and records.
        resume: Continue the run in the folder.
        reporter: Shows progress.
        workers: Simulations at a time, or an executor, for roll-outs and the search for rules; the
            policies are evaluated on this machine.
        on_log: Called with all numbers that the training of UGAT logs, and at the end with the
            scores of the table.

    Raises:
        OptionError: The folder holds a run already, and `resume` is not set; or another process
            trains there.
        CheckpointError: The folder holds a run with other options.
    """
    reporter = reporter or Silent()
    if not resume:  # an older run that has such settings goes on
        refuse_unused(config.ugat, config.ugat.used)
    scenario = load_scenario(config.scenario, config.duration_s)
    with contextlib.closing(parallel_env(scenario, config.sim, **config.env_options)) as env:
        _check(config, scenario, env, reporter)  # an error now, not in an hour
        identity = _identity(config, scenario, env)
    plan = planned_jobs(config)
    folder = directory / TRAININGS
    require_writable(directory / "table.json")
    # Until the table is written: a second run that begins while this one is judged would lose.
    with contextlib.closing(lock_folder(directory)):
        names = (CHECKPOINT_FOLDER, SCORES)
        begun = any(path for name in names for path in folder.glob(f"*/{name}"))
        if begun and not resume:
            raise OptionError(
                f"{directory} holds a run already; resume it (--resume, or resume=True in Python), "
                "or choose another folder (--out)"
            )
        if resume and not begun:
            reporter.say(f"note: {directory} holds no run to go on with; a new one begins")
        write_identity(directory, identity, begun=begun)
        for name, (before, now) in other_versions(directory).items() if begun else ():
            reporter.say(f"note: this run began with {name} {before}, and goes on with {now}")
        write_settings(directory, config.as_dict())
        episode_s = config.duration_s or scenario.settings.duration_s
        beside = jobs_beside(plan, folder, episode_s, workers)
        for line in described_plan(plan, directory, folder, episode_s, beside):
            reporter.say(line)
        with reporter.whole("whole run", work_of(plan, folder, episode_s, beside)):
            records = perform_here(
                plan, folder, workers=workers, reporter=reporter, on_log=on_log, beside=beside
            )
        table = _write_results(config, scenario, directory, plan, records)
    if on_log is not None:
        on_log("evaluation", config.episodes, _means(table))
    return table


def _means(table: Evaluation) -> dict[str, float]:
    """Return the mean travel times of a table by ``POLICY/DOMAIN/att_s``."""
    return {
        f"{policy}/{domain}/att_s": table.estimate(policy, domain, "att_s").mean
        for policy in table.policies
        for domain in table.domains
    }


def planned_jobs(config: TransferConfig) -> list[Job]:
    """Return the jobs of a run: UGAT with its plain training, the other settings, and the rules.

    Settings that begin with direct transfer start from the learner that the first job keeps after
    plain training. Where a learner cannot be kept, the control trains all its episodes itself.
    """
    ugat, kept = _grounded_job(config), config.spec.savable
    real, common = ugat.target, replace(ugat, real_log=None, probe_domains=(), target=None)
    pretrained = config.ugat.pretrain_episodes
    begun = {"start": f"{ugat.name}/{DIRECT_LEARNER}", "start_episodes": pretrained}
    others = [
        replace(
            common,
            setting=setting,
            target=real if setting.knows_target else None,
            episodes=config.episodes if setting.episodes is None else pretrained + setting.episodes,
            **(begun if setting.begins_with_direct and kept else {}),
        )
        for setting in config.settings
    ]
    rule = replace(
        common,
        setting=Setting(RULE, "rule"),
        seed=None,
        episodes=0,
        rule_budget=config.rule_budget,
    )
    return [ugat, *others, *(replace(rule, target=domain) for domain in config.domains)]


def _grounded_job(config: TransferConfig) -> Job:
    """Return the job of UGAT with its plain training."""
    setting = Setting(
        GROUNDED_NAME[str(config.ugat.grounding)],
        "grounded",
        learner=config.spec,
        ugat=config.ugat,
        negative_control=config.negative_control,
    )
    return Job(
        setting,
        config.scenario,
        sim=config.sim,
        target=None if config.real == "none" else config.real,
        seed=config.seed,
        episodes=config.episodes,
        options=config.env_options,
        real_log=None if config.real_log is None else str(config.real_log),
        probe_domains=tuple(config.domains),
        tuning_seeds=config.tuning_seeds,
        domains=tuple(config.domains),
        evaluation_seeds=evaluation_seeds(config.evaluation_seeds),
        device=config.device,
    )


def _write_results(
    config: TransferConfig,
    scenario: Scenario,
    directory: Path,
    plan: Sequence[Job],
    records: Sequence[JobRecord],
) -> Evaluation:
    """Write table, queues, metrics and policies of finished jobs; return the table."""
    folder = directory / TRAININGS
    rows: dict[str, tuple[Job, int, JobRecord]] = {}
    rules: dict[str, str] = {}
    for job, record in zip(plan, records, strict=True):
        for mark, name in job.rows.items():
            if job.setting.recipe == "rule":
                rule = (folder / job.name / RULE_FILE).read_text()
                rules[domain_label(job.target or job.sim)] = rule
                name = rule_policy(rule)
            rows.setdefault(name, (job, mark, record))  # one rule may be the best of both domains
    trained = {name: row for name, row in rows.items() if row[0].seed is not None}
    policies: set[Path] = set()
    for file, (job, mark, _) in zip(file_names(trained), trained.values(), strict=True):
        policy = folder / job.name / (POLICY if mark == job.episodes else DIRECT_POLICY)
        if not policy.exists():  # of a learner that cannot be kept
            continue
        policies.add(directory / "policies" / f"{file}.pt")
        write_whole(directory / "policies" / f"{file}.pt", policy.read_bytes())
    for path in _policies_before(directory) - policies:  # of rows that an earlier call asked for
        path.unlink(missing_ok=True)
    write_whole(directory / METRICS_FILE, (folder / plan[0].name / METRICS_FILE).read_bytes())
    write_queues(
        directory / QUEUES,
        {n: (folder / job.name / QUEUES, job.rows[mark]) for n, (job, mark, _) in rows.items()},
    )
    results = tuple(
        Result(name, domain_label(domain), seed, scores)
        for name, (job, mark, record) in rows.items()
        for domain in job.domains
        for seed, scores in zip(job.evaluation_seeds, record.played(job, mark, domain), strict=True)
    )
    table = Evaluation(scenario.id, scenario.hash, results, _notes(config, rules))
    table.write(directory / "table.json")
    return table


def _policies_before(directory: Path) -> set[Path]:
    """Return the files of policies that an earlier call may have written; all others stay."""
    try:
        earlier = Evaluation.read(directory / "table.json")
    except CheckpointError:  # none yet, or a damaged one, which is about to be replaced
        return set()
    names = dict.fromkeys(result.policy for result in earlier.results)
    return {directory / "policies" / f"{file}.pt" for file in file_names(names)}


def _notes(config: TransferConfig, rules: Mapping[str, str]) -> dict[str, str]:
    """Return further facts of the table; `rules` are the best ones, by name of the domain."""
    if config.rule_budget is None:
        searched = ", ".join(STANDARD_RULES)
    else:
        searched = f"{', '.join(TUNED_RULES)}; each tuned with up to {config.rule_budget} episodes"
    return {
        **{best_rule_note(domain): rule for domain, rule in rules.items()},
        "rules searched": searched,
        "training seed": str(config.seed),
        "learner": config.learner,
        **({} if config.corrected is None else {CORRECTED: config.corrected}),
    }


def _check(config: TransferConfig, scenario: Scenario, env: TrafficEnv, reporter: Reporter) -> None:
    """Raise an error if a job of the run could not be performed.

    Args:
        config: Options of the run.
        scenario: The network and its traffic.
        env: The simulation.
        reporter: Receives a note if the real log is from another domain.
    """
    make = config.spec.factory(config.device)
    if is_own(config.learner) and not check_own_learner(make, env, config.seed).savable:
        reporter.say(
            f"note: {config.learner} has no save(path) and load(path): an interrupted training "
            "begins anew with --resume, and no policies are written"
        )
    worlds_of(_grounded_job(config), env, None)  # refuses now what the job would refuse later
    if config.real_log is not None:
        _say_if_from_elsewhere(TransitionLog.read(config.real_log), config, reporter)
    for option in ("corrected", *(["real"] if config.fine_tuned or config.oracle else [])):
        if (domain := getattr(config, option)) is not None:
            _require_same_agents(config, scenario, env, option, domain)
    for domain in config.further:
        _require_same_agents(config, scenario, env, "further", domain)


def _say_if_from_elsewhere(log: TransitionLog, config: TransferConfig, reporter: Reporter) -> None:
    recorded = log.provenance.domain
    if config.real != "none" and recorded != config.real:
        reporter.say(
            f"note: the real log was recorded in {recorded!r}, the policies are judged in "
            f"{config.real!r}"
        )


def _require_same_agents(
    config: TransferConfig, scenario: Scenario, sim: TrafficEnv, option: str, domain: str
) -> None:
    """Raise an error if policies trained in a domain would not fit the simulation's agents."""
    with contextlib.closing(parallel_env(scenario, domain, **config.env_options)) as env:
        if AgentSet.of(env) != AgentSet.of(sim):
            raise ScenarioError(
                f"{option} = {domain!r} has other agents, observations or phases than "
                f"scenario {scenario.id!r}: {AgentSet.of(env)}, not {AgentSet.of(sim)}; take a "
                "corrected scenario of this one"
            )


def _identity(config: TransferConfig, scenario: Scenario, env: TrafficEnv) -> dict[str, Any]:
    """Return everything that must be the same when a run is resumed."""
    settings = config.as_dict()
    for other in ("evaluation_seeds", "tuning_seeds", "rule_budget", "device", "corrected", *ADDED):
        settings.pop(other)
    log = config.real_log  # identified by its content, so the file may be moved
    settings["real_log"] = file_hash(log) if log else None
    hashes = {"sim": env.scenario.hash}
    if config.real != "none":
        real = scenario_in_domain(scenario, config.real, duration_s=config.duration_s)
        hashes["real"] = real.hash
    return {
        **settings,
        "scenario_hash": hashes,
        "domains": config.domains,
        "versions": installed_versions("eclipse-sumo", "torch"),
    }
