"""Policy gaps: travel times of policies before and after the correction of a scenario.

The simulation predicts the travel time of a policy. The gap is the travel time in the real domain
minus this prediction. A corrected scenario is good if it has a smaller gap, for policies that its
diagnosis did not use. Only a real domain that is itself a simulation allows this test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ugat_marl.diagnosis import CORRECTED, FILE, Diagnosis, PolicyGap, TravelTimeEstimate
from ugat_marl.effects import (
    Domain,
    domain_label,
    load_scenario,
    same_for_agents,
    scenario_in_domain,
)
from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.experiments.evaluation import evaluation_of
from ugat_marl.experiments.scores import Estimate, Evaluation
from ugat_marl.experiments.statistics import number_or_none
from ugat_marl.parallel import Workers
from ugat_marl.policies import PolicyFactory
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario


def policy_gap(
    scenario: Scenario,
    corrected: Domain | Scenario,
    real: Domain,
    policies: Mapping[str, PolicyFactory],
    seeds: Sequence[int],
    reporter: Reporter | None = None,
    *,
    duration_s: float | None = None,
    workers: Workers = None,
) -> dict[str, PolicyGap]:
    """Play policies in the simulation, the corrected scenario and the real domain.

    All three have the same seeds and the same demand, unless the correction changed the demand.
    Detector faults change no traffic, so they have no influence.

    Args:
        scenario: The simulation before the correction.
        corrected: The simulation with the effects of the diagnosis.
        real: The domain of the measured data.
        policies: Factories by name of the policy.
        seeds: Seeds of the episodes.
        reporter: Shows progress.
        duration_s: Length of an episode in s; None for the scenario's own.
        workers: Simulations at a time; None for the number of cores; or an executor.

    Returns:
        For each policy the average travel times (ATT) with Student's 95 % intervals, and the gaps:

        - `before`: |ATT(real) - ATT(sim)| of the means;
        - `after`: |ATT(real) - ATT(corrected)| of the means;
        - `shrink`: 1 - after / before; None if the 95 % interval below holds 0.

        The interval is that of ATT(real) - ATT(sim), paired by seed.

    Raises:
        OptionError: The real domain is the simulation, or there are no policies or seeds.
        UnknownNameError: A domain does not exist.
        ScenarioError: A scenario named as a domain cannot be read or has other roads.
    """
    if not policies or not seeds:
        raise OptionError("a policy gap needs at least one policy and one seed")
    if duration_s is not None:  # effects need to know it
        scenario = scenario.with_duration(duration_s)
    world = scenario_in_domain(scenario, real, recorded=True, duration_s=duration_s)
    if same_for_agents(world, scenario):
        raise OptionError(
            f"real = {domain_label(real)!r} is the simulation itself; there is no gap"
        )
    repaired = (
        corrected
        if isinstance(corrected, Scenario)
        else scenario_in_domain(scenario, corrected, recorded=True, duration_s=duration_s)
    )
    evaluations: dict[str, Evaluation] = {}
    for name, place in (("sim", scenario), ("corrected", repaired), ("real", world)):
        evaluations[name] = evaluation_of(
            place,
            policies,
            ["sim"],
            seeds,
            duration_s=duration_s,
            workers=workers,
            reporter=reporter or Silent(),
            title=f"policies in {'the real world' if name == 'real' else name}",
        )
    return {policy: _gap(evaluations, policy) for policy in policies}


def _gap(evaluations: Mapping[str, Evaluation], policy: str) -> PolicyGap:
    values = {
        name: evaluation.values(policy, "sim", "att_s") for name, evaluation in evaluations.items()
    }
    att = {name: Estimate.of(att_s) for name, att_s in values.items()}
    before = abs(att["real"].mean - att["sim"].mean)
    after = abs(att["real"].mean - att["corrected"].mean)
    paired = Estimate.of(values["real"] - values["sim"])
    unseen = before == 0 or paired.low <= 0 <= paired.high  # False for the nan of a single seed
    times = {name: _travel_time(estimate) for name, estimate in att.items()}
    shrink = None if unseen else 1 - after / before
    return PolicyGap(times["sim"], times["corrected"], times["real"], before, after, shrink)


def _travel_time(estimate: Estimate) -> TravelTimeEstimate:
    return TravelTimeEstimate(
        estimate.mean, number_or_none(estimate.low), number_or_none(estimate.high)
    )


def read_diagnosis(
    directory: Path, scenario: Scenario, duration_s: float | None = None
) -> tuple[Diagnosis, Scenario]:
    """Read a diagnosis and the corrected scenario beside it.

    Args:
        directory: Output folder of `ugat_marl.diagnosis.workflow.diagnose`.
        scenario: The scenario that was diagnosed.
        duration_s: Length of episodes in the corrected scenario, s; None for its own.

    Raises:
        OptionError: The directory holds no diagnosis, one of another scenario, or one that
            corrected nothing.
        ScenarioError: The corrected scenario cannot be read.
    """
    file = directory / FILE
    try:
        diagnosis = Diagnosis.read(directory)
    except OptionError as error:
        raise OptionError(
            f"{error}; name the directory of a diagnosis, `ugat-marl diagnose SCENARIO MEASURED "
            "--out DIR`"
        ) from None
    except ValueError:  # readable, but with other keys or types
        raise OptionError(f"{file}: not a diagnosis of this version; diagnose again") from None
    if diagnosis.hashes.get("scenario") != scenario.hash:
        raise OptionError(
            f"{file}: the diagnosis of another scenario or another version of it "
            f"({diagnosis.scenario!r}), not of {scenario.id!r} as it is now"
        )
    if diagnosis.corrected is None:
        raise OptionError(
            f"{file}: verdict {diagnosis.verdict!r}: nothing was corrected, so there is "
            "nothing to compare"
        )
    place = directory / CORRECTED
    if not (place / "scenario.toml").is_file():
        raise ScenarioError(f"{place}: the corrected scenario is gone; diagnose again")
    return diagnosis, load_scenario(place, duration_s)


def write_policy_gap(
    directory: Path, diagnosis: Diagnosis, gap: Mapping[str, PolicyGap]
) -> Diagnosis:
    """Write a diagnosis with its policy gap atomically; return it."""
    measured = replace(diagnosis, policy_gap=dict(gap))
    measured.write(directory)
    return measured
