"""Are errors of measurement read off right? Networks, drivers and errors, and what was found.

    python -m studies.detector_errors mixed-v1 --domain sim V4 'detector_offset=advance,-10'
    python -m studies.detector_errors grid2x2-v1 --policy max-pressure:10 --no-speeds

Only the first stage of a diagnosis runs, the one that looks at the detectors.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ugat_marl.cli import guarded
from ugat_marl.diagnosis import DiagnosisConfig, Study
from ugat_marl.effects import load_scenario
from ugat_marl.experiments import policy_factory, record
from ugat_marl.progress import Silent
from ugat_marl.scenarios import Scenario

DRIVERS = (
    "sim", "V1", "V4", "desired_speed=1.15", "imperfection=0.1", "driver_model=IDM",
    "driver_model=EIDM", "heavy_share=0.3", "min_gap=4", "late_green=*,3", "startup_delay=1.2",
)  # fmt: skip
"""Domains in which detectors are as stated."""
ERRORS = (
    "detector_extension=*,0.5,split", "detector_extension=advance,1.5,merged",
    "detector_offset=advance,-10", "detector_offset=advance,8", "detector_speeds=*,front",
    "detector_speeds=*,mean", "detector_zone=advance,3", "V4+detector_offset=advance,-15",
    "headway=1.4+detector_speeds=*,front", "driver_model=IDM+detector_extension=*,1,split",
)  # fmt: skip
"""Domains in which they are not."""


@dataclass(frozen=True)
class Case:
    """Data of a domain, and how its detectors were judged.

    Attributes:
        domain: Domain that was measured.
        found: Errors of measurement that were named, as texts of effects.
        day_to_day: Estimated variation of demand from day to day, as a share.
    """

    domain: str
    found: tuple[str, ...]
    day_to_day: float

    @property
    def right(self) -> bool:
        """True if the errors hidden were named, by their kinds, places and forms, and no others."""
        hidden, named = self.kinds(self.domain.split("+")), self.kinds(self.found)
        return hidden.keys() == named.keys() and all(
            form == named[kind] or "unknown" in (form, named[kind]) for kind, form in hidden.items()
        )

    @staticmethod
    def kinds(texts: Sequence[str]) -> dict[str, str]:
        """Return the form of each error of measurement, without numbers, by its kind and place."""
        errors = (text.split(",") for text in texts if text.startswith("detector_"))
        return {kind: ",".join(filter(str.isalpha, more)) for kind, *more in errors}


def judged(
    scenario: Scenario,
    domain: str,
    policy: str,
    seed: int,
    *,
    periods: int,
    speeds: bool,
    cache: Path | None,
) -> Case:
    """Measure a domain and read off the errors of its detectors.

    Args:
        scenario: The scenario.
        domain: The domain.
        policy: Controller of the signals.
        seed: Seed of the days.
        periods: Number of days; the last 40 % are not looked at.
        speeds: True if speeds are measured.
        cache: Folder of simulated days; None for the user's.
    """
    measured = record(
        scenario, domain, policy_factory(policy), periods=periods, seed=seed, speeds=speeds
    )
    study = Study.of(scenario, measured, DiagnosisConfig(cache=cache))
    study = study.detectors_as_they_are(Silent())
    return Case(domain, tuple(str(error.effect) for error in study.detection), study.day_to_day)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each domain."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("scenario")
    parser.add_argument("--domain", nargs="+", default=[*DRIVERS, *ERRORS])
    parser.add_argument("--policy", default="fixed-time:30")
    parser.add_argument("--duration-s", type=float, default=1800.0)
    parser.add_argument("--periods", type=int, default=3)
    parser.add_argument("--seed", type=int, default=9000)
    parser.add_argument("--no-speeds", action="store_true")
    parser.add_argument("--cache", type=Path)
    given = parser.parse_args(arguments)
    scenario = load_scenario(given.scenario).with_duration(given.duration_s)
    print("| domain | named | right | day to day |\n|---|---|---|---:|")
    for number, domain in enumerate(given.domain):
        case = judged(
            scenario,
            domain,
            given.policy,
            given.seed + number,
            periods=given.periods,
            speeds=not given.no_speeds,
            cache=given.cache,
        )
        named = " ".join(f"`{text}`" for text in case.found) or "nothing"
        right = "yes" if case.right else "no"
        print(f"| `{domain}` | {named} | {right} | {100 * case.day_to_day:.0f} % |", flush=True)


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.detector_errors", main))
