"""``bench env``: simulated seconds per wall second, as a ratio to SUMO alone."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ugat_marl.bench.measured import in_fresh_process
from ugat_marl.bench.report import Report, Spread, Target, require_positive
from ugat_marl.bench.rival import PETTINGZOO, SUMO_RL, Rival, rival
from ugat_marl.effects import load
from ugat_marl.errors import MeasurementError
from ugat_marl.scenario import Scenario

BARE, INPROCESS, PROCESS = "libsumo alone", "ugat-marl in-process", "ugat-marl worker process"
RIVAL, RIVAL_LEAN = f"sumo-rl {SUMO_RL}", f"sumo-rl {SUMO_RL}, no metrics"

_FOLDER = Path(__file__).parent
Measure = Callable[[], dict[str, Any]]


@dataclass(frozen=True)
class EnvBench:
    """Speed of the environment against SUMO alone and against sumo-rl.

    Every measured episode has a process of its own. A round measures all variants one after the
    other, each round beginning with another one, and ratios are taken within a round. SUMO alone
    replays the very signal states the environment showed, at the same seconds, with the same
    options and no output; the same vehicles enter and arrive, or the bench fails.

    Attributes:
        scenarios: What to simulate.
        rounds: Repetitions; medians and quartiles are over these.
        duration_s: Simulated seconds per episode.
        seed: Seed of the simulation and of the random actions.
        sumo_rl: Whether to compare with sumo-rl, which is installed into an environment of its own
            the first time.
        cache: Folder for that environment.
        out: JSON file to write.
    """

    scenarios: tuple[str, ...] = ("resco:grid4x4", "resco:cologne8")
    rounds: int = 7
    duration_s: float = 3600.0
    seed: int = 1
    sumo_rl: bool = True
    cache: Path = Path(".cache")
    out: Path | None = None

    def __post_init__(self) -> None:
        require_positive("env", rounds=self.rounds, scenarios=len(self.scenarios))

    def run(self) -> Report:
        """Measures, and writes `out` if it is given.

        Raises:
            MeasurementError: A measured process failed, or did not do the same work.
        """
        other = rival(self.cache) if self.sumo_rl else None
        notes = [_METHOD]
        rows: list[dict[str, Any]] = []
        targets: list[Target] = []
        for name in self.scenarios:
            scenario, remark = find_scenario(name, other)
            notes += [remark] if remark else []
            with tempfile.TemporaryDirectory(prefix="ugat_marl-bench-") as folder:
                runs = self._rounds(self._variants(scenario, Path(folder), other))
            speeds = {
                variant: [self.duration_s / run["steps_s"] for run in own]
                for variant, own in runs.items()
            }
            rows += [_row(name, variant, own, speeds) for variant, own in runs.items()]
            targets += _targets(name, speeds)
        if other is not None:
            notes += [_RIVAL_METHOD.format(sumo_rl=SUMO_RL, pettingzoo=PETTINGZOO)]
        report = Report("env", asdict(self), rows, targets, notes)
        if self.out is not None:
            report.write(self.out)
        return report

    def _variants(
        self, scenario: str | Path, folder: Path, other: Rival | None
    ) -> dict[str, Measure]:
        loaded = load(scenario)
        request = {
            "scenario": str(scenario),
            "duration_s": self.duration_s,
            "seed": self.seed,
            "record": None,
        }

        def own(simulator: str, record: Path | None = None) -> dict[str, Any]:
            asked = {**request, "simulator": simulator, "record": record and str(record)}
            return in_fresh_process(["-m", "ugat_marl.bench.episode"], asked)

        recorded = own("inprocess", folder)
        variants: dict[str, Measure] = {
            BARE: lambda: in_fresh_process([_FOLDER / "bare.py"], recorded["bare"]),
            INPROCESS: lambda: own("inprocess"),
            PROCESS: lambda: own("process"),
        }
        if other is not None:
            asked = _rival_request(loaded, self.duration_s, self.seed, folder)
            for variant, infos in ((RIVAL, True), (RIVAL_LEAN, False)):
                variants[variant] = lambda infos=infos: in_fresh_process(
                    [_FOLDER / "sumo_rl_episode.py"],
                    {**asked, "infos": infos},
                    python=other.python,
                    variables=other.variables(),
                )
        return variants

    def _rounds(self, variants: Mapping[str, Measure]) -> dict[str, list[dict[str, Any]]]:
        names = list(variants)
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
        for number in range(self.rounds):
            first = number % len(names)
            for name in names[first:] + names[:first]:
                runs[name].append(variants[name]())
            require_same_work({name: runs[name][-1] for name in (BARE, INPROCESS, PROCESS)})
        return runs


_METHOD = (
    "Speeds and ratios are over all steps, the closing of SUMO and the scores included, loading of "
    "the network excluded (column 'reset'). Actions are random. Median (first-third quartile)."
)
_RIVAL_METHOD = (
    "sumo-rl {sumo_rl} runs under PettingZoo {pettingzoo} with libsumo, decides as often, for as "
    "many seconds, by random actions of its own phases, with its default observation, reward, "
    "yellow and minimum green; 'no metrics' leaves out the metrics it collects at every step."
)


def find_scenario(name: str, other: Rival | None) -> tuple[str | Path, str | None]:
    """Where to load a scenario from, and what to tell the reader about it.

    RESCO networks come from an installed sumo-rl wheel, from the environment the bench made for
    sumo-rl, or are replaced by the shipped 4x4 grid.
    """
    if not name.startswith("resco:") or find_spec("sumo_rl") is not None:
        return name, None
    if other is not None:
        found = sorted((other.networks / name.removeprefix("resco:")).glob("*.sumocfg"))
        if found:
            return found[0], None
    return "grid4x4-v1", (
        f"{name} is not installed (pip install 'ugat-marl[resco]'): grid4x4-v1 was measured instead"
    )


def require_same_work(runs: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuses to compare episodes in which different numbers of vehicles entered or arrived.

    Raises:
        MeasurementError: They differ.
    """
    work = {name: (run["entered"], run["arrived"]) for name, run in runs.items()}
    if len(set(work.values())) > 1:
        raise MeasurementError(
            f"not the same work, (entered, arrived) vehicles differ: {work}; "
            "is the simulation reproducible, and was the package changed meanwhile?"
        )


def _rival_request(
    scenario: Scenario, duration_s: float, seed: int, folder: Path
) -> dict[str, Any]:
    written = scenario.write(folder / "scenario")
    return {
        "network": str(written / scenario.network.name),
        "routes": ",".join(str(written / document.name) for document in scenario.routes),
        "begin_s": scenario.settings.begin_s,
        "duration_s": duration_s,
        "decision_interval_s": scenario.control.decision_interval_s,
        "seed": seed,
    }


def _row(
    scenario: str,
    variant: str,
    runs: list[dict[str, Any]],
    speeds: Mapping[str, list[float]],
) -> dict[str, Any]:
    return {
        "scenario": scenario,
        "variant": variant,
        "simulated s / s": Spread.of(speeds[variant]),
        "ratio to libsumo": Spread.of_ratios(speeds[variant], speeds[BARE]),
        "reset [s]": Spread.of([run["start_s"] for run in runs]),
        "entered": runs[-1]["entered"],
        "arrived": runs[-1]["arrived"],
    }


def _targets(scenario: str, speeds: Mapping[str, list[float]]) -> list[Target]:
    def target(above: str, below: str, limit: float) -> Target:
        ratio = Spread.of_ratios(speeds[above], speeds[below]).median
        return Target(f"{scenario}: {above} / {below}", ratio, limit, at_least=True)

    targets = [target(INPROCESS, BARE, 0.85), target(PROCESS, BARE, 0.75)]
    return targets + [target(PROCESS, name, 2.0) for name in (RIVAL, RIVAL_LEAN) if name in speeds]
