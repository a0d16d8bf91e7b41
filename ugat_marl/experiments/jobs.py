"""Jobs: one setting, trained with one seed and judged in its domains, in a folder of its own.

``python -m ugat_marl.experiments.jobs FOLDER`` performs the job of ``FOLDER/job.json``. It ends
when its standard input is closed, so no training outlives the command that started it. An
interrupted job resumes at its last checkpoint.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
import sys
from collections.abc import Generator, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from rich.console import Console

from ugat_marl.data import (
    LogCallback,
    Run,
    Scores,
    TransitionLog,
    installed_versions,
    json_damage,
    remove_temporaries,
    with_hashes,
)
from ugat_marl.effects import domain_path, load_scenario, scenario_in_domain
from ugat_marl.envs import AnyParallelEnv, TrafficEnv, parallel_env
from ugat_marl.errors import CheckpointError, OptionError, UgatMarlError
from ugat_marl.experiments.evaluation import (
    TUNING_SEED,
    FixedPolicy,
    best_rule,
    evaluation_of,
    rule_factory,
)
from ugat_marl.experiments.queues import QUEUES, QueueRecord
from ugat_marl.experiments.randomised import randomised_env
from ugat_marl.experiments.row_names import DIRECT, short_name
from ugat_marl.experiments.settings import CHANGE_COST, Setting
from ugat_marl.experiments.training import (
    TrainingCost,
    simulated_worlds,
    train_grounded,
    train_through,
)
from ugat_marl.experiments.tuning import VERSION, tuned_rule
from ugat_marl.files import MALFORMED, file_hash, parse_json, read_json, write_whole
from ugat_marl.grounding import (
    ChangePenalty,
    LaneView,
    Probe,
    RandomDelays,
    RecordedWorld,
    SimulatedWorld,
    TransitionSource,
    is_kept,
    require_histories,
    require_room,
)
from ugat_marl.parallel import Workers, in_this_process, send_heartbeats
from ugat_marl.policies import (
    STANDARD_RULES,
    TUNED_RULES,
    Policy,
    PolicyFactory,
    attended,
    has_first_lessons,
)
from ugat_marl.progress import Bars, Reporter
from ugat_marl.scenarios import Scenario
from ugat_marl.simulation import exit_when_input_ends, kept_warm

JOB, SCORES, POLICY, DIRECT_POLICY, LEARNER, RULE_FILE = (
    "job.json", "scores.json", "policy.pt", "direct-policy.pt", "learner.pt", "rule.txt",
)  # fmt: skip

_MOST_NAME_BYTES = 200
"""Most bytes of a name made of domains; file systems take 255, and many effects are more."""

EVALUATION_SEED = 1000
"""First seed of the reported episodes; training and the search for rules use other seeds."""


def evaluation_seeds(count: int) -> tuple[int, ...]:
    """Return the seeds of the reported episodes."""
    return tuple(range(EVALUATION_SEED, EVALUATION_SEED + count))


@dataclass(frozen=True)
class Job:
    """A setting with a scenario, a training seed and evaluation episodes.

    Attributes:
        setting: Recipe of the policy, and its name.
        scenario: Scenario as a user names it.
        sim: The simulation.
        target: The real domain, if the policy depends on it.
        seed: Seed of the training; None for a rule, which is not trained.
        episodes: Training episodes in all, those of `start` included; 0 for a rule.
        start: File of the learner to continue from, relative to the folder that holds the jobs'
            folders; None for a fresh learner.
        start_episodes: Training episodes of the learner at `start`; not part of `identity`.
        every: Episodes from one evaluation to the next; 0 for evaluations at the end only.
        last: Number of episodes at the end that are each followed by an evaluation.
        options: Options of the environments.
        real_log: File of a transition log that replaces the roll-outs in the real domain, for
            recipe "grounded"; None to simulate them.
        probe_domains: Domains in which a grounded policy is measured after every iteration, only
            for the metrics; not part of `identity`.
        rule_budget: Most episodes to tune one rule, for recipe "rule"; None for the usual settings
            of `STANDARD_RULES`.
        tuning_seeds: Number of seeds on which the best rule is chosen.
        domains: Domains of the evaluation; not part of `identity`.
        evaluation_seeds: Seeds of each evaluation's episodes; not part of `identity`.
        device: Device of the training; not part of `identity`, because results of all devices
            agree within tolerance.
    """

    setting: Setting
    scenario: str
    sim: str = "sim"
    target: str | None = None
    seed: int | None = None
    episodes: int = 0
    start: str | None = None
    start_episodes: int = 0
    every: int = 0
    last: int = 1
    options: Mapping[str, str | int | float | None] = field(default_factory=dict)
    real_log: str | None = None
    probe_domains: tuple[str, ...] = ()
    rule_budget: int | None = None
    tuning_seeds: int = 2
    domains: tuple[str, ...] = ()
    evaluation_seeds: tuple[int, ...] = ()
    device: str = "cpu"

    def __post_init__(self) -> None:
        # A default of settings (`UsualValue`) is no key of the scores that files hold.
        for name in ("episodes", "start_episodes"):
            object.__setattr__(self, name, int(getattr(self, name)))

    @property
    def rows(self) -> dict[int, str]:
        """Names of the job's rows in a table, by number of training episodes.

        A grounded training without `start` begins with plain training, so it gives direct transfer
        as well.
        """
        names = {self.episodes: self.setting.name}
        if self.setting.ugat is not None and self.start is None:
            names |= {int(self.setting.ugat.pretrain_episodes): DIRECT}
        return dict(sorted(names.items()))

    @property
    def own_episodes(self) -> int:
        """Number of training episodes that the job plays itself."""
        return self.episodes - self.start_episodes

    @property
    def marks(self) -> tuple[int, ...]:
        """Numbers of training episodes after which the policy is judged, ascending."""
        late = range(max(1, self.episodes - self.last + 1), self.episodes)
        often = range(self.every, self.episodes, self.every) if self.every else ()
        return tuple(sorted({*often, *late, *self.rows}))

    @property
    def identity(self) -> dict[str, Any]:
        """Everything that decides the policy. Jobs of equal identity are the same job.

        With `every`, the number of episodes is left out: a longer job continues a shorter one.

        Raises:
            OptionError: The learner's library is not installed.
        """
        worlds = sorted({w for w in (self.sim, self.target, self.setting.world) if w})
        parts: dict[str, Any] = {
            "setting": self.setting.identity,
            "seed": self.seed,
            "start": self.start,
            "every": self.every,
            "options": dict(self.options),
            "worlds": {world: _hash(self.scenario, world, self.duration_s) for world in worlds},
            "versions": installed_versions("eclipse-sumo", "torch"),
        }
        if self.setting.recipe == "rule":
            parts |= {"target": self.target, "tuning": VERSION, "rule_budget": self.rule_budget}
            return {**parts, "tuning_seeds": self.tuning_seeds}
        if self.setting.knows_target:
            parts["target"] = self.target
        if self.real_log is not None:
            parts["real_log"] = file_hash(Path(self.real_log))
        return parts if self.every else {**parts, "episodes": self.episodes}

    @functools.cached_property
    def judged_worlds(self) -> dict[str, str]:
        """Domain of the evaluation to its hash, for scenario directories, which may change."""
        return {
            domain: _hash(self.scenario, domain, self.duration_s)
            for domain in self.domains
            if domain_path(domain) is not None
        }

    @functools.cached_property
    def digest(self) -> str:
        """First ten hexadecimal digits of the hash of `identity`."""
        text = json.dumps(self.identity, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:10]

    @functools.cached_property
    def name(self) -> str:
        """Name of the job's folder: scenario, learner, kind, domains, seed and digest."""
        setting = self.setting
        learner = "" if setting.recipe == "rule" else setting.learner.name
        place = (
            file_stem(self.scenario),
            learner,
            setting.kind,
            setting.world or "",
            self.target or "",
        )
        words = (re.sub(r"[^\w=+.]+", "-", part).strip("-.") for part in place)
        named = _cut("-".join(word for word in words if word)).rstrip("-.")
        return "-".join(filter(None, (named, self._seed_word, self.digest)))

    @property
    def short(self) -> str:
        """Name for a progress bar."""
        return " ".join(filter(None, (self.setting.name, self.target, self._seed_word)))

    @property
    def after(self) -> str | None:
        """Name of the job that must be done before this one; None if there is none."""
        return None if self.start is None else Path(self.start).parts[0]

    @property
    def duration_s(self) -> float | None:
        """Length of an episode in s; None for the scenario's own."""
        duration_s = self.options.get("duration_s")
        return None if duration_s is None else float(duration_s)

    def loaded(self) -> Scenario:
        """Load the scenario, for episodes of the job's length."""
        return load_scenario(self.scenario, self.duration_s)

    @property
    def _seed_word(self) -> str:
        return "" if self.seed is None else f"s{self.seed}"

    @classmethod
    def read(cls, folder: Path) -> Job:
        """Read ``job.json``.

        Raises:
            CheckpointError: The file is missing, damaged, or of another form.
        """
        path = folder / JOB
        try:
            return TypeAdapter(cls).validate_json(json.dumps(read_json(path, CheckpointError)))
        except ValidationError as error:
            told = error.errors()[0]["msg"]
            raise CheckpointError(f"{path}: not the description of a training ({told})") from None

    def write(self, folder: Path) -> None:
        """Write ``job.json`` atomically."""
        write_whole(folder / JOB, json.dumps(asdict(self), indent=1) + "\n")


def file_stem(scenario: str) -> str:
    """Return the name of a scenario in the form of a file's name."""
    name = Path(scenario).name
    if name in ("", ".."):  # of ".", "..": the folder itself has a name
        name = Path(scenario).resolve().name
    return re.sub(r"[^\w.+-]+", "-", name.removesuffix(".sumocfg")).strip("-")


def file_name(name: str) -> str:
    """Return the name of a policy in the form of a file's name."""
    return _cut(re.sub(r"[^a-z0-9.]+", "-", short_name(name).lower())).strip("-")


def _cut(name: str) -> str:
    """Return the start of a name that file systems take, with room for a digest and an ending."""
    return name.encode()[:_MOST_NAME_BYTES].decode(errors="ignore")


def shortened(name: str) -> str:
    """Return a name that file systems take; a digest tells those apart that are cut."""
    cut = _cut(name)
    return name if cut == name else f"{cut}-{hashlib.sha256(name.encode()).hexdigest()[:10]}"


def file_names(names: Iterable[str]) -> list[str]:
    """Return names of files for policies, all different: repeated names end in -2, -3 and so on."""
    files: list[str] = []
    for name in names:
        stem = file_name(name)
        candidates = [stem, *(f"{stem}-{k}" for k in range(2, len(files) + 2))]
        files.append(next(file for file in candidates if file not in files))
    return files


def _hash(scenario: str, domain: str, duration_s: float | None) -> str:
    """Return the hash of a scenario in a domain; the files are read each time, for they change."""
    loaded = load_scenario(scenario, duration_s)
    if domain_path(domain) is not None:
        return scenario_in_domain(loaded, domain, duration_s=duration_s).hash
    key = (loaded.hash, domain, duration_s)
    if key not in _HASHES:
        _HASHES[key] = scenario_in_domain(loaded, domain, duration_s=duration_s).hash
    return _HASHES[key]


_HASHES: dict[tuple[str, str, float | None], str] = {}
"""Hashes in domains, by hash of the scenario: effects take longer than reading."""


@dataclass
class JobRecord:
    """Result of a job: the scores of its evaluation episodes, and the cost of its training.

    Attributes:
        scores: Scores by number of training episodes, domain and seed.
        episodes: Number of training episodes that `seconds` and `own_seconds` cover.
        seconds: Time of training without evaluations, in s.
        own_seconds: Processor time of the learner's process during training, in s.
        worlds: Domain to the hash of the world that was played there, for scenario directories.
    """

    scores: dict[tuple[int, str, int], Scores] = field(default_factory=dict)
    episodes: int = 0
    seconds: float = 0.0
    own_seconds: float = 0.0
    worlds: dict[str, str] = field(default_factory=dict[str, str])

    @classmethod
    def read(cls, folder: Path) -> JobRecord:
        """Read a record that `write` wrote; an empty record if the file is missing or damaged.

        Raises:
            OSError: The file is there, and the system cannot read it now. An empty record would
                replace it.
        """
        path = folder / SCORES
        if not path.exists():
            return cls()
        data = path.read_bytes()
        try:
            content = parse_json(data.decode(), str(path), CheckpointError)
            if json_damage(content, "episodes"):
                return cls()
            scores: dict[tuple[int, str, int], Scores] = {}
            for row in content["episodes"]:
                key = int(row.pop("trained")), str(row.pop("domain")), int(row.pop("seed"))
                row["approaches"] = {k: tuple(v) for k, v in row.get("approaches", {}).items()}
                scores[key] = Scores(**row)
            return cls(scores, **content["training"], worlds=dict(content.get("worlds", {})))
        except (CheckpointError, *MALFORMED):
            return cls()

    def write(self, folder: Path) -> None:
        """Write the record atomically."""
        rows = [
            {"trained": trained, "domain": domain, "seed": seed, **asdict(scores)}
            for (trained, domain, seed), scores in self.scores.items()
        ]
        training = {name: getattr(self, name) for name in ("episodes", "seconds", "own_seconds")}
        worlds = {"worlds": self.worlds} if self.worlds else {}
        hashed = with_hashes({"training": training, **worlds, "episodes": rows}, "episodes")
        content = json.dumps(hashed, indent=1)
        write_whole(folder / SCORES, content + "\n")

    def add(self, effort: TrainingCost) -> None:
        """Add the cost of some training episodes."""
        self.episodes += effort.episodes
        self.seconds += effort.seconds
        self.own_seconds += effort.own_seconds

    def missing(self, job: Job, mark: int) -> dict[str, list[int]]:
        """Return the seeds not yet played after `mark` training episodes, by domain.

        What was played in a scenario directory that has changed since counts as not played.
        """
        seeds = {
            domain: [
                s
                for s in job.evaluation_seeds
                if (mark, domain, s) not in self.scores or self.is_other(job, domain)
            ]
            for domain in job.domains
        }
        return {domain: left for domain, left in seeds.items() if left}

    def is_other(self, job: Job, domain: str) -> bool:
        """Return True if the scores of a domain are of another world of that name."""
        now = job.judged_worlds.get(domain)
        return now is not None and self.worlds.get(domain, now) != now

    def add_scores(self, job: Job, mark: int, domain: str, scores: Mapping[int, Scores]) -> None:
        """Add the scores of episodes by seed; those of another world of that name are dropped."""
        if self.is_other(job, domain):
            self.scores = {key: held for key, held in self.scores.items() if key[1] != domain}
        if (now := job.judged_worlds.get(domain)) is not None:
            self.worlds[domain] = now
        self.scores |= {(mark, domain, seed): held for seed, held in scores.items()}

    def is_whole(self, job: Job) -> bool:
        """Return True if nothing of the job is missing."""
        return not any(self.missing(job, mark) for mark in job.marks)

    def played(self, job: Job, mark: int, domain: str) -> list[Scores]:
        """Return the scores of an evaluation, one per seed, in the order of the job's seeds."""
        return [self.scores[mark, domain, seed] for seed in job.evaluation_seeds]


@kept_warm()
def perform(
    job: Job,
    folder: Path,
    reporter: Reporter,
    workers: Workers = 1,
    on_log: LogCallback | None = None,
) -> JobRecord:
    """Do the missing training and evaluations of a job, and write them to its folder.

    Args:
        job: The job.
        folder: Folder of the job.
        reporter: Shows progress.
        workers: Simulations at a time, or an executor, for roll-outs and the search for rules.
            Learning stays in this process, and evaluations on this machine.
        on_log: Called with the numbers that a job of recipe "grounded" logs.

    Raises:
        OptionError: An evaluation is missing, and the training has already passed it.
    """
    remove_temporaries(folder)
    record = JobRecord.read(folder)
    if record.is_whole(job):
        return record
    if job.setting.recipe == "rule":
        factory = rule_factory(_rule(job, folder, reporter, workers))
        _judge(job, 0, factory, record, folder, reporter, workers)
        return record
    if job.setting.ugat is not None:
        trained = _grounded(job, folder, reporter, workers, on_log)
    else:
        trained = _plain(job, folder, record, reporter)
    with contextlib.closing(trained) as policies:
        for mark, policy in policies:
            _judge(job, mark, FixedPolicy(policy), record, folder, reporter, workers)
    return record


def _judge(
    job: Job,
    mark: int,
    factory: PolicyFactory,
    record: JobRecord,
    folder: Path,
    reporter: Reporter,
    workers: Workers,
) -> None:
    """Play the missing episodes after `mark` training episodes; write them domain by domain."""
    scenario = job.loaded()
    name = job.rows.get(mark, job.setting.name)
    for domain, seeds in record.missing(job, mark).items():
        queues = QueueRecord()
        played = evaluation_of(
            scenario,
            {name: factory},
            [domain],
            seeds,
            duration_s=job.duration_s,
            workers=workers if in_this_process(workers) else None,  # queues are watched here
            reporter=reporter,
            title=f"evaluating {name} in {domain}",
            watch=queues.watch,
            approaches=True,
        )
        # The queues come before the record, which marks these episodes as played. If a process dies
        # between the two, the same episodes are played again; their first seed is their number.
        if mark in job.rows:
            # Without any score, after damage or in another world, earlier batches do not count.
            anew = len(seeds) == len(job.evaluation_seeds)
            queues.write(folder / QUEUES, keep=True, batch=seeds[0], anew=anew)
        record.add_scores(job, mark, domain, {r.seed: r.scores for r in played.results})
        record.write(folder)


def _rule(job: Job, folder: Path, reporter: Reporter, workers: Workers) -> str:
    """Return the rule that is best in the real domain, chosen on separate tuning seeds."""
    saved, rules, target = folder / RULE_FILE, job.setting.rules, job.target or job.sim
    if not saved.exists():
        scenario = job.loaded()
        common: dict[str, Any] = {
            "seeds": [TUNING_SEED + k for k in range(job.tuning_seeds)],
            "duration_s": job.duration_s,
            "workers": workers,
            "reporter": reporter,
        }
        if job.rule_budget is not None:
            names = rules or TUNED_RULES
            best = tuned_rule(scenario, target, job.rule_budget, names=names, **common)
        elif len(rules) == 1:
            (best,) = rules
        else:
            best = best_rule(scenario, target, rules=rules or STANDARD_RULES, **common)
        write_whole(saved, best)
    return saved.read_text()


def _plain(
    job: Job, folder: Path, record: JobRecord, reporter: Reporter
) -> Generator[tuple[int, Policy], None, None]:
    """Train without grounding; yield the policy at each mark with missing episodes and the end."""
    assert job.seed is not None
    make = job.setting.learner.factory(job.device)
    with contextlib.closing(_world(job)) as env:
        learner, progress = make(env, job.seed), folder / LEARNER
        before = _start(job, folder)
        if progress.exists():
            learner.load(progress)
        else:
            if before is not None:
                learner.load(before)  # its world may have had another teacher
            taught = before is not None or has_first_lessons(learner)
            if taught and job.setting.lessons:
                attended(learner, env, job.seed, reporter, f"lessons: {job.setting.name}")
        marks = [mark for mark in job.marks if record.missing(job, mark) or mark == job.episodes]
        if marks[0] < learner.episodes:
            raise OptionError(
                f"{folder} was trained past episode {marks[0]} without the evaluation of "
                f"{len(job.evaluation_seeds)} episodes there; remove it, or name another --runs"
            )

        def keep(effort: TrainingCost) -> None:
            record.add(effort)
            if job.every:
                record.write(folder)
            if is_kept(learner):
                learner.save(progress)

        left = max(0, job.episodes - learner.episodes)
        with reporter.task(f"training: {job.setting.name}", left) as advance:
            for mark, policy in train_through(
                learner, env, marks, job.seed, on_episode=lambda *_: advance(), on_chunk=keep
            ):
                _save(policy, folder / POLICY)
                yield mark, policy


def _grounded(
    job: Job, folder: Path, reporter: Reporter, workers: Workers, on_log: LogCallback | None
) -> Generator[tuple[int, Policy], None, None]:
    """Train by UGAT; yield direct transfer, if plain training was part of it, and the policy."""
    ugat, make = job.setting.ugat, job.setting.learner.factory(job.device)
    assert ugat is not None and job.seed is not None
    scenario, options = job.loaded(), dict[str, Any](job.options)
    with (
        contextlib.closing(parallel_env(scenario, job.sim, **options)) as env,
        contextlib.closing(Run(folder, job.identity, reporter, on_log)) as run,
    ):
        state = train_grounded(
            ugat,
            make,
            env,
            worlds_of(job, env, workers),
            job.seed,
            run,
            start=_start(job, folder),
            negative_control=job.setting.negative_control,
            probe=_probe(job, workers),
            device=job.device,
            workers=workers,
        )
    assert state.direct is not None  # plain training comes first
    policies = {int(ugat.pretrain_episodes): state.direct, job.episodes: state.policy()}
    for mark in job.rows:
        _save(policies[mark], folder / (POLICY if mark == job.episodes else DIRECT_POLICY))
        yield mark, policies[mark]


def worlds_of(
    job: Job, env: TrafficEnv, workers: Workers
) -> tuple[SimulatedWorld, TransitionSource]:
    """Return the sources of D_sim and D_real of a grounded job.

    Args:
        job: A job of recipe "grounded".
        env: The simulation, with the agents that a log must fit.
        workers: Simulations at a time, or an executor, see `SimulatedWorld`.

    Raises:
        LogError: The job's log does not fit the simulation.
        OptionError: The two domains cannot be compared, see `simulated_worlds`, or the observation
            shows no vehicles, from which a street is fitted.
    """
    ugat, recorded = job.setting.ugat, None
    assert ugat is not None
    street = ugat.grounding == "street"
    if street:
        LaneView.of(env.network, str(env.options.observation))
    if job.real_log is not None:
        log = TransitionLog.read(Path(job.real_log))
        if street:
            require_histories(log, ugat.street.longest_lag)  # before plain training
        fits_models = not street or ugat.street.residual.kind != "none"
        inputs = ugat.inputs if fits_models else None
        recorded = RecordedWorld(log, env, ugat.fit.held_out_every, inputs)
        if street:
            replay = recorded.replay()  # a log that begins too late is refused now
            if ugat.street.of_log(log).simulates:
                require_room(replay, recorded.longest)
    without_street = recorded is not None or job.setting.negative_control == "same-world"
    target = job.sim if without_street else job.target
    assert target is not None
    scenario, options = job.loaded(), dict[str, Any](job.options)
    sim, real = simulated_worlds(scenario, job.sim, target, ugat, options, workers)
    return sim, recorded or real


def _probe(job: Job, workers: Workers) -> Probe | None:
    """Return the measurement after every iteration, on a seed that no result is reported on."""
    if not job.probe_domains:
        return None
    scenario = job.loaded()

    def probe(policy: Policy) -> dict[str, float]:
        played = evaluation_of(
            scenario,
            {"policy": FixedPolicy(policy)},
            job.probe_domains,
            [TUNING_SEED],
            duration_s=job.duration_s,
            workers=workers if in_this_process(workers) else None,
        )
        return {f"att_s/{d}": played.estimate("policy", d, "att_s").mean for d in played.domains}

    return probe


def _start(job: Job, folder: Path) -> Path | None:
    return None if job.start is None else folder.parent / job.start


def _save(policy: Any, path: Path) -> None:
    """Save a policy if it has a method `save` and can be restored."""
    if hasattr(policy, "save") and is_kept(policy):
        policy.save(path)


def _world(job: Job) -> AnyParallelEnv:
    """Return the environment of plain training."""
    setting, options = job.setting, dict[str, Any](job.options)
    if setting.commands:
        options["commands"] = setting.commands
    scenario = job.loaded()
    if setting.recipe == "randomised":
        return randomised_env(scenario, options, job.sim)
    env = parallel_env(scenario, setting.world or job.target or job.sim, **options)
    if setting.recipe == "delays":
        return RandomDelays(env, setting.most_delay_s)
    return ChangePenalty(env, CHANGE_COST) if setting.recipe == "penalty" else env


def perform_described(folder: Path) -> int:
    """Perform the job that a folder describes; return the exit code and print what went wrong."""
    try:
        perform(Job.read(folder), folder, Bars(Console(width=100)))
    except (UgatMarlError, OSError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    exit_when_input_ends()
    send_heartbeats(lambda: os.utime(sys.stdout.fileno()))  # its starter looks at the log's time
    sys.exit(perform_described(Path(sys.argv[1])))
