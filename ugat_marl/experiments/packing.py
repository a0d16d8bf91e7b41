"""Packing of trained policies with their cards, from the folders of their trainings."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from ugat_marl.data import installed_versions
from ugat_marl.effects import domain_label, scenario_in_domain
from ugat_marl.errors import OptionError
from ugat_marl.experiments.jobs import (
    DIRECT_POLICY,
    JOB,
    POLICY,
    Job,
    JobRecord,
    file_name,
    file_stem,
    shortened,
)
from ugat_marl.experiments.row_names import DIRECT
from ugat_marl.experiments.statistics import Interval
from ugat_marl.files import require_writable, write_whole
from ugat_marl.policies import CardScores, NetworkPolicy, PolicyCard, is_own, rule_in
from ugat_marl.progress import Reporter

_LIBRARIES = ("ugat-marl", "eclipse-sumo", "torch", "numpy")


def pack(
    training: Path, folder: Path, command: str = "", reporter: Reporter | None = None
) -> list[PolicyCard]:
    """Copy the policies of finished trainings to a folder, each with its card.

    If one training of a row kept a rule, no policy of that row is copied: the others would look
    better than the row in its table.

    Args:
        training: Folder of a run of ``train``, of the trainings of ``paper``, or of one training.
        folder: Folder to write to: ``SCENARIO/NAME.pt`` and ``SCENARIO/NAME.json``.
        command: Command that trained them, for the cards.
        reporter: Is told of rows that are left out.

    Returns:
        The cards, in the order of their folders.

    Raises:
        OptionError: There is no such folder, no finished training with a policy in it, or the
            folder to write to holds another policy of the same name.
        OutputError: That folder cannot be written to.
        CheckpointError: A file of a training is damaged.
    """
    if not training.is_dir():
        raise OptionError(f"{training}: no such folder; name that of a run or of trainings")
    found: dict[str, tuple[PolicyCard, bytes]] = {}
    rules: dict[str, Path] = {}
    for place in sorted(path.parent for path in training.rglob(JOB)):
        for card, policy in _cards(place, command, rules):
            if card.id in found:
                raise OptionError(
                    f"{training} holds two trainings of {card.id}, with other settings; name the "
                    "folder of one of them"
                )
            found[card.id] = card, policy
    for row, place in rules.items():
        others = [card_id for card_id in found if _row(card_id) == row]
        for card_id in others:
            del found[card_id]
        if others and reporter is not None:
            reporter.say(
                f"note: {row} is left out: {place.name} kept a rule, which needs no file, and the "
                f"policies of the other seeds ({len(others)}) would look better than their row"
            )
    if not found:
        raise OptionError(
            f"{training} holds no finished training with a policy; name the folder of a run of "
            "`ugat-marl train`, or of the trainings of `ugat-marl paper`"
        )
    require_writable(folder / "card.json")
    for name, (_, policy) in found.items():
        there = folder / f"{name}.pt"
        if there.is_file() and there.read_bytes() != policy:
            raise OptionError(
                f"{there}: is the policy of another training, which would be lost; give another "
                "--out, or move it away"
            )
    for name, (card, policy) in found.items():
        write_whole(folder / f"{name}.pt", policy)
        card.write(folder / f"{name}.json")
    return [card for card, _ in found.values()]


def _row(card_id: str) -> str:
    """Return the part of an id that all seeds of a row share."""
    return card_id.rpartition("-s")[0]


def _cards(place: Path, command: str, rules: dict[str, Path]) -> list[tuple[PolicyCard, bytes]]:
    """Return the cards of a training that is finished, and the content of their policies.

    Args:
        place: Folder of the training.
        command: Command that trained.
        rules: Receives the rows in which the training kept a rule.
    """
    job = Job.read(place)
    record = JobRecord.read(place)
    if job.seed is None or not record.is_whole(job):
        return []
    if not place.name.endswith(job.digest):
        raise OptionError(
            f"{place}: it was trained with another version of the scenario, of a file or of a "
            f"library (now it would be called {job.name}); a card would state the wrong ones, so "
            "train again, or pack it with the versions of its training"
        )
    cards: list[tuple[PolicyCard, bytes]] = []
    for mark, setting in job.rows.items():
        file = place / (POLICY if mark == job.episodes else DIRECT_POLICY)
        own = is_own(job.setting.learner.name)  # whose files only its own module reads
        if file.exists() and not own:
            if rule_in(file) is not None:
                rules[_row(_id(job, mark, setting))] = place
                continue
            NetworkPolicy.load(file)  # a damaged file is refused
            content = file.read_bytes()
            cards.append((_card(job, record, mark, setting, command, content), content))
    return cards


def _card(
    job: Job, record: JobRecord, mark: int, setting: str, command: str, content: bytes
) -> PolicyCard:
    scenario = job.loaded()
    assert job.seed is not None
    return PolicyCard(
        id=_id(job, mark, setting),
        setting=setting,
        scenario=job.scenario,
        scenario_hashes={
            domain_label(domain): scenario_in_domain(scenario, domain).hash
            for domain in job.domains
        },
        sim=domain_label(job.sim),
        real=_real(job, mark, setting),
        training_seed=job.seed,
        episodes=mark,
        learner=job.setting.learner.name,
        command=command,
        scores={domain_label(domain): _scores(job, record, mark, domain) for domain in job.domains},
        first_seed=job.evaluation_seeds[0],
        duration_s=job.duration_s,
        versions=installed_versions(*_LIBRARIES),
        sha256=hashlib.sha256(content).hexdigest(),
        job=json.loads(TypeAdapter(Job).dump_json(job)),
    )


def _real(job: Job, mark: int, setting: str) -> str | None:
    """Return the real domain that a policy was trained for; None if it knows none."""
    knows = job.setting.knows_target and mark == job.episodes and setting != DIRECT
    return domain_label(job.target) if knows and job.target is not None else None


def _id(job: Job, mark: int, setting: str) -> str:
    assert job.seed is not None
    name = policy_name(setting, _real(job, mark, setting), job.seed)
    return f"{file_stem(job.scenario)}/{name}"


def policy_name(setting: str, real: str | None, seed: int) -> str:
    """Return the name of a packed policy, such as ``fitted-street-V4-s0``."""
    world = [] if real is None else [re.sub(r"[^\w=+.]+", "-", real).strip("-.")]
    return f"{shortened('-'.join([file_name(setting), *world]))}-s{seed}"


def _scores(job: Job, record: JobRecord, mark: int, domain: str) -> CardScores:
    played = record.played(job, mark, domain)
    att = Interval.of(np.array([scores.att_s for scores in played]))
    alone = len(played) < 2  # one episode has no interval
    return CardScores(
        episodes=len(played),
        att_s=round(att.mean, 3),
        low_s=round(att.mean if alone else att.low, 3),
        high_s=round(att.mean if alone else att.high, 3),
        throughput=round(float(np.mean([scores.throughput for scores in played])), 3),
    )
