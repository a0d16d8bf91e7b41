"""Queues of a street as its detectors show them, and what a fitted street learns from them.

    python -m studies.detector_logs single-v1 grid2x2-v1 arterial1x5-v1 --domain V4
    python -m studies.detector_logs single-v1 --domain V4 --simulations 160

A domain is recorded as a street is, with its lanes. The log of its detectors is compared with the
log of the same days in which the vehicles on lanes are those of the simulation. With simulations, a
street is fitted to either log, in the same worlds.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl import parallel_env
from ugat_marl.cli import guarded
from ugat_marl.data import MeasuredData, TransitionLog
from ugat_marl.effects import load_scenario
from ugat_marl.experiments import policy_factory, record
from ugat_marl.grounding import (
    LaneView,
    MeasuredSource,
    Posterior,
    RecordedWorld,
    Simulation,
    StreetConfig,
    fit_street,
    log_of_measured,
    street_prior,
)
from ugat_marl.scenarios import Network, Scenario

Floats = NDArray[np.float64]

SURE = 1.5
"""Deviation in vehicles up to which a fitted street uses the vehicles on a lane."""


@dataclass(frozen=True)
class LaneErrors:
    """Errors of the vehicles on some lanes.

    Attributes:
        lanes: Number of lanes.
        vehicles: Mean number of vehicles on them.
        error: Root mean square error of the vehicles.
        said: Root mean square of the deviations that the log states.
    """

    lanes: int
    vehicles: float
    error: float
    said: float


def record_street(
    scenario: Scenario, domain: str, policy: str, periods: int, duration_s: float | None = None
) -> tuple[TransitionLog, TransitionLog]:
    """Record a domain; return the log of its lanes and that of its detectors.

    Args:
        scenario: The scenario.
        domain: The domain.
        policy: Controller of the signals.
        periods: Number of days.
        duration_s: Length of a day, s; None for the scenario's own.
    """
    measured = record(
        scenario, domain, policy_factory(policy), periods=periods, duration_s=duration_s, lanes=True
    )
    return _log(measured, scenario, domain, "best"), _log(measured, scenario, domain, "detections")


def _log(
    measured: MeasuredData, scenario: Scenario, domain: str, source: MeasuredSource
) -> TransitionLog:
    network = Network.read(scenario)
    return log_of_measured(
        measured, scenario, network, domain, "movements", source, periods="all"
    ).log


def errors(scenario: Scenario, lanes: TransitionLog, detectors: TransitionLog) -> list[LaneErrors]:
    """Return the errors of lanes whose queue is known, and of those whose queue is guessed."""
    view = LaneView.of(Network.read(scenario), "movements")
    deviation = detectors.provenance.deviation
    groups: list[list[tuple[Floats, ...]]] = [[], []]
    for lane, true, found in zip(view.lanes, view.rows(lanes), view.rows(detectors), strict=True):
        there = np.isin(true.key, found.key)
        parts = (
            true.before[there],
            found.before - true.before[there],
            np.full(len(found.before), deviation[lane]),
        )
        groups[deviation[lane] > SURE].append(parts)
    return [_summed(group) for group in groups]


def _summed(group: Sequence[tuple[Floats, ...]]) -> LaneErrors:
    if not group:
        return LaneErrors(0, *[float("nan")] * 3)
    vehicles, error, said = (np.concatenate(x) for x in zip(*group, strict=True))

    def size(values: Floats) -> float:
        return float(np.sqrt((values**2).mean()))

    return LaneErrors(len(group), float(vehicles.mean()), size(error), size(said))


def fits(
    scenario: Scenario, lanes: TransitionLog, detectors: TransitionLog, simulations: int
) -> dict[str, list[str]]:
    """Fit a street to either log, in the same worlds; return each effect with its 90 % interval."""
    config = StreetConfig(parts=("service", "effects"), simulations=simulations)
    with contextlib.closing(parallel_env(scenario, observation="movements")) as env:
        worlds, view = street_prior(env, config), LaneView.of(env.network, "movements")
        replay = RecordedWorld(lanes, env).replay()
    simulation = Simulation(scenario, {"observation": "movements"}, 0.0)
    assert replay is not None
    street, known = fit_street(lanes, simulation, replay, worlds, view, config, 0)
    assert street.posterior is not None
    other = Posterior.fit(worlds, known.simulated, view.summary(detectors))
    found: dict[str, list[str]] = {}
    for name, posterior in (("lanes", street.posterior), ("detectors", other)):
        effects, _ = posterior.sample(400)
        low, middle, high = np.quantile(effects, (0.05, 0.5, 0.95), axis=0)
        found[name] = [
            f"{m:.2f} ({a:.2f}–{b:.2f})" for a, m, b in zip(low, middle, high, strict=True)
        ]
    found["effect"] = [item.name for item in worlds.library]
    return found


def main() -> None:
    """Record, compare and print tables in Markdown."""
    summary = __doc__.splitlines()[0] if __doc__ else ""
    parser = argparse.ArgumentParser(prog="python -m studies.detector_logs", description=summary)
    parser.add_argument("scenarios", nargs="+")
    parser.add_argument("--domain", default="V4")
    parser.add_argument("--policy", default="fixed-time:30")
    parser.add_argument("--periods", type=int, default=2)
    parser.add_argument("--duration-s", type=float)
    parser.add_argument("--simulations", type=int, default=0, help="worlds for a fit; 0 for none")
    given = parser.parse_args()
    print("| network | queues | lanes | vehicles | error | said |")
    print("|---|---|---:|---:|---:|---:|")
    tables: list[str] = []
    for name in given.scenarios:
        scenario = load_scenario(name)
        logs = record_street(scenario, given.domain, given.policy, given.periods, given.duration_s)
        for kind, row in zip(("known", "guessed"), errors(scenario, *logs), strict=True):
            print(
                f"| {name} | {kind} | {row.lanes} | {row.vehicles:.1f} | {row.error:.2f} | "
                f"{row.said:.2f} |"
            )
        if given.simulations:
            found = fits(scenario, *logs, given.simulations)
            tables.append(f"\n{name}\n\n| effect | from lanes | from detectors |\n|---|---:|---:|")
            columns = (found["effect"], found["lanes"], found["detectors"])
            tables += [f"| {' | '.join(cells)} |" for cells in zip(*columns, strict=True)]
    print(*tables, sep="\n")


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.detector_logs", main))
