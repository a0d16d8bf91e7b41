"""``bench env``: simulated seconds per wall second, as a ratio to SUMO alone."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from studies.bench.report import Report, Spread, Target, require_positive
from studies.bench.rival import PETTINGZOO, SUMO_RL, Rival, rival
from studies.bench.tasks import SUMO_RL_TIMING, Run, Task, find_scenario, require_same_work
from ugat_marl.progress import Advance, Reporter, Silent

BARE, INPROCESS, PROCESS = "libsumo alone", "ugat-marl in-process", "ugat-marl worker process"
RIVAL, RIVAL_LEAN = f"sumo-rl {SUMO_RL}", f"sumo-rl {SUMO_RL} without metrics"
OWN_TIMING, RIVAL_TIMING = "own", "sumo-rl's"

Variant = tuple[str, str]
"""Whose signal timing, and who does the work."""


@dataclass(frozen=True)
class EnvBench:
    """Speed of the environment against SUMO alone and against sumo-rl.

    Every measured episode has a process of its own. A round measures all variants one after the
    other, each round beginning with another one, and ratios are taken within a round. SUMO alone
    replays the very signal states the environment showed, at the same seconds, with the same
    options and no output; the same vehicles enter and arrive, or the bench fails. sumo-rl gets the
    same actions, and the environment its clearance times, so that both have the same traffic.

    Examples:
        python -m studies.bench env --rounds 3 --out speed.json

    Attributes:
        scenarios: What to simulate.
        rounds: Repetitions; medians and quartiles are over these.
        duration_s: Simulated seconds per episode.
        decision_interval_s: Seconds from decision to decision; None for the scenario's own (10).
        seed: Seed of the simulation and of the random actions.
        sumo_rl: Whether to compare with sumo-rl, which is installed into an environment of its own
            the first time.
        cache: Folder for that environment.
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
        """Measures, and writes `out` if it is given.

        Args:
            reporter: Is told how far the measuring has come.

        Raises:
            MeasurementError: A measured process failed, or did not do the same work.
        """
        reporter = reporter or Silent()
        other = rival(self.cache, reporter.say) if self.sumo_rl else None
        notes = [_METHOD]
        rows: list[dict[str, Any]] = []
        targets: list[Target] = []
        for name in self.scenarios:
            scenario, remark = find_scenario(name, other)
            notes += [remark] if remark else []
            with tempfile.TemporaryDirectory(prefix="ugat_marl-bench-") as folder:
                variants = self._variants(scenario, Path(folder), other)
                with reporter.task(name, self.rounds * len(variants)) as advance:
                    runs = self._rounds(variants, advance)
            rows += [self._row(name, variant, runs) for variant in runs]
            targets += _targets(name, runs)
            notes += [_ceiling(name, runs)] if other is not None else []
        if other is not None:
            notes += [_RIVAL_METHOD.format(sumo_rl=SUMO_RL, pettingzoo=PETTINGZOO)]
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
        self, scenario: str | Path, folder: Path, other: Rival | None
    ) -> dict[Variant, Callable[[], Run]]:
        every = self.decision_interval_s
        interval = {} if every is None else {"decision_interval_s": every}
        timings = {OWN_TIMING: interval}
        if other is not None:
            timings[RIVAL_TIMING] = {**SUMO_RL_TIMING, **interval}
        variants: dict[Variant, Callable[[], Run]] = {}
        for timing, control in timings.items():
            own = folder / timing
            own.mkdir()
            task = Task.record(scenario, control, own, duration_s=self.duration_s, seed=self.seed)
            variants[timing, BARE] = task.by_libsumo
            variants[timing, INPROCESS] = partial(task.by_suite, "inprocess")
            variants[timing, PROCESS] = partial(task.by_suite, "process")
            if other is not None and timing == RIVAL_TIMING:
                variants[timing, RIVAL] = partial(task.by_sumo_rl, other, metrics=True)
                variants[timing, RIVAL_LEAN] = partial(task.by_sumo_rl, other, metrics=False)
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
_RIVAL_METHOD = (
    "sumo-rl {sumo_rl} runs under PettingZoo {pettingzoo} with libsumo, and with its default "
    "observation, reward, metrics, clearance and minimum green, which the suite is given as well "
    "for this comparison."
)
_SAME_TRAFFIC = 0.02


def _check_round(runs: Mapping[Variant, Run]) -> None:
    """The same vehicles to the last one in the suite and SUMO alone; nearly so in sumo-rl.

    (It keeps a green protected through a yellow after which it is permissive; the suite does not.)
    """
    for timing in dict.fromkeys(timing for timing, _ in runs):
        own = {who: run for (whose, who), run in runs.items() if whose == timing}
        require_same_work({who: own[who] for who in (BARE, INPROCESS, PROCESS)})
        require_same_work(own, _SAME_TRAFFIC)


def _speeds(runs: list[Run]) -> list[float]:
    """Episodes per wall second."""
    return [1.0 / run["steps_s"] for run in runs]


def _ratio_by_cpu(runs: list[Run], bare: list[Run]) -> Spread:
    """The ratio of speeds if only the seconds counted in which the processor was theirs."""
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
    if (RIVAL_TIMING, RIVAL) in runs:
        targets += [target(RIVAL_TIMING, who, RIVAL, 2.0) for who in (INPROCESS, PROCESS)]
    return targets


def _ceiling(scenario: str, runs: Mapping[Variant, list[Run]]) -> str:
    """How much faster than sumo-rl an environment could be at best."""
    bare, other = _speeds(runs[RIVAL_TIMING, BARE]), _speeds(runs[RIVAL_TIMING, RIVAL])
    most = Spread.of_ratios(bare, other).median
    return (
        f"{scenario}: SUMO alone, with no environment around it, is {most:.2f} times as fast as "
        f"{RIVAL} on the same traffic; that is the most any environment can reach here."
    )
