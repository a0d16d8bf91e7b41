"""Do detection limits hold? Streets with effects at their limits, and how many of them show.

    python -m studies.detection_limits single-v1 resco:cologne1 --seed 1

Data of the scenario as it is are diagnosed with their limits. Then new streets are measured: each
has one effect, at the weakest value that shows, at the strongest one that hides, or at the usual
value. Each is tested as in a diagnosis. Of the streets at values that show, at least four in five
should contradict the scenario.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from scipy.stats import binomtest

from studies.errors import MeasurementError
from ugat_marl.cli import guarded
from ugat_marl.data import MeasuredData
from ugat_marl.diagnosis import DetectionLimit, DiagnosisConfig, Study, diagnose, locate_gap
from ugat_marl.effects import EVERYWHERE, known_effects, load_scenario
from ugat_marl.errors import require_least
from ugat_marl.experiments import policy_factory, record
from ugat_marl.progress import Bars, Reporter, Silent
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import derive_seed

_MOST_DRAWS = 20
"""Data sets in a row that may contradict the scenario as it is; by chance one in twenty does."""


@dataclass(frozen=True)
class Trial:
    """New streets with one effect at one value, and how many contradict the scenario.

    Attributes:
        kind: ``"shown"``, ``"hidden"`` or ``"usual"``.
        domain: The effect at its value.
        shown: Streets that contradict.
        streets: All streets.
    """

    kind: str
    domain: str
    shown: int
    streets: int


def domains_at(limits: Sequence[DetectionLimit]) -> list[tuple[str, str]]:
    """Return kind and domain of the values at the ends of the limits that were found."""
    domains = [("usual", "sim")]
    for limit in limits:
        kind = known_effects()[limit.name]
        everywhere = dict.fromkeys(kind.texts, EVERYWHERE)
        values = {"shown": limit.shown, "hidden": limit.hidden}
        domains += [
            (name, str(kind(**everywhere, **{limit.parameter: value})))
            for name, value in values.items()
            if value is not None and value != limit.usual
        ]
    return domains


@dataclass(frozen=True)
class Streets:
    """Streets of one scenario, measured under one policy.

    Attributes:
        scenario: The scenario.
        policy: Spelling of the policy.
        periods: Measured days of a street; the last 40 % are held out.
        seed: Root of all days.
        cache: Folder of simulated days.
    """

    scenario: Scenario
    policy: str
    periods: int
    seed: int
    cache: Path

    def limits(self, reporter: Reporter) -> tuple[DetectionLimit, ...]:
        """Return the limits for data of the scenario as it is.

        One data set in twenty contradicts it by chance and has no limits; then another is drawn.

        Raises:
            MeasurementError: Several in a row contradict it, which is no chance.
        """
        config = DiagnosisConfig(limits=True, cache=self.cache)
        for number in range(_MOST_DRAWS):
            measured = self._measured("sim", derive_seed(self.seed, "limits", number))
            with tempfile.TemporaryDirectory(prefix="ugat_marl-limits-") as folder:
                found = diagnose(self.scenario, measured, folder, config, reporter)
            if found.verdict == "no_discrepancy":
                return found.limits
            reporter.say(f"note: data set {number + 1} is called {found.verdict}")
        raise MeasurementError(
            f"{self.scenario.id}: {_MOST_DRAWS} data sets of the scenario as it is contradict it; "
            "ask for more periods"
        )

    def _measured(self, domain: str, seed: int) -> MeasuredData:
        policy = policy_factory(self.policy)
        return record(self.scenario, domain, policy, periods=self.periods, seed=seed)

    def contradicts(self, domain: str, number: int) -> bool:
        """Return True if the fitted days of a new street contradict the scenario."""
        config = DiagnosisConfig(cache=self.cache)
        measured = self._measured(domain, derive_seed(self.seed, domain, number))
        study = Study.of(self.scenario, measured, config).detectors_as_they_are(Silent())
        base = study.base(Silent())
        tested = locate_gap(study, base, study.selector(base, Silent())).base
        return tested.residual.p <= config.alpha


def trials(streets: Streets, number: int, usual: int, reporter: Reporter) -> Iterator[Trial]:
    """Yield the trials of one scenario.

    Args:
        streets: How streets are made.
        number: Streets for each value.
        usual: Streets without an effect.
        reporter: Display of progress.
    """
    for kind, domain in domains_at(streets.limits(reporter)):
        count = usual if kind == "usual" else number
        shown = sum(streets.contradicts(domain, k) for k in range(count))
        yield Trial(kind, domain, shown, count)


def summary(found: Sequence[Trial]) -> list[str]:
    """Return a table row for each kind of value, with the 95 % interval of the share."""
    rows: list[str] = []
    for kind in ("shown", "hidden", "usual"):
        own = [trial for trial in found if trial.kind == kind]
        shown, streets = (sum(getattr(x, name) for x in own) for name in ("shown", "streets"))
        if streets:
            ends = binomtest(shown, streets).proportion_ci(method="wilson")
            rows.append(f"| {kind} | {len(own)} | {shown} of {streets} | "
                        f"{ends.low:.2f}–{ends.high:.2f} |")  # fmt: skip
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each value, and a summary for each scenario."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.detection_limits", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("scenarios", nargs="+")
    parser.add_argument("--policy", default="fixed-time:30")
    parser.add_argument("--periods", type=int, default=5)
    parser.add_argument("--duration-s", type=float, default=1800.0)
    parser.add_argument("--streets", type=int, default=4, help="streets for each value")
    parser.add_argument("--usual", type=int, default=40, help="streets without an effect")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=Path("runs/detection-limits"))
    given = parser.parse_args(arguments)
    require_least(1, streets=given.streets)
    for name in given.scenarios:
        scenario = load_scenario(name).with_duration(given.duration_s)
        streets = Streets(scenario, given.policy, given.periods, given.seed, given.cache)
        print(f"## {name}\n\n| | domain | contradict |\n|---|---|---:|", flush=True)
        found: list[Trial] = []
        for trial in trials(streets, given.streets, given.usual, Bars(Console(stderr=True))):
            print(f"| {trial.kind} | `{trial.domain}` | {trial.shown} of {trial.streets} |",
                  flush=True)  # fmt: skip
            found.append(trial)
        print("\n| value | values | contradict | 95 % interval |\n|---|---:|---:|---:|")
        print("\n".join(summary(found)) + "\n", flush=True)


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.detection_limits", main))
