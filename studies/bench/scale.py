"""``bench scale``: measure many simulations, large networks, and processes that die."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from studies.bench.fresh_process import in_fresh_process
from studies.bench.memory import growth_of
from studies.bench.report import Report, Spread, Target, require_positive
from studies.errors import MeasurementError
from ugat_marl.errors import OptionError, install_command
from ugat_marl.policies import BASELINES, load_baseline, require_known_learner
from ugat_marl.progress import Reporter, Silent

_PROGRAM = ["-m", "studies.bench.scale_program"]
PARTS = ("workers", "grounded", "size", "decision", "leaks", "kills", "learner", "ray")
Run = dict[str, Any]


@dataclass(frozen=True)
class Figure:
    """One row of the table.

    Attributes:
        name: Name of the measured number.
        value: Measured value.
        reach: Value that it must reach; nan for none.
        aim: Value that would be better still; nan for none.
        at_least: True if the value must be at least `reach`; false if at most.
    """

    name: str
    value: Spread | float
    reach: float
    aim: float
    at_least: bool

    @property
    def target(self) -> Target:
        """Return the target for the report."""
        middle = self.value.median if isinstance(self.value, Spread) else self.value
        return Target(self.name, middle, self.reach, self.at_least)

    def row(self) -> dict[str, Any]:
        """Return a row of the report's table."""
        bounds = {"reach": self.reach, "aim": self.aim}
        sign = ">=" if self.at_least else "<="
        shown = {name: f"{sign} {x:g}" if x == x else "" for name, x in bounds.items()}
        return {"figure": self.name, "measured": self.value, **shown}


@dataclass(frozen=True)
class ScaleBench:
    """Measure many simulations at once: speed, size, leaks, dying processes.

    Every measured program runs in its own processes. In each round the compared variants take
    turns, and ratios are taken within a round. Signals show each green for 30 s in turn, so traffic
    flows and is the same in all variants.

    Examples:
        python -m studies.bench scale --rounds 3 --out scale.json
        python -m studies.bench scale --parts size decision --sides 4 8

    Attributes:
        parts: Parts to measure: workers, grounded, size, decision, leaks, kills, learner, ray.
        scenario: A grid for all parts but size, decision, leaks and kills.
        small: A scenario for leaks and kills.
        rounds: Repetitions of each comparison.
        decisions: Measured decisions of an episode.
        settled: Decisions before the measurement, in which the network fills.
        sides: Intersections along each side of the generated grids.
        vph: Vehicles per hour at every road into the generated grids.
        environments: Environments that are opened and closed for leaks.
        resets: Resets of all these environments together.
        episodes: Episodes in which processes are killed.
        kills: Number of processes that are killed.
        learner: Learner whose CPU time is divided into SUMO, torch and the rest.
        seed: Seed of the simulations and of the kills.
        out: JSON file to write.
    """

    parts: tuple[str, ...] = PARTS
    scenario: str = "grid4x4-v1"
    small: str = "single-v1"
    rounds: int = 5
    decisions: int = 120
    settled: int = 60
    sides: tuple[int, ...] = (4, 8, 16)
    vph: float = 150.0
    environments: int = 64
    resets: int = 500
    episodes: int = 500
    kills: int = 100
    learner: str = "sb3-ppo"
    seed: int = 1
    out: Path | None = None

    def __post_init__(self) -> None:
        numbers = {name: getattr(self, name) for name in ("rounds", "decisions", "environments")}
        require_positive("scale", **numbers, sides=len(self.sides), episodes=self.episodes)
        require_known_learner(self.learner)
        for part in self.parts:
            if part not in PARTS:
                raise OptionError(f"bench scale: parts holds {part!r}; allowed: {', '.join(PARTS)}")

    def run(self, reporter: Reporter | None = None) -> Report:
        """Measure, and write `out` if it is given.

        Args:
            reporter: Reporter of the progress.

        Raises:
            MeasurementError: A measured program failed, or had different traffic.
        """
        reporter = reporter or Silent()
        measured: dict[str, Callable[[Reporter], list[Figure]]] = {
            "workers": self._workers,
            "grounded": self._grounded,
            "size": self._size,
            "decision": self._decision,
            "leaks": self._leaks,
            "kills": self._kills,
            "learner": self._learner,
            "ray": self._ray,
        }
        figures: list[Figure] = []
        notes = [_METHOD]
        for part in self.parts:
            if part == "ray" and find_spec("ray") is None:
                notes.append(f"Ray is not installed ({install_command('ray')}): not measured.")
                continue
            if part == "learner" and not _is_installed(self.learner):
                notes.append(f"The library of {self.learner} is not installed: not measured.")
                continue
            figures += measured[part](reporter)
        report = Report(
            "scale",
            asdict(self),
            [figure.row() for figure in figures],
            [figure.target for figure in figures if figure.reach == figure.reach],
            notes,
        )
        if self.out is not None:
            report.write(self.out)
        return report

    def _workers(self, reporter: Reporter) -> list[Figure]:
        variants = {
            name: partial(self._steps, self.scenario, n, stepping=name)
            for name, n in (("one", 1), ("together", 2), ("halves", 2), ("ready", 2))
        }
        runs = self._rounds("workers", variants, reporter)
        one, two = runs["one"], runs["together"]
        figures = [
            Figure(name, Spread.of_ratios(_speeds(runs[variant]), _speeds(one)), 1.7, 1.9, True)
            for name, variant in (
                ("2 simulations / 1, steps per s, by halves", "halves"),
                ("2 simulations / 1, steps per s, as they are ready", "ready"),
                ("2 simulations / 1, steps per s, together", "together"),
            )
        ]
        return [
            *figures,
            _told("steps per s of 1 simulation", Spread.of(_speeds(one))),
            _told("steps per s of 2 simulations, by halves", Spread.of(_speeds(runs["halves"]))),
            _told("steps per s of 2 simulations, as ready", Spread.of(_speeds(runs["ready"]))),
            _told("steps per s of 2 simulations, together", Spread.of(_speeds(two))),
            _told("CPU of a simulation per step [ms]", _milliseconds(two, "simulation_cpu_s")),
            _told("CPU of its user per step [ms]", _milliseconds(two, "user_cpu_s")),
            _told("memory of 1 simulation and its user [MiB]", one[-1]["memory_mib"]),
            _told(
                "memory of a further simulation [MiB]",
                two[-1]["memory_mib"] - one[-1]["memory_mib"],
            ),
        ]

    def _grounded(self, reporter: Reporter) -> list[Figure]:
        variants = {
            name: partial(self._ask, "grounded", scenario=self.scenario, grounding=name)
            for name in (None, "phase", "timed")
        }
        runs = self._rounds("grounded", variants, reporter)
        figures: list[Figure] = []
        for name in ("phase", "timed"):
            for plain, own in zip(runs[None], runs[name], strict=True):
                if plain["att_s"] != own["att_s"]:
                    raise MeasurementError(f"{name} grounding changed the traffic: {plain}, {own}")
            ratio = Spread.of_ratios(_speeds(runs[name]), _speeds(runs[None]))
            figures.append(Figure(f"{name} grounding / plain, steps per s", ratio, 0.8, 0.95, True))
        return figures

    def _size(self, reporter: Reporter) -> list[Figure]:
        with tempfile.TemporaryDirectory(prefix="ugat_marl-bench-") as name:
            grids = {side: self._grid(Path(name), side, reporter) for side in self.sides}
            runs = self._rounds(
                "size",
                {side: partial(self._steps, str(grid), 1) for side, grid in grids.items()},
                reporter,
            )
            parts = self._rounds(
                "size, in SUMO and outside",
                {
                    side: partial(self._ask, "split", scenario=str(grid), **self._lengths)
                    for side, grid in grids.items()
                },
                reporter,
            )
        costs = {
            side: [1e3 * run["seconds"] / (run["steps"] * run["agents"]) for run in own]
            for side, own in runs.items()
        }
        first, last = self.sides[0], self.sides[-1]
        growth = Spread.of_ratios(costs[last], costs[first])
        name = f"{last}x{last} / {first}x{first}, cost per agent and step"
        rest = {side: [run["rest_ms"] for run in own] for side, own in parts.items()}
        outside = Spread.of_ratios(rest[last], rest[first])
        figures = [
            Figure(name, growth, 1.5, 1.0, False),
            Figure(f"{name}, outside SUMO", outside, 1.5, 1.0, False),
        ]
        for side, own in runs.items():
            agents, lasting = own[-1]["agents"], parts[side]
            figures += [
                _told(f"{side}x{side}: CPU outside SUMO", Spread.of(rest[side])),
                _told(
                    f"{side}x{side}: CPU of SUMO per vehicle and second [us]",
                    Spread.of([run["us_per_vehicle_s"] for run in lasting]),
                ),
                _told(f"{side}x{side}: ms per agent and step", Spread.of(costs[side])),
                _told(f"{side}x{side}: the same, CPU alone", _cpu_cost(own)),
                _told(f"{side}x{side}: vehicles on lanes per agent", own[-1]["vehicles"] / agents),
                _told(f"{side}x{side}: memory of all processes [MiB]", own[-1]["memory_mib"]),
            ]
        return figures

    def _decision(self, reporter: Reporter) -> list[Figure]:
        with tempfile.TemporaryDirectory(prefix="ugat_marl-bench-") as name:
            grid = self._grid(Path(name), self.sides[-1], reporter)
            with reporter.task("decision", 1):
                found = self._ask("decide", scenario=str(grid), repetitions=200)
        agents = found.pop("agents")
        return [
            Figure(f"decision for {agents} agents, {kind} [ms]", 1e3 * seconds, 20.0, 5.0, False)
            for kind, seconds in found.items()
        ]

    def _leaks(self, reporter: Reporter) -> list[Figure]:
        turns = 4
        resets = max(1, -(-self.resets // (turns * self.environments)))
        asked = {"n": self.environments, "turns": turns, "resets": resets, "duration_s": 100.0}
        with reporter.task(f"{turns} x {self.environments} opened and closed", 1):
            found = self._ask("leaks", scenario=self.small, **asked)
        early, late = found["early"], found["late"]
        figures = [
            Figure(
                f"more {what} after {found['resets']} resets", late[what] - early[what], 0, 0, False
            )
            for what in ("processes", "open files", "temporary files")
        ]
        memory = "memory of all processes [MiB]"
        growth = 100 * growth_of(early[memory], late[memory])
        return [*figures, Figure("growth of memory [%]", growth, 2.0, 2.0, False)]

    def _kills(self, reporter: Reporter) -> list[Figure]:
        asked = {"n": 4, "episodes": self.episodes, "duration_s": 100.0, "scenario": self.small}
        with reporter.task("killed at random", 2) as advance:
            harmed = self._ask("kills", kills=self.kills, **asked)
            advance()
            unharmed = self._ask("kills", kills=0, **asked)
            advance()
        other = float(harmed["digest"] != unharmed["digest"])
        name = f"other results: {harmed['killed']} killed in {harmed['episodes']} episodes"
        slower = harmed["seconds"] / unharmed["seconds"]
        return [Figure(name, other, 0, 0, False), _told("the same, time / unharmed", slower)]

    def _learner(self, reporter: Reporter) -> list[Figure]:
        asked = {"scenario": self.scenario, "learner": self.learner, "episodes": 2}
        with reporter.task(f"training of {self.learner}", self.rounds) as advance:
            runs: list[Run] = []
            for _ in range(self.rounds):
                runs.append(self._ask("learner", **asked))
                advance()
        total = [sum(run.values()) for run in runs]
        shares = {
            owner: Spread.of_ratios([100 * run[owner] for run in runs], total) for owner in runs[0]
        }
        name = f"training of {self.learner}, CPU outside SUMO and torch [%]"
        return [
            Figure(name, shares.pop("rest"), 15.0, 7.0, False),
            *(_told(f"the same, in {owner} [%]", share) for owner, share in shares.items()),
        ]

    def _ray(self, reporter: Reporter) -> list[Figure]:
        asked: dict[str, Any] = {"scenario": self.scenario, "episodes": 8}
        asked["duration_s"] = 10.0 * (self.settled + self.decisions)
        variants = {nodes: partial(self._ask, "ray", nodes=nodes, **asked) for nodes in (1, 2)}
        runs = self._rounds("ray", variants, reporter)
        if len({run["digest"] for own in runs.values() for run in own}) > 1:
            raise MeasurementError("one and two nodes of Ray gave different results")
        ratio = Spread.of_ratios(
            [1 / run["seconds"] for run in runs[2]], [1 / run["seconds"] for run in runs[1]]
        )
        return [Figure("Ray, 2 nodes of 1 core / 1 node, episodes per s", ratio, 1.6, 1.8, True)]

    def _rounds(
        self, title: str, variants: dict[Any, Callable[[], Run]], reporter: Reporter
    ) -> dict[Any, list[Run]]:
        order = list(variants)
        runs: dict[Any, list[Run]] = {name: [] for name in order}
        with reporter.task(title, self.rounds * len(order)) as advance:
            for number in range(self.rounds):
                first = number % len(order)
                for name in order[first:] + order[:first]:
                    runs[name].append(variants[name]())
                    advance()
        return runs

    def _steps(self, scenario: str, n: int, *, stepping: str = "together") -> Run:
        return self._ask("steps", scenario=scenario, n=n, stepping=stepping, **self._lengths)

    @property
    def _lengths(self) -> dict[str, int]:
        return {"settled": self.settled, "decisions": self.decisions}

    def _ask(self, work: str, **request: Any) -> Run:
        # One decision more than is measured, because the end of an episode would cost a reset.
        length_s = 10.0 * (self.settled + self.decisions + 1)
        told = {"duration_s": length_s, "seed": self.seed, **request, "work": work}
        return in_fresh_process(_PROGRAM, told)

    def _grid(self, folder: Path, side: int, reporter: Reporter) -> Path:
        # Only two parts need grids, and these modules load slowly.
        from ugat_marl.scenarios import from_turning_shares, grid_roads, make_scenario

        target = folder / f"grid{side}x{side}"
        length_s = 10.0 * (self.settled + self.decisions + 1)
        make_scenario(
            target,
            grid_roads(f"{side}x{side}", 300.0, 13.9),
            from_turning_shares(self.vph, (0.2, 0.65, 0.15), 0.0, length_s, self.seed),
            settings={"duration_s": length_s},
            command="",
            force=False,
            reporter=reporter,
        )
        return target


_METHOD = (
    "Medians of rounds in which the variants take turns; ratios within a round. Times are of the "
    "steps alone, after the network has filled; grounded: of a whole episode."
)


def _told(name: str, value: Spread | float) -> Figure:
    """Make a figure without a target."""
    return Figure(name, value, float("nan"), float("nan"), True)


def _is_installed(learner: str) -> bool:
    if learner in BASELINES:
        try:
            load_baseline(learner)
        except OptionError:
            return False
    return True


def _milliseconds(runs: list[Run], what: str) -> Spread:
    return Spread.of([1e3 * run[what] / run["steps"] for run in runs])


def _cpu_cost(runs: list[Run]) -> Spread:
    """Return CPU milliseconds per agent and step, of the simulation and of its user."""
    spent = [run["simulation_cpu_s"] + run["user_cpu_s"] for run in runs]
    each = zip(spent, runs, strict=True)
    return Spread.of([1e3 * cpu_s / (run["steps"] * run["agents"]) for cpu_s, run in each])


def _speeds(runs: list[Run]) -> list[float]:
    return [run["steps"] / run["seconds"] for run in runs]
