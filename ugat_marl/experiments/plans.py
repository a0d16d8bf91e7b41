"""Plan of a run in words, and its expected work for the overall bar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ugat_marl.errors import counted, listed
from ugat_marl.experiments.driver import OTHER_PARTS, record_of
from ugat_marl.experiments.forked import jobs_fork_on
from ugat_marl.experiments.jobs import Job, JobRecord
from ugat_marl.grounding import ROLL_OUTS, UgatConfig, episodes_under_delays
from ugat_marl.parallel import Workers, in_this_process, parts_at_a_time
from ugat_marl.policies import (
    STANDARD_RULES,
    TUNED_RULES,
    is_own,
    lesson_episodes,
    race_fields,
    rule_settings,
)
from ugat_marl.progress import Share

EPOCH = 0.05
"""Rough cost of an epoch of the fits of f and h, in episodes."""

WORTH = 50
"""Least work of other parts, in episodes of an evaluation, that is worth a new interpreter."""

COSTS = {
    "plain sim": 3.0, "training": 3.0, "grounded": 3.0, "fitted street": 3.0, "late greens": 3.0,
    "roll-outs": 2.0, "under delays": 2.0,
    "fitting": 1.5, "rules": 1.5, "comparing": 1.5, "lessons": 1.5,
}  # fmt: skip
"""Rough cost of an episode of each task, in episodes of an evaluation.

Training also updates networks, roll-outs are recorded, and worlds of a fitted street are slower.
Measured with `single-v1`, `arterial1x5-v1` and a drawn network of four lights.
"""


def jobs_beside(plan: Sequence[Job], folder: Path, episode_s: float, workers: Workers) -> list[Job]:
    """Return the unfinished jobs that are performed beside the first one.

    Each has one core, so a job that is longer than the first one is not among them. There is none
    if the first job is finished, if one core is used, if an executor does the work elsewhere, or if
    the others are too little to load torch again for them. A learner of the user's own may exist in
    this process alone.

    Args:
        plan: Jobs of the run.
        folder: Folder that holds the jobs' folders.
        episode_s: Length of an episode, in s.
        workers: Simulations at a time, or an executor.
    """
    if not in_this_process(workers) or parts_at_a_time(workers) == 1:
        return []

    def work(*jobs: Job) -> float:
        return _total(work_of(jobs, folder, episode_s))

    longest = work(plan[0])
    jobs = [
        job
        for job in plan[1:]
        if jobs_fork_on(job.device)
        and not is_own(job.setting.learner.name)
        and 0 < work(job) <= longest
    ]
    return jobs if work(*jobs) >= WORTH else []


def _of_other_settings(plan: Sequence[Job], todo: Sequence[Job], folder: Path) -> list[str]:
    """Return folders of earlier trainings that would be those to do, but for their settings."""
    planned = {job.name for job in plan}
    alike = {job.name.rpartition("-")[0] for job in todo}
    names = [path.name for path in folder.glob("*") if path.is_dir()]
    return sorted(x for x in names if x.rpartition("-")[0] in alike and x not in planned)


def described_plan(
    plan: Sequence[Job],
    directory: Path,
    folder: Path,
    episode_s: float,
    beside: Sequence[Job] = (),
) -> list[str]:
    """Return the folder and the plan of a run, as lines.

    Args:
        plan: Jobs of the run.
        directory: Folder of the run.
        folder: Folder that holds the jobs' folders.
        episode_s: Length of an episode, in s.
        beside: Jobs of the plan that are performed beside the others.
    """
    todo = [job for job in plan if record_of(job, folder) is None]
    lines = [f"run: {directory}"]
    if len(todo) < len(plan):
        lines.append(f"done before: {len(plan) - len(todo)} of {len(plan)} parts")
    if others := _of_other_settings(plan, todo, folder):
        lines.append(
            f"note: {listed(others, 'training')} here is of other settings, another version or "
            "another file of the learner; it is not used"
        )
    for number, job in enumerate(todo, 1):
        setting, evaluated = job.setting, len(job.domains) * len(job.evaluation_seeds)
        if setting.recipe == "rule":
            does = f"search for the best rule in {job.target or job.sim}"
        elif setting.ugat is not None:
            times = setting.ugat.iterations
            does = (
                f"{setting.name}: {counted(setting.ugat.pretrain_episodes, 'episode')} in "
                f"{job.sim}, then {counted(times, 'iteration')} of "
                f"{setting.ugat.grounded_episodes} "
                f"for {job.target or 'the street of the log'}"
            )
        else:
            does = f"{setting.name}: {counted(job.own_episodes, 'episode')}"
        meanwhile = ", meanwhile" if job in beside else ""
        lines.append(f"  {number}. {does}; {evaluated * len(job.rows)} to judge it{meanwhile}")
    total = _total(work_of(todo, folder, episode_s))
    lines.append(f"  in all as long as about {total:.0f} episodes of evaluation")
    return lines


def _total(work: Mapping[str, Share]) -> float:
    return sum(share.units * share.weight for share in work.values())


def work_of(
    plan: Sequence[Job], folder: Path, episode_s: float, beside: Sequence[Job] = ()
) -> dict[str, Share]:
    """Return the expected work of the unfinished jobs, by the beginnings of the names of tasks.

    The unit is an episode of an evaluation. Jobs that are half done count as a whole.

    Args:
        plan: Jobs of the run.
        folder: Folder that holds the jobs' folders.
        episode_s: Length of an episode, in s.
        beside: Jobs of the plan that are performed beside the others; their tasks are not shown.
    """
    if beside:
        here = work_of([job for job in plan if job not in beside], folder, episode_s)
        other = _total(work_of(beside, folder, episode_s)) / len(beside)
        return {**here, OTHER_PARTS: Share(len(beside), other)}
    units: dict[str, float] = {}
    weights: dict[str, float] = {}

    def add(name: str, count: float, weight: float = 1.0) -> None:
        units[name] = units.get(name, 0) + count
        weights[name] = weight

    for job in plan:
        record = JobRecord.read(folder / job.name)
        if record.is_whole(job):
            continue
        for mark in job.marks:
            add("evaluating", sum(map(len, record.missing(job, mark).values())))
        if job.setting.recipe == "rule":
            add("tuning" if job.rule_budget else "best rule", _rule_episodes(job))
            continue
        learner = job.setting.learner
        lessons = lesson_episodes(learner.name, learner.dqn)
        if (ugat := job.setting.ugat) is None:
            if lessons and job.setting.lessons:
                add("lessons", lessons)
            add("training", job.own_episodes)
        else:
            budget = ugat.street.budget_of_rules(taught=lessons > 0)
            for name, (count, weight) in _grounded_work(ugat, episode_s, budget).items():
                add(name, count, weight)
            known = ugat.grounding == "street" and bool(budget)
            first = lessons if ugat.pretrain_episodes else 0
            later = lesson_episodes(learner.name, learner.dqn, known=known)
            add("lessons", first + ugat.iterations * later)
            if ugat.grounding == "street":
                add("lessons", len(ugat.street.late_s) * ugat.iterations * lessons)
    return {
        name: Share(round(count), weights[name] * COSTS.get(name, 1.0))
        for name, count in units.items()
    }


def _rule_episodes(job: Job) -> int:
    """Return the number of episodes of the search for the best rule."""
    if job.rule_budget is not None:
        return job.rule_budget * len(job.setting.rules or TUNED_RULES)
    rules = len(job.setting.rules or STANDARD_RULES)
    return sum(race_fields(rules, job.tuning_seeds)) if rules > 1 else 0


def _grounded_work(
    ugat: UgatConfig, episode_s: float, rule_budget: int
) -> dict[str, tuple[float, float]]:
    """Return number and weight of the units of a grounded training's tasks.

    Args:
        ugat: Settings of the training.
        episode_s: Length of an episode, in s.
        rule_budget: Budget of the race of rules in a fitted street; 0 without a race.
    """
    times, street = ugat.iterations, ugat.street
    work: dict[str, tuple[float, float]] = {"plain sim": (ugat.pretrain_episodes, 1.0)}
    if ugat.grounding == "street":
        worlds = street.simulations + max(0, times - 1) * street.further
        short = min(1.0, street.simulated_s / episode_s)
        work["roll-outs"] = (times, ugat.real_rollouts)
        work["fitting"] = (worlds if times else 0, short)
        work["fitted street"] = (times * ugat.grounded_episodes, 1.0)
        candidates = 2 + len(street.late_s) + 2 * bool(rule_budget)  # with lessons, and the rule
        work["comparing"] = (candidates * street.judged * times, 0.5)  # most leave early
        if street.late_s:
            work["under delays"] = (times * ROLL_OUTS, 1.0)
            work["late greens"] = (len(street.late_s) * times * ugat.grounded_episodes, 1.0)
        if rule_budget:
            specs = [spec for name in TUNED_RULES for spec in rule_settings(name, rule_budget)]
            work["rules"] = (times * sum(race_fields(len(specs))), 1.0)
        return work
    rollouts = ugat.sim_rollouts + ugat.real_rollouts
    work["roll-outs"] = (2 * times, rollouts / 2)
    if ugat.matches:
        work["under delays"] = (times * episodes_under_delays(ugat.most_delay_s), 1.0)
    work["fitting"] = (3 * ugat.fit.epochs * times, EPOCH)
    work["grounded"] = (times * ugat.grounded_episodes, 1.0)
    return work
