"""``bench env``: measure simulated seconds per wall second, as a ratio to SUMO alone."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from studies.bench.fresh_process import in_fresh_process
from studies.bench.report import Report, Spread, Target, require_positive
from studies.bench.sumo_rl import PETTINGZOO, SUMO_RL, SumoRl, install_sumo_rl
from studies.errors import MeasurementError
from ugat_marl.effects import load_scenario
from ugat_marl.errors import install_command
from ugat_marl.progress import Advance, Reporter, Silent

_FOLDER = Path(__file__).parent
Run = dict[str, Any]
"""Wall seconds ``start_s`` and ``steps_s``, ``cpu_s``, ``decisions``; vehicles ``entered`` and
``arrived``."""

SUMO_RL_TIMING: Mapping[str, float] = {"yellow_s": 2.0, "all_red_s": 0.0, "min_green_s": 5.0}
"""Default clearance and minimum green of sumo-rl, which has no all-red."""
BARE, INPROCESS, PROCESS = "libsumo alone", "ugat-marl in-process", "ugat-marl worker process"
SUMO_RL_USUAL, SUMO_RL_LEAN = f"sumo-rl {SUMO_RL}", f"sumo-rl {SUMO_RL} without metrics"
OWN_TIMING, SUMO_RL_CLEARANCE = "own", "sumo-rl's"

Variant = tuple[str, str]
"""Origin of the signal timing, and the program that is measured."""


@dataclass(frozen=True)
class EnvBench:
    """Compare the speed of the environment with SUMO alone and with sumo-rl.

    Every measured episode runs in its own process. A round measures all variants one after the
    other; each round begins with another variant. Ratios are taken within a round. SUMO alone
    replays the signal states of the environment at the same seconds, with the same options and no
    output. If other vehicles enter or arrive, the bench fails. sumo-rl gets the same actions, and
    the environment gets the clearance times of sumo-rl, so both have the same traffic.

    Examples:
        python -m studies.bench env --rounds 3 --out speed.json

    Attributes:
        scenarios: Scenarios to simulate.
        rounds: Repetitions; medians and quartiles are over these.
        duration_s: Simulated seconds per episode.
        decision_interval_s: Seconds between decisions; None for the scenario's own (10).
        seed: Seed of the simulation and of the random actions.
        sumo_rl: Compare with sumo-rl. The first time, it is installed into its own virtual
            environment.
        cache: Folder for this virtual environment.
        out: JSON file to write.
    """

    scenarios: tuple[str, ...] = ("resco:grid4x4", "resco:cologne8")
    rounds: int = 7
    duration_s: float = 3600.0
    decision_interval_s: float | None = None
    seed: int = 1
    sumo_rl: bool = True
    cache: Path = Path(".cache")
    out: Path | None = None

    def __post_init__(self) -> None:
        require_positive("env", rounds=self.rounds, scenarios=len(self.scenarios))

    def run(self, reporter: Reporter | None = None) -> Report:
        """Measure, and write `out` if it is given.

        Args:
            reporter: Reporter of the progress.

        Raises:
            MeasurementError: A measured process failed, or had different traffic.
        """
        reporter = reporter or Silent()
        other = install_sumo_rl(self.cache, reporter.say) if self.sumo_rl else None
        notes = [_METHOD]
        rows: list[dict[str, Any]] = []
        targets: list[Target] = []
        measured: set[str] = set()
        for asked in self.scenarios:
            scenario, remark = find_scenario(asked, other)
            notes += [remark] if remark else []
            name = str(scenario) if remark else asked
            if name in measured:  # what is measured in the place of several
                continue
            measured.add(name)
            with tempfile.TemporaryDirectory(prefix="ugat_marl-bench-") as folder:
                variants = self._variants(scenario, Path(folder), other)
                with reporter.task(name, self.rounds * len(variants)) as advance:
                    runs = self._rounds(variants, advance)
            rows += [self._row(name, variant, runs) for variant in runs]
            targets += _targets(name, runs)
            notes += [_ceiling(name, runs)] if other is not None else []
        if other is not None:
            notes += [_SUMO_RL_METHOD.format(sumo_rl=SUMO_RL, pettingzoo=PETTINGZOO)]
        report = Report(
            "env",
            asdict(self),
            rows,
            targets,
            notes,
            by=("scenario", "timing"),
            aside=("entered", "arrived"),
        )
        if self.out is not None:
            report.write(self.out)
        return report

    def _variants(
        self, scenario: str | Path, folder: Path, other: SumoRl | None
    ) -> dict[Variant, Callable[[], Run]]:
        every = self.decision_interval_s
        interval = {} if every is None else {"decision_interval_s": every}
        timings = {OWN_TIMING: interval}
        if other is not None:
            timings[SUMO_RL_CLEARANCE] = {**SUMO_RL_TIMING, **interval}
        variants: dict[Variant, Callable[[], Run]] = {}
        for timing, control in timings.items():
            own = folder / timing
            own.mkdir()
            task = Task.record(scenario, control, own, duration_s=self.duration_s, seed=self.seed)
            variants[timing, BARE] = task.by_libsumo
            variants[timing, INPROCESS] = partial(task.by_suite, "inprocess")
            variants[timing, PROCESS] = partial(task.by_suite, "process")
            if other is not None and timing == SUMO_RL_CLEARANCE:
                variants[timing, SUMO_RL_USUAL] = partial(task.by_sumo_rl, other, metrics=True)
                variants[timing, SUMO_RL_LEAN] = partial(task.by_sumo_rl, other, metrics=False)
        return variants

    def _rounds(
        self, variants: Mapping[Variant, Callable[[], Run]], advance: Advance
    ) -> dict[Variant, list[Run]]:
        order = list(variants)
        runs: dict[Variant, list[Run]] = {variant: [] for variant in order}
        for number in range(self.rounds):
            first = number % len(order)
            for variant in order[first:] + order[:first]:
                runs[variant].append(variants[variant]())
                advance()
            _check_round({variant: own[-1] for variant, own in runs.items()})
        return runs

    def _row(
        self, scenario: str, variant: Variant, runs: Mapping[Variant, list[Run]]
    ) -> dict[str, Any]:
        timing, who = variant
        own, bare = runs[variant], runs[timing, BARE]
        speeds = _speeds(own)
        decisions = own[-1]["decisions"]
        beyond = [run["steps_s"] - alone["steps_s"] for run, alone in zip(own, bare, strict=True)]
        return {
            "scenario": scenario,
            "timing": timing,
            "who": who,
            "simulated s / s": Spread.of([self.duration_s * speed for speed in speeds]),
            "ratio to libsumo": Spread.of_ratios(speeds, _speeds(bare)),
            "ratio by CPU": "-" if who == PROCESS else _ratio_by_cpu(own, bare),
            "beyond SUMO [ms/decision]": Spread.of([1e3 * x / decisions for x in beyond]).median,
            "reset [s]": Spread.of([run["start_s"] for run in own]).median,
            "entered": own[-1]["entered"],
            "arrived": own[-1]["arrived"],
        }


_METHOD = (
    "Speeds and ratios are over all steps, the closing of SUMO and the scores included, loading of "
    "the network excluded (column 'reset'). Actions are random, the same for all that share a "
    "timing. Median (first-third quartile); ratios within a round. 'By CPU' leaves out the seconds "
    "in which other processes had the processor; 'beyond SUMO' is what a decision takes longer "
    "than in SUMO alone."
)
_SUMO_RL_METHOD = (
    "sumo-rl {sumo_rl} runs under PettingZoo {pettingzoo} with libsumo, and with its default "
    "observation, reward, metrics, clearance and minimum green, which the suite is given as well "
    "for this comparison."
)
_SAME_TRAFFIC = 0.02


def _check_round(runs: Mapping[Variant, Run]) -> None:
    """Require the same vehicles in the suite and in SUMO alone, and nearly the same in sumo-rl.

    sumo-rl differs in one case: it keeps a green protected during a yellow after which the green is
    permissive.
    """
    for timing in dict.fromkeys(timing for timing, _ in runs):
        own = {who: run for (whose, who), run in runs.items() if whose == timing}
        require_same_work({who: own[who] for who in (BARE, INPROCESS, PROCESS)})
        require_same_work(own, _SAME_TRAFFIC)


def _speeds(runs: list[Run]) -> list[float]:
    """Return episodes per wall second."""
    return [1.0 / run["steps_s"] for run in runs]


def _ratio_by_cpu(runs: list[Run], bare: list[Run]) -> Spread:
    """Return the ratio of speeds by CPU time."""
    return Spread.of_ratios([run["cpu_s"] for run in bare], [run["cpu_s"] for run in runs])


def _targets(scenario: str, runs: Mapping[Variant, list[Run]]) -> list[Target]:
    def target(timing: str, above: str, below: str, limit: float) -> Target:
        ratios = Spread.of_ratios(_speeds(runs[timing, above]), _speeds(runs[timing, below]))
        name = f"{scenario}, {timing} timing: {above} / {below}"
        return Target(name, ratios.median, limit, at_least=True)

    targets = [
        target(OWN_TIMING, INPROCESS, BARE, 0.85),
        target(OWN_TIMING, PROCESS, BARE, 0.75),
    ]
    if (SUMO_RL_CLEARANCE, SUMO_RL_USUAL) in runs:
        targets += [
            target(SUMO_RL_CLEARANCE, who, SUMO_RL_USUAL, 2.0) for who in (INPROCESS, PROCESS)
        ]
    return targets


def _ceiling(scenario: str, runs: Mapping[Variant, list[Run]]) -> str:
    """Return a note on the largest possible gain of speed over sumo-rl."""
    bare, other = (
        _speeds(runs[SUMO_RL_CLEARANCE, BARE]),
        _speeds(runs[SUMO_RL_CLEARANCE, SUMO_RL_USUAL]),
    )
    most = Spread.of_ratios(bare, other).median
    return (
        f"{scenario}: SUMO alone, with no environment around it, is {most:.2f} times as fast as "
        f"{SUMO_RL_USUAL} on the same traffic; that is the most any environment can reach here."
    )


@dataclass(frozen=True)
class Task:
    """An episode whose actions are fixed.

    Attributes:
        request: Request of `studies.bench.env_program`.
        bare: Request of `studies.bench.env_libsumo_program`: the signal states of that episode.
        sumo_rl: Request of `studies.bench.env_sumo_rl_program`: the same actions.
    """

    request: dict[str, Any]
    bare: dict[str, Any]
    sumo_rl: dict[str, Any]

    @classmethod
    def record(
        cls,
        scenario: str | Path,
        control: Mapping[str, float],
        folder: Path,
        *,
        duration_s: float,
        seed: int,
    ) -> Task:
        """Run an episode with random actions and record the requests that repeat it.

        Args:
            scenario: Scenario to simulate.
            control: Changes to its signal timing.
            folder: An empty folder that exists as long as the task.
            duration_s: Simulated seconds.
            seed: Seed of simulation and actions.
        """
        request = {
            "scenario": str(scenario),
            "control": dict(control),
            "duration_s": duration_s,
            "seed": seed,
            "record": None,
        }
        kept = folder / "kept"
        kept.mkdir()
        recorded = _episode({**request, "simulator": "inprocess", "record": str(kept)})
        bare = recorded["bare"]
        loaded = load_scenario(scenario).with_control(**control)
        written = loaded.write(folder / "scenario")
        sumo_rl = {
            "network": str(written / loaded.network.name),
            "routes": ",".join(str(written / document.name) for document in loaded.routes),
            "begin_s": bare["begin_s"],
            "duration_s": duration_s,
            "decision_interval_s": loaded.control.decision_interval_s,
            "yellow_s": loaded.control.yellow_s,
            "min_green_s": loaded.control.min_green_s,
            "seed": int(bare["arguments"][bare["arguments"].index("--seed") + 1]),
            "actions": recorded["actions"],
        }
        return cls(request, bare, sumo_rl)

    def by_libsumo(self) -> Run:
        """Play the recorded signal states in SUMO alone."""
        return self._counted(in_fresh_process([_FOLDER / "env_libsumo_program.py"], self.bare))

    def by_suite(self, simulator: str) -> Run:
        """Play the episode in the suite, with the simulator in this or in another process."""
        return self._counted(_episode({**self.request, "simulator": simulator}))

    def by_sumo_rl(self, sumo_rl: SumoRl, *, metrics: bool) -> Run:
        """Play the same actions in sumo-rl, with or without its default metrics."""
        run = in_fresh_process(
            [_FOLDER / "env_sumo_rl_program.py"],
            {**self.sumo_rl, "infos": metrics},
            python=sumo_rl.python,
            variables=sumo_rl.variables(),
        )
        return self._counted(run)

    def _counted(self, run: Run) -> Run:
        return {**run, "decisions": len(self.sumo_rl["actions"])}


def _episode(request: Mapping[str, Any]) -> dict[str, Any]:
    return in_fresh_process(["-m", "studies.bench.env_program"], request)


def find_scenario(name: str, sumo_rl: SumoRl | None) -> tuple[str | Path, str | None]:
    """Return the source of a scenario, and a note for the reader.

    RESCO networks come from an installed sumo-rl or from the virtual environment of the bench.
    Without both, the shipped 4x4 grid replaces them.
    """
    if not name.startswith("resco:") or find_spec("sumo_rl") is not None:
        return name, None
    if sumo_rl is not None:
        found = sorted((sumo_rl.networks / name.removeprefix("resco:")).glob("*.sumocfg"))
        if found:
            return found[0], None
    return "grid4x4-v1", (
        f"{name} is not installed ({install_command('resco')}): grid4x4-v1 was measured instead"
    )


def require_same_work(runs: Mapping[str, Run], tolerance: float = 0.0) -> None:
    """Refuse to compare episodes with different traffic.

    Args:
        runs: Name to run; the others are compared with the first.
        tolerance: Largest allowed difference of the vehicles that entered and arrived, as a share.

    Raises:
        MeasurementError: A difference is larger.
    """
    first = next(iter(runs.values()))
    for run in runs.values():
        for what in ("entered", "arrived"):
            if abs(run[what] - first[what]) > tolerance * first[what]:
                work = {name: (own["entered"], own["arrived"]) for name, own in runs.items()}
                raise MeasurementError(
                    f"not the same work, (entered, arrived) vehicles differ: {work}; "
                    "was the package changed meanwhile?"
                )
