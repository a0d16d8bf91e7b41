"""Tuning of rules: a race finds the best parameters of a rule in a domain, and a file keeps them.

A rule has up to two parameters. They act in whole decisions, so a few values of each are enough.
One episode says little about a value, so the values are raced by successive halving (Jamieson and
Talwalkar 2016): all of them play a few episodes, then the better half plays more. All play the
same seeds.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ugat_marl.data import installed_version, json_damage, with_hashes
from ugat_marl.effects import Domain, domain_label, scenario_in_domain
from ugat_marl.errors import CheckpointError, OutputError, UnknownNameError, require_least
from ugat_marl.experiments.evaluation import TUNING_SEED, best_rule, race_rules
from ugat_marl.experiments.scores import RuleTrial, Tuned
from ugat_marl.files import MALFORMED, read_json, user_cache, write_whole
from ugat_marl.parallel import Workers
from ugat_marl.policies import RULE_NAMES, RULES, TUNED_RULES, race_fields, rule_settings
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario

VERSION = 3
"""Version of rules and race. Increase it with every change of them: stored results expire."""

BUDGET = 24
"""Default for the most episodes to tune one rule."""

LEAST_BUDGET = 2
"""Smallest budget: one episode each for two settings."""

UNTUNED_EPISODES = 3
"""Most episodes of a rule without parameters to tune."""


def tune(
    name: str,
    scenario: Scenario,
    domain: Domain = "sim",
    budget: int = BUDGET,
    *,
    duration_s: float | None = None,
    workers: Workers = None,
    reporter: Reporter | None = None,
    fresh: bool = False,
) -> Tuned:
    """Find the settings of a rule with the smallest mean ATT in a domain.

    The race holds all combinations of the values in the rule's `RULES` entry. If the budget is too
    small for all, it holds an evenly spread part of them. Seeds begin at `TUNING_SEED`; no result
    is reported on them. The result is kept in the user's cache folder and reused for the same
    scenario, domain, rule, values, budget and versions.

    Args:
        name: Name of the rule, without parameters.
        scenario: The scenario.
        domain: The domain in which to tune.
        budget: Most episodes to play.
        duration_s: Length of an episode in s; None for the scenario's own.
        workers: Simulations at a time; None for the number of cores; or an executor.
        reporter: Shows progress.
        fresh: Ignore a stored result and play again.

    Raises:
        UnknownNameError: No rule has this name.
        OptionError: The budget is below `LEAST_BUDGET`.
    """
    if name not in RULES:
        raise UnknownNameError("rule", name, RULE_NAMES)
    require_least(LEAST_BUDGET, budget=budget)
    specs = rule_settings(name, budget)
    place = _place(name, scenario, domain, budget, duration_s, specs)
    if not fresh and (trials := _recall(place, specs)):
        return Tuned(name, domain_label(domain), trials)
    trials = race_rules(
        scenario,
        domain,
        specs,
        rungs(len(specs), budget),
        duration_s=duration_s,
        workers=workers,
        reporter=reporter,
        title=f"tuning {name}",
    )
    hashed = with_hashes({"trials": [asdict(trial) for trial in trials]}, "trials")
    try:
        write_whole(place, json.dumps(hashed, indent=1) + "\n")
    except OutputError as error:  # the result is there all the same
        told = f"note: the settings of {name} are not kept for other runs: {error}"
        (reporter or Silent()).say(f"{told}, in XDG_CACHE_HOME")
    return Tuned(name, domain_label(domain), trials)


def tuned_rule(
    scenario: Scenario,
    domain: Domain,
    budget: int = BUDGET,
    *,
    names: Sequence[str] = TUNED_RULES,
    seeds: Sequence[int] = (TUNING_SEED, TUNING_SEED + 1),
    duration_s: float | None = None,
    workers: Workers = None,
    reporter: Reporter | None = None,
) -> str:
    """Tune the rules in a domain; return the spelling of the best tuned rule there.

    `best_rule` does the same without tuning.
    """
    common: dict[str, Any] = {
        "duration_s": duration_s,
        "workers": workers,
        "reporter": reporter,
    }
    tuned = [tune(name, scenario, domain, budget, **common) for name in names]
    return best_rule(
        scenario, domain, rules=[each.best.spec for each in tuned], seeds=seeds, **common
    )


def rungs(settings: int, budget: int) -> list[list[int]]:
    """Return the seeds of each rung of a race.

    Every rung has new seeds and about the same number of episodes.

    Args:
        settings: Number of settings at the start.
        budget: Most episodes in all; enough for one episode of each setting in every rung.
    """
    if settings < 2:
        return [[TUNING_SEED + k for k in range(min(budget, UNTUNED_EPISODES))]]
    fields = race_fields(settings)
    rungs_seeds: list[list[int]] = []
    following, left = TUNING_SEED, budget
    for rung, field in enumerate(fields):
        share = left / (len(fields) - rung)
        payable = left - sum(fields[rung + 1 :])
        episodes = max(1, int(min(share, payable) // field))
        rungs_seeds.append([following + k for k in range(episodes)])
        following += episodes
        left -= episodes * field
    return rungs_seeds


def _place(
    name: str,
    scenario: Scenario,
    domain: Domain,
    budget: int,
    duration_s: float | None,
    specs: Sequence[str],
) -> Path:
    """Return the file that keeps a result; its name is a hash of all that decides the result."""
    world = scenario_in_domain(scenario, domain, duration_s=duration_s)
    sumo = installed_version("eclipse-sumo")
    content = (VERSION, sumo, scenario.hash, world.hash, name, budget, TUNING_SEED, *specs)
    return user_cache("tuned") / f"{hashlib.sha256(repr(content).encode()).hexdigest()}.json"


def _recall(place: Path, specs: Sequence[str]) -> tuple[RuleTrial, ...] | None:
    """Return the result in a file; None if it is missing, damaged or of other settings."""
    try:
        content: Any = read_json(place, CheckpointError)
        if json_damage(content, "trials"):
            return None
        rows = content["trials"]
        trials = tuple(
            RuleTrial(str(r["spec"]), float(r["att_s"]), int(r["episodes"])) for r in rows
        )
    except (CheckpointError, *MALFORMED):
        return None
    whole = sorted(trial.spec for trial in trials) == sorted(specs)
    return trials if whole and all(math.isfinite(trial.att_s) for trial in trials) else None
