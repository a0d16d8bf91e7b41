"""``ugat-marl compare``: put the row of an algorithm into a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import polars as pl
from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import RayAddress, refuse_options, require_numbers, workers_of
from ugat_marl.cli.frame import continued_by, given_call
from ugat_marl.data import write_csv
from ugat_marl.effects import domain_label, load_scenario
from ugat_marl.errors import OptionError, counted
from ugat_marl.experiments import (
    DIRECT,
    Judging,
    PaperConfig,
    compare,
    judged_in,
    policy_factory,
    read_standings,
    require_kept,
    require_room,
    shipped_standings,
    standings_from,
    standings_of,
    with_standings,
)
from ugat_marl.files import require_writable
from ugat_marl.parallel import Workers
from ugat_marl.progress import Bars, Reporter
from ugat_marl.reporting import standings_table
from ugat_marl.scenarios import Scenario


def _refuse_twice(policies: Sequence[str]) -> None:
    """Refuse a policy that is given twice, in whatever spelling.

    Raises:
        OptionError: It is.
    """
    known: dict[object, str] = {}
    for name in policies:
        one = _without_spelling(name)
        if one in known:
            other = f" as {known[one]} and {name}" if known[one] != name else ""
            raise OptionError(
                f"--policies has {name} twice{other}: it would count as two trainings"
            )
        known[one] = name


def _without_spelling(name: str) -> object:
    """Return what all spellings of a policy have in common: settings of a rule, or whole paths."""
    from ugat_marl.policies import RULES, is_own, parse_rule, shipped_policies

    if name.partition(":")[0] in RULES:
        return parse_rule(name)
    own, at, file = name.partition("@")
    if at and is_own(own):
        return Path(own).resolve(), Path(file).resolve()
    return shipped_policies().get(name, Path(name)).resolve()


@dataclass(frozen=True)
class Compare:
    """Judge an algorithm as the published tables do, and add its row to a table.

    Give either policies that are trained already, one file per training, or a learner, which is
    trained in the simulation. docs/how-to/compare.md tells it all.

    Examples:
        ugat-marl compare single-v1 --name mine
        --policies runs/s0/policies/fitted-street.pt runs/s1/policies/fitted-street.pt
        ugat-marl compare single-v1 --name mine --learner my_algo:MyLearner --seeds 3
        ugat-marl compare single-v1 --name mine --policies my_algo:my_policy
        --table results/single-v1/main-universal/seeds.csv --out mine.csv

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        name: Name of the row.
        policies: Policies, one per training: files, shipped policies, my_module:my_policy, rules.
        learner: Learner to train in the simulation instead: a baseline, or my_module:MyLearner.
        learner_settings: Settings of the learner as NAME=VALUE.
        seeds: Number of trainings of the learner, each with its own seed.
        episodes: Training episodes of the learner.
        table: Table to add the row to: a seeds.csv of ugat-marl paper, or what --out wrote before;
            default: the shipped policies of the scenario.
        domains: The real domains; default: those of the table, or V1 and V4.
        evaluation_seeds: Number of episodes of each policy in each domain; default: that of the
            table, or 5.
        duration_s: Length of an episode in s; default: that of the table, or the scenario's own.
        out: CSV file of the table with the new row.
        runs: Folder of the trainings of the learner; a killed call goes on there.
        workers: Simulations or trainings at a time; default: one per core.
        ray: Play and train on Ray instead.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    name: str
    policies: tuple[str, ...] = ()
    learner: str | None = None
    learner_settings: tuple[str, ...] = ()
    seeds: int = 3
    episodes: int = 20
    table: Path | None = None
    domains: tuple[str, ...] = ()
    evaluation_seeds: int | None = None
    duration_s: float | None = None
    out: Path | None = None
    runs: Path = Path("runs/compare")
    workers: int | None = None
    ray: RayAddress = None

    FIRST: ClassVar[tuple[str, ...]] = (
        "scenario",
        "name",
        "policies",
        "learner",
        "seeds",
        "episodes",
        "table",
        "domains",
        "evaluation-seeds",
        "out",
        "workers",
    )
    """Options of the first screen of the help."""

    def run(self, console: Console) -> int:
        """Judge, print the table, write it."""
        if not self.name.strip():
            raise OptionError(f"--name {self.name!r}: give the new row a name")
        if bool(self.policies) == (self.learner is not None):
            raise OptionError("compare needs --policies or --learner, one of the two")
        _refuse_twice(self.policies)
        if self.policies:
            refuse_options(
                self,
                ("learner_settings", "seeds", "episodes", "runs"),
                "--policies are trained already",
            )
        require_numbers(1, evaluation_seeds=self.evaluation_seeds, workers=self.workers)
        if self.out is not None:
            require_writable(self.out, ".csv")
        told = {} if self.table is None else judged_in(self.table)
        episodes = self.evaluation_seeds or int(told.get("episodes", PaperConfig.evaluation_seeds))
        length_s = told.get("duration_s") if self.duration_s is None else self.duration_s
        scenario = load_scenario(self.scenario, length_s)
        judging = Judging.of(scenario, episodes, length_s)
        if self.table is not None:
            table = read_standings(self.table)
            if not judging.require_in(self.table):
                console.print(
                    f"note: {self.table} does not say in which episodes its rows were judged; "
                    "ranks mean something only if it was "
                    f"{counted(judging.episodes, 'episode')} of {judging.duration_s:g} s, as the "
                    "new row is (--evaluation-seeds, --duration-s)",
                    soft_wrap=True,
                )
        else:
            table = shipped_standings(scenario, judging)
            if table.is_empty():
                console.print(
                    f"note: no shipped policy of {scenario.id} was judged in episodes of this "
                    "number and length, so the row stands alone; --table takes a table of yours",
                    soft_wrap=True,
                )
        self._require_kept(table)
        domains = self._domains(table)
        if "sim" in map(domain_label, domains):
            raise OptionError("--domains sim: the simulation is played anyway; name real domains")
        require_room(table, self.name, map(domain_label, domains))
        with workers_of(self.workers, self.ray) as workers:
            own = self._judged(scenario, judging, domains, workers, Bars(console))
        if own.select(pl.any_horizontal(pl.col("att_s", "att_s_sim").is_nan().any())).item():
            raise OptionError(
                "no vehicle was due in some episode, so that it has no travel time; give longer "
                "episodes (--duration-s)"
            )
        whole = self._written(own, judging, table)
        shown = whole.filter(pl.col("domain").is_in([*map(domain_label, domains)]))
        console.print(standings_table(scenario.id, shown, self.name))
        if self.out is not None:
            console.print(f"table: {self.out}", soft_wrap=True)
        return 0

    def _written(self, own: pl.DataFrame, judging: Judging, table: pl.DataFrame) -> pl.DataFrame:
        """Return the table with the new rows; write it if that is asked for."""
        whole = with_standings(table, own)
        out = self.out
        if out is None:
            return whole
        extended = self.table is not None and self.table.resolve() == out.resolve()

        def text() -> str:
            nonlocal whole
            if extended:  # another call may have added rows meanwhile
                whole = with_standings(read_standings(out), own)
            else:
                self._require_kept(whole)
            if self.table is None:
                return judging.written_to(whole).write_csv()
            return judging.written_beside(whole, self.name, self.table).write_csv()

        write_csv(out, text)
        return whole

    def _require_kept(self, table: pl.DataFrame) -> None:
        if self.out is not None:
            keeping = f"--table {self.out} keeps them, or "
            require_kept(self.out, table, "give another --out", keeping)

    def _domains(self, table: pl.DataFrame) -> tuple[str, ...]:
        known = table["domain"].unique(maintain_order=True).to_list()
        return self.domains or tuple(known) or ("V1", "V4")

    def _judged(
        self,
        scenario: Scenario,
        judging: Judging,
        domains: tuple[str, ...],
        workers: Workers,
        reporter: Reporter,
    ) -> pl.DataFrame:
        """Return the rows of the algorithm."""
        if self.learner is None:
            return standings_of(
                self.name,
                scenario,
                [policy_factory(spec) for spec in self.policies],
                domains,
                judging=judging,
                workers=workers,
                reporter=reporter,
            )
        config = PaperConfig(
            scenario=(self.scenario,),
            domains=domains,
            seeds=self.seeds,
            episodes=self.episodes,
            rows=(DIRECT,),
            evaluation_seeds=judging.episodes,
            duration_s=judging.length_s,
            learner=self.learner,
            learner_settings=self.learner_settings,
        )
        call = given_call("compare") or ["compare", self.scenario, "..."]
        with continued_by(call, f"trainings: {self.runs}"):
            comparison = compare("main", self.scenario, config, self.runs, workers, reporter)
        return standings_from(comparison, DIRECT, self.name)
