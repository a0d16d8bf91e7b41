"""Trainings that belong together: those that differ in seed and domain, and the jobs of a table."""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ugat_marl.errors import counted
from ugat_marl.experiments import (
    CORRECTED,
    DIRECT,
    RULE,
    Comparison,
    Trial,
    is_grounded,
    rule_policy,
)
from ugat_marl.reporting.comparison_tables import seeds_note
from ugat_marl.reporting.formats import flat_settings
from ugat_marl.reporting.run_records import RunRecord

_APART = (
    "seed", "real", "tuning_seeds", "rule_budget", "control",
    "further", "corrected", "randomised", "random_delay_s", "fine_tuned", "oracle",
    "scenario_hash", "domains",
)  # fmt: skip
"""Settings in which trainings of one group may differ, since they do not change UGAT itself."""
_NAMED = {CORRECTED: ("corrected",), RULE: ("rule_budget", "tuning_seeds")}
"""Rows whose policies depend on settings in which trainings of one group may differ."""
_SIMULATING = ("ugat-marl", "eclipse-sumo", "libsumo")
"""Packages whose versions decide how vehicles move."""


@dataclass(frozen=True)
class Group:
    """Trainings that are compared with intervals over their seeds.

    Attributes:
        title: Scenario and settings that all of them share.
        rows: Rows as returned by `Comparison.rows`.
        note: Number of seeds and kind of intervals, in a sentence.
        left_out: Name of each training that is not compared, to the reason.
    """

    title: str
    rows: Sequence[Mapping[str, Any]]
    note: str
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])


def groups(records: Sequence[RunRecord]) -> list[Group]:
    """Return all groups with more than one training."""
    with_several: list[Group] = []
    for members in _parted(records, _common).values():
        trials, left_out = _trials(members)
        if len(members) < 2 or not trials:
            continue
        first = members[0]
        trials, apart = _of_shared_episodes(trials)
        trials.sort(key=lambda trial: _rank(trial.setting))
        comparison = Comparison(first.scenario, "", first.sim, tuple(trials), {})
        title = f"{first.scenario}, trained in {first.sim}"
        title += "" if first.job else f", {first.grounding or 'unknown'} grounding"
        note = f"{seeds_note(comparison)}{apart}"
        with_several.append(Group(title, comparison.rows(), note, left_out))
    return with_several


def _of_shared_episodes(trials: list[Trial]) -> tuple[list[Trial], str]:
    """Return the episodes that all policies played, and a sentence on the others."""
    played: dict[tuple[Any, ...], set[int]] = {}
    for trial in trials:
        policy = trial.setting, trial.target, trial.domain, trial.training_seed
        played.setdefault(policy, set()).add(trial.seed)
    shared, every = set.intersection(*played.values()), set.union(*played.values())
    if shared == every:
        return trials, ""
    if not shared:
        return trials, " Policies were judged on different episodes."
    kept = [trial for trial in trials if trial.seed in shared]
    others = counted(len(every - shared), "evaluation seed")
    return kept, f" Left out: {others} on which some policies were not judged."


def seeds_of_one(records: Sequence[RunRecord]) -> list[list[RunRecord]]:
    """Return lists of trainings that differ in their seed alone; one curve shows each list.

    Of trainings that have one seed the newest is kept.
    """

    def alike(record: RunRecord) -> tuple[Any, ...]:
        trained = json.dumps(_trained(record), sort_keys=True)
        real = record.real, record.hashes.get("real")
        return (*_common(record), *real, _ugat(record), record.setting, trained)

    return [_one_of_a_seed(members) for members in _parted(records, alike).values()]


def _one_of_a_seed(records: Sequence[RunRecord]) -> list[RunRecord]:
    newest: dict[str, int] = {}
    for index, record in _newest_first(records):
        newest.setdefault(record.seed or record.name, index)
    return [records[index] for index in sorted(newest.values())]


def _newest_first(records: Sequence[RunRecord]) -> list[tuple[int, RunRecord]]:
    """Return the trainings with their indices; those of unknown age come last."""

    def age(pair: tuple[int, RunRecord]) -> float:
        written = pair[1].written
        return math.inf if math.isnan(written) else -written

    return sorted(enumerate(records), key=age)


def _common(record: RunRecord) -> tuple[Any, ...]:
    if record.job:
        return True, record.scenario, record.sim
    settings = {k: v for k, v in record.settings.items() if k not in _APART}
    # of a run without a hash nobody knows with which other it shares its simulation
    world = record.hashes.get("sim", record.name)
    settings["world"] = world, *map(record.versions.get, _SIMULATING)
    return False, record.scenario, record.sim, json.dumps(settings, sort_keys=True, default=str)


def _ugat(record: RunRecord) -> str:
    return json.dumps(record.ugat, sort_keys=True, default=str)


def _parted(
    records: Iterable[RunRecord], key: Callable[[RunRecord], Hashable]
) -> dict[Hashable, list[RunRecord]]:
    parts: dict[Hashable, list[RunRecord]] = {}
    for record in records:
        parts.setdefault(key(record), []).append(record)
    return parts


def _trials(records: Sequence[RunRecord]) -> tuple[list[Trial], dict[str, str]]:
    """Return trials that were scored in both domains; and why other records have none, by name."""
    names, told, targets = job_labels(records), _told(records), _targets(records)
    known: dict[tuple[Any, ...], int] = {}
    trials: list[list[Trial]] = [[] for _ in records]
    left_out: dict[str, str] = {}
    for index, record in _newest_first(records):
        found = _of_run(record, told, targets[index])
        if record.job:
            found = _of_job(record, names[index])
        of_record = list(found)
        training = record.seed or record.name
        trials[index] = [
            trial
            for trial in of_record
            # an older training of the same seed says nothing about chance
            if known.setdefault((*_episode(trial), training), index) == index
        ]
        if not trials[index]:
            left_out[record.name] = _reason_without_trials(record, older=bool(of_record))
    return list(itertools.chain(*trials)), left_out


def _reason_without_trials(record: RunRecord, *, older: bool) -> str:
    if older:
        return "an older training of the same seed"
    if record.job and record.settings.get("target") == record.sim:
        return f"made for {record.sim} alone"
    return "not judged in both domains"


def _episode(trial: Trial) -> tuple[str, str, str, int]:
    return trial.setting, trial.target, trial.domain, trial.seed


def _told(records: Sequence[RunRecord]) -> Mapping[str, list[str]]:
    """Return the settings of `_NAMED` in which runs differ, by the row that depends on them."""

    def values(row: str, key: str) -> set[str]:
        return {
            str(record.settings.get(key))
            for record in records
            # every run has a best rule, and only some have a corrected simulation
            if row == RULE or record.settings.get(key)
        }

    return {row: [key for key in keys if len(values(row, key)) > 1] for row, keys in _NAMED.items()}


def _targets(records: Sequence[RunRecord]) -> list[str]:
    """Return the real domain of each run, with the start of its hash where runs differ in it."""
    hashes: dict[str, set[str]] = {}
    for record in records:
        hashes.setdefault(record.real, set()).add(record.hashes.get("real", "unknown"))
    return [
        record.real
        if len(hashes[record.real]) == 1
        else f"{record.real} ({record.hashes.get('real', 'unknown')[:10]})"
        for record in records
    ]


def _of_run(record: RunRecord, told: Mapping[str, list[str]], target: str) -> Iterable[Trial]:
    evaluation = record.evaluation
    if evaluation is None or len(evaluation.domains) != 2:
        return
    real = evaluation.domains[1]
    rule = evaluation.best_rule_policy(real)
    for r in evaluation.results:
        if r.policy.startswith(rule_policy("")) and r.policy != rule:
            continue
        setting = RULE if r.policy == rule else r.policy
        if keys := told.get(setting):
            values = [f"{key} {record.settings.get(key) or 'as usual'}" for key in keys]
            setting += f" ({', '.join(values)})"
        domain = record.sim if r.domain == evaluation.domains[0] else target
        yield Trial(setting, target, domain, _seed(record), r.seed, r.scores)


def _of_job(record: RunRecord, name: str) -> Iterable[Trial]:
    evaluation = record.evaluation
    if evaluation is None or record.sim not in evaluation.domains:
        return
    only = record.settings.get("target")
    for target in evaluation.domains:
        if target == record.sim or (only is not None and target != only):
            continue
        for r in evaluation.results:
            if r.domain in (record.sim, target):
                yield Trial(name, target, r.domain, _seed(record), r.seed, r.scores)


def _rank(setting: str) -> int:
    """Return the place of a setting: direct transfer, groundings, other settings, rules."""
    if setting.startswith(DIRECT):
        return 0
    if setting.startswith(RULE):
        return 3
    return 1 if is_grounded(setting) else 2


def _seed(record: RunRecord) -> int | None:
    try:
        return int(record.seed)
    except ValueError:
        return None


_OF_A_JOB = (
    "episodes", "rule_budget", "negative_control", "real_log", "world", "commands", "most_delay_s",
)  # fmt: skip
"""Settings of a job, beside those of learner and environment, that part trainings."""


def job_labels(records: Sequence[RunRecord]) -> list[str]:
    """Return names of jobs; equal names get the settings in which the jobs differ."""
    flat = [dict(flat_settings(record.ugat)) | _trained(record) for record in records]
    names = [record.setting for record in records]
    labels: list[str] = []
    for record, name, settings in zip(records, names, flat, strict=True):
        others = [each for each, other in zip(flat, names, strict=True) if other == name]
        varied = [
            key for key, value in settings.items() if any(o.get(key) != value for o in others)
        ]
        usual = {key: Counter(o.get(key) for o in others).most_common(1)[0][0] for key in varied}
        unusual = [f"{key} {settings[key]}" for key in varied if settings[key] != usual[key]]
        labels.append(f"{name} ({', '.join(unusual)})" if record.job and unusual else name)
    # Jobs that still have one name differ in a version or a file, which only the digest tells
    same = Counter(map(_identity, records, labels))
    pairs = zip(records, labels, strict=True)
    return [
        f"{label} ({record.name[-10:]})" if record.job and same[_identity(record, label)] > 1
        else label
        for record, label in pairs
    ]  # fmt: skip


def _identity(record: RunRecord, label: str) -> tuple[str, str, str]:
    return label, record.seed, str(record.settings.get("target"))


def _trained(record: RunRecord) -> dict[str, str]:
    """Return learner, episodes and options of a job; nothing for a run, whose key has them."""
    if not record.job:
        return {}
    learner = record.settings.get("learner")
    options = record.settings.get("options")
    told = {key: str(record.settings.get(key, "")) for key in _OF_A_JOB}
    if "sim" in record.hashes:  # that of the real domain differs between domains
        told["sim files"] = record.hashes["sim"][:10]
    if isinstance(learner, Mapping):
        own = learner.get("settings")
        told["learner"] = " ".join(map(str, [learner.get("name"), *(own or ())]))
        told |= dict(flat_settings({"dqn": learner.get("dqn") or {}}))
    if isinstance(options, Mapping):
        told |= dict(flat_settings(options, "options."))
    return told
