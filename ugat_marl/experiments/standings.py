"""Standings: settings by domain, each from some trainings, and the row of an algorithm among them.

A table of standings has one row per setting, real domain and training, as ``seeds.csv`` of `paper`
has: ``setting``, ``domain``, ``training_seed``, ``att_s`` (mean travel time in the domain, s),
``att_s_sim`` (in the simulation, s) and ``throughput`` (vehicles that arrived in the domain). Its
file tells in each row how it was judged: ``scenario``, ``episodes``, ``duration_s`` and
``scenario_hash``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ugat_marl.data import csv_damage, csv_texts
from ugat_marl.effects import Domain, domain_label
from ugat_marl.errors import CheckpointError, OptionError, OutputError
from ugat_marl.experiments.comparison import Comparison
from ugat_marl.experiments.evaluation import evaluation_of
from ugat_marl.experiments.jobs import EVALUATION_SEED
from ugat_marl.experiments.paper import PaperConfig
from ugat_marl.experiments.row_names import DIRECT
from ugat_marl.experiments.statistics import Interval, number_or_none, student_p
from ugat_marl.parallel import Workers
from ugat_marl.policies import PolicyFactory, nan_last, policy_card, shipped_policies
from ugat_marl.progress import Reporter
from ugat_marl.scenarios import Scenario

SCHEMA = pl.Schema(
    {
        "setting": pl.String,
        "domain": pl.String,
        "training_seed": pl.Int64,
        "att_s": pl.Float64,
        "att_s_sim": pl.Float64,
        "throughput": pl.Float64,
    }
)
"""Columns of a table of standings."""

_TRAINING = ["setting", "domain", "training_seed"]
"""Columns by which a row is known."""


def read_standings(path: Path) -> pl.DataFrame:
    """Read a table of standings, such as ``results/single-v1/main/seeds.csv``.

    Raises:
        CheckpointError: The file is missing or damaged, a column or number is, or a training is
            there twice.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror}; name a seeds.csv of a table") from None
    texts = _texts(content)
    if damaged := csv_damage(path, pl.DataFrame() if texts is None else texts):
        raise CheckpointError(f"{path}: {damaged}")
    return _standings_in(texts, str(path))


@dataclass(frozen=True)
class Judging:
    """Conditions under which a table was judged; they are in each row of its file.

    Attributes:
        scenario: Id of the scenario.
        episodes: Number of episodes of each policy in each domain.
        duration_s: Length of an episode in s.
        length_s: The same, or None if it is the scenario's own; it is in no file.
        scenario_hash: Hash of the scenario, as two networks of one's own may have one id.
    """

    scenario: str
    episodes: int
    duration_s: float
    length_s: float | None = None
    scenario_hash: str = ""

    @classmethod
    def of(cls, scenario: Scenario, episodes: int, length_s: float | None) -> Judging:
        """Return the conditions in a scenario; None stands for its own length of episodes."""
        own_s = float(scenario.settings.duration_s)
        length_s = None if length_s == own_s else length_s
        return cls(scenario.id, episodes, float(length_s or own_s), length_s, scenario.hash)

    def written_to(self, table: pl.DataFrame) -> pl.DataFrame:
        """Return a table with columns that say this."""
        return table.with_columns(
            scenario=pl.lit(self.scenario),
            episodes=pl.lit(str(self.episodes)),
            duration_s=pl.lit(str(self.duration_s)),
            scenario_hash=pl.lit(self.scenario_hash),
        )

    def written_beside(self, table: pl.DataFrame, name: str, file: Path) -> pl.DataFrame:
        """Return a table with columns that say this of one setting.

        Args:
            table: The table.
            name: The setting.
            file: File of the other settings. They say what they say there, which may be nothing.
        """
        own = pl.col("setting") == name
        others = table.filter(~own).join(
            _told_in(file), on=_TRAINING, how="left", maintain_order="left"
        )
        return pl.concat([others, self.written_to(table.filter(own))])

    def require_in(self, path: Path) -> bool:
        """Refuse the file of a table that was judged otherwise.

        The ``table.csv`` beside a table of `paper` tells its scenario.

        Returns:
            True if the file tells episodes and their length in every row.

        Raises:
            OptionError: Scenario, number or length of the episodes is another one, or the files of
                the scenario are.
        """
        own, beside = (_cells(file) for file in (path, path.with_name("table.csv")))
        scenarios = _values_in(own, "scenario") or _values_in(beside, "scenario")
        if scenarios and self.scenario not in scenarios:
            raise OptionError(f"{path}: a table of {', '.join(scenarios)}, not of {self.scenario}")
        for name, option in (("episodes", "evaluation-seeds"), ("duration_s", "duration-s")):
            wanted = float(getattr(self, name))
            for given in _values_in(own, name):
                if _number_in(given) != wanted:
                    raise OptionError(
                        f"{path}: judged with {name} = {given}, not {wanted:g}; "
                        f"give --{option} {given}"
                    )
        hashes = _values_in(own, "scenario_hash")
        if self.scenario_hash and any(given != self.scenario_hash for given in hashes):
            raise OptionError(
                f"{path}: judged with other files of {self.scenario}, such as another demand; "
                "judge its rows again, or give another table"
            )
        told = own.get_column("episodes", default=None)
        return told is not None and not told.is_in(["", None], nulls_equal=True).any()


def _cells(path: Path) -> pl.DataFrame:
    """Return the cells of a file of CSV as texts; none if it is missing or no CSV."""
    texts = _texts(path.read_bytes()) if path.is_file() else None
    return pl.DataFrame() if texts is None else texts


def _values_in(texts: pl.DataFrame, column: str) -> list[str]:
    """Return the different texts of a column; none without the column."""
    if column not in texts.columns:
        return []
    told = texts[column].drop_nulls().unique(maintain_order=True).to_list()
    return [text for text in told if text]


def _told_in(path: Path) -> pl.DataFrame:
    """Return what the rows of a table's file say of how they were judged, as texts."""
    cells = _cells(path)
    names = [field.name for field in fields(Judging) if field.name != "length_s"]
    return cells.select(
        *(pl.col(name).cast(SCHEMA[name]) for name in _TRAINING),
        *(
            pl.col(name) if name in cells.columns else pl.lit(None, pl.String).alias(name)
            for name in names
        ),
    )


def judged_in(path: Path) -> dict[str, float]:
    """Return number and length of episodes, as far as the file of a table tells them."""
    cells = _cells(path)
    told = {name: _values_in(cells, name) for name in ("episodes", "duration_s")}
    numbers = {name: _number_in(texts[0]) for name, texts in told.items() if texts}
    return {name: number for name, number in numbers.items() if 1 <= number < math.inf}


def _number_in(text: str) -> float:
    """Return the number that a cell holds; nan for none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _texts(content: bytes) -> pl.DataFrame | None:
    """Return the cells of a file of CSV as texts; None if it is none."""
    try:
        return csv_texts(content)
    except pl.exceptions.PolarsError:
        return None


def _standings_in(texts: pl.DataFrame | None, name: str) -> pl.DataFrame:
    """Return the table of standings in cells; `name` is that of the file in errors."""
    if texts is None:
        raise CheckpointError(f"{name}: not a table of CSV; name a seeds.csv of a table")
    if missing := [column for column in SCHEMA if column not in texts.columns]:
        raise CheckpointError(
            f"{name}: has no column {missing[0]!r}; name a seeds.csv of `ugat-marl paper`"
        )
    texts = texts.select(*SCHEMA)
    rows = texts.select(pl.col(column).cast(kind, strict=False) for column, kind in SCHEMA.items())
    for number, (row, given) in enumerate(
        zip(rows.iter_rows(), texts.iter_rows(), strict=True), start=2
    ):
        for column, value, text in zip(SCHEMA, row, given, strict=True):
            if value is None or (isinstance(value, float) and not math.isfinite(value)):
                raise CheckpointError(
                    f"{name}: row {number}: {column} = {text!r} is no {_kind(column)}; correct it"
                )
    twice = rows.filter(rows.select(_TRAINING).is_duplicated())
    if not twice.is_empty():
        setting, domain, seed = twice.select(_TRAINING).row(0)
        raise CheckpointError(
            f"{name}: training_seed {seed} of {setting!r} in {domain} is there twice: it would "
            "count as two trainings; leave one out"
        )
    return rows


def require_kept(file: Path, after: pl.DataFrame, remedy: str, keeping: str = "") -> None:
    """Refuse to replace a table if the new one lacks any of its trainings or of their results.

    Args:
        file: The table; if it is not there, nothing is refused.
        after: What would replace it; without columns of results, trainings alone are compared.
        remedy: What to do instead, for the error.
        keeping: What else would keep the rows, for the error.

    Raises:
        OutputError: Trainings would be lost, or the file is another kind of table.
    """
    if not file.is_file():
        return
    try:
        before = read_standings(file)
    except CheckpointError as error:
        raise OutputError(f"{error}, so it is no table that could be replaced; {remedy}") from None
    lost = before.join(after, on=after.columns, how="anti", maintain_order="left")
    if not lost.is_empty():
        row = lost.row(0, named=True)
        raise OutputError(
            f"{file} has trainings that would be lost, such as {row['setting']!r} in "
            f"{row['domain']} with seed {row['training_seed']}; {keeping}{remedy}"
        )


def _kind(name: str) -> str:
    """Return what stands in a column, in words."""
    return "whole number" if SCHEMA[name] == pl.Int64 else "number"


def shipped_standings(scenario: Scenario, judging: Judging) -> pl.DataFrame:
    """Return the standings of the shipped policies of a scenario, from their cards.

    Cards of another version of the scenario, or of other episodes, are left out.

    Args:
        scenario: The scenario.
        judging: Conditions of the new row.
    """
    rows: list[dict[str, Any]] = []
    for name in shipped_policies():
        if name.partition("/")[0] != scenario.id:
            continue
        card = policy_card(name)
        here = card.scores.get(card.sim)
        if here is None or card.scenario_hashes.get(card.sim) != scenario.hash:
            continue
        if (card.first_seed, card.duration_s) != (EVALUATION_SEED, judging.length_s):
            continue
        rows += [
            {
                "setting": card.setting,
                "domain": domain,
                "training_seed": card.training_seed,
                "att_s": scores.att_s,
                "att_s_sim": here.att_s,
                "throughput": scores.throughput,
            }
            for domain, scores in card.scores.items()
            if domain != card.sim and scores.episodes == here.episodes == judging.episodes
        ]
    return pl.DataFrame(rows, schema=SCHEMA)


def standings_of(
    name: str,
    scenario: Scenario,
    policies: Sequence[PolicyFactory],
    domains: Sequence[Domain],
    *,
    judging: Judging,
    workers: Workers = None,
    reporter: Reporter | None = None,
) -> pl.DataFrame:
    """Judge the policies of an algorithm as `paper` does, and return their rows.

    Args:
        name: Name of the algorithm in the table.
        scenario: The scenario.
        policies: One per training; the first has training seed 0.
        domains: The real domains.
        judging: Number and length of the episodes.
        workers: Simulations at a time, or an executor.
        reporter: Shows progress.
    """
    numbered = {f"{name}, training {seed}": make for seed, make in enumerate(policies)}
    played = evaluation_of(
        scenario,
        numbered,
        ["sim", *domains],
        range(EVALUATION_SEED, EVALUATION_SEED + judging.episodes),
        duration_s=judging.length_s,
        workers=workers,
        reporter=reporter,
    )

    def mean(policy: str, domain: str, measure: str) -> float:
        return round(float(played.values(policy, domain, measure).mean()), 3)

    return pl.DataFrame(
        [
            {
                "setting": name,
                "domain": domain,
                "training_seed": seed,
                "att_s": mean(policy, domain, "att_s"),
                "att_s_sim": mean(policy, "sim", "att_s"),
                "throughput": mean(policy, domain, "throughput"),
            }
            for domain in map(domain_label, domains)
            for seed, policy in enumerate(numbered)
        ],
        schema=SCHEMA,
    )


def planned_trainings(table: str, config: PaperConfig) -> pl.DataFrame:
    """Return the trainings of a table of `paper` that is not made yet.

    Args:
        table: Name of the table, such as "main".
        config: Options of the table.

    Returns:
        One row per setting, real domain and training, without results.
    """
    seeds = range(config.first_seed, config.first_seed + config.seeds)
    return pl.DataFrame(
        [
            (setting.name, target, seed)
            for setting in config.settings(table)
            for target in config.targets(table)
            for seed in seeds
        ],
        schema=[(name, SCHEMA[name]) for name in _TRAINING],
        orient="row",
    )


def all_standings(comparison: Comparison) -> pl.DataFrame:
    """Return the rows of all settings of a table of `paper`."""
    return pl.concat([standings_from(comparison, name, name) for name in comparison.settings])


def standings_from(comparison: Comparison, setting: str, name: str) -> pl.DataFrame:
    """Return the rows of one setting of a table of `paper`, under the name of an algorithm."""
    rows: list[dict[str, Any]] = []
    for target in comparison.targets:
        columns = {
            "att_s": comparison.values(setting, target, "att_s"),
            "att_s_sim": comparison.values(setting, target, "att_s", comparison.sim),
            "throughput": comparison.values(setting, target, "throughput"),
        }
        rows += [
            {"setting": name, "domain": target, "training_seed": seed}
            | {column: round(float(values[place]), 3) for column, values in columns.items()}
            for place, seed in enumerate(comparison.seeds_of(setting, target))
        ]
    return pl.DataFrame(rows, schema=SCHEMA)


def require_room(table: pl.DataFrame, name: str, domains: Iterable[str]) -> None:
    """Refuse a name by which results of a table would be lost.

    Args:
        table: The table.
        name: Name of the new rows.
        domains: Domains of the new rows.

    Raises:
        OptionError: The name is that of a setting of the table which has other domains.
    """
    before = table.filter(pl.col("setting") == name)
    if lost := sorted({*before["domain"]} - {*domains}):
        raise OptionError(
            f"name = {name!r} is a row of the table with results in {', '.join(lost)}, which would "
            "be lost; give another name, or these domains as well"
        )


def with_standings(table: pl.DataFrame, own: pl.DataFrame) -> pl.DataFrame:
    """Return a table with the rows of an algorithm; rows of the same name are replaced.

    Raises:
        OptionError: As for `require_room`.
    """
    (name,) = own["setting"].unique().to_list()
    require_room(table, name, own["domain"])
    return pl.concat([table.filter(pl.col("setting") != name), own])


def ranked(table: pl.DataFrame) -> pl.DataFrame:
    """Return the settings of each domain by travel time, the fastest first.

    Returns:
        One row per domain and setting: ``domain``, ``setting``, ``trainings`` (number), ``att_s``,
        ``low_s`` and ``high_s`` (95 % interval over trainings, s), ``gap_s`` (minus that in the
        simulation, s), ``regret_s`` (minus that of the fastest setting, s), ``won_back`` (share of
        direct transfer's regret that is gone; null without one) and ``p`` (Welch's two-sided test
        against direct transfer; null where there is no spread to test by).
    """
    rows: list[dict[str, Any]] = []
    for domain in table["domain"].unique(maintain_order=True):
        here = table.filter(pl.col("domain") == domain)
        values = {
            str(setting): here.filter(pl.col("setting") == setting)
            for setting in here["setting"].unique(maintain_order=True)
        }
        att = {setting: part["att_s"].to_numpy() for setting, part in values.items()}
        best = min((float(own.mean()) for own in att.values()), key=nan_last)
        regrets = {setting: float(own.mean()) - best for setting, own in att.items()}
        for setting in sorted(att, key=lambda name: nan_last(regrets[name])):
            own, interval = att[setting], Interval.of(att[setting])
            start = regrets.get(DIRECT, 0.0)
            rows.append(
                {
                    "domain": domain,
                    "setting": setting,
                    "trainings": own.size,
                    "att_s": interval.mean,
                    "low_s": number_or_none(interval.low),
                    "high_s": number_or_none(interval.high),
                    "gap_s": interval.mean - float(values[setting]["att_s_sim"].to_numpy().mean()),
                    "regret_s": regrets[setting],
                    "won_back": 1.0 - regrets[setting] / start if start > 0 else None,
                    "p": None if setting == DIRECT else _welch_p(own, att.get(DIRECT)),
                }
            )
    return pl.DataFrame(rows, infer_schema_length=None)


def _welch_p(one: Any, other: Any) -> float | None:
    """Return the two-sided p-value of Welch's test; None if a variance is unknown or both are 0.

    t = (mean1 - mean2) / √(v1 + v2) with v = s² / n, and by Welch and Satterthwaite
    (v1 + v2)² / (v1² / (n1 - 1) + v2² / (n2 - 1)) degrees of freedom. The trainings of others share
    no seeds with those of the table, so that no pairs can be made.
    """
    if other is None or one.size < 2 or other.size < 2:
        return None
    v1, v2 = (float(np.var(own, ddof=1)) / own.size for own in (one, other))
    if v1 + v2 == 0:
        return None
    t = (float(one.mean()) - float(other.mean())) / math.sqrt(v1 + v2)
    degrees = (v1 + v2) ** 2 / (v1**2 / (one.size - 1) + v2**2 / (other.size - 1))
    return student_p(t, degrees)
