"""The conformance kit: is an environment, a policy or a scenario what the suite takes it to be?

``check_...`` run all checks and return their results; ``..._CHECKS`` are the checks one by one. A
check is a function of a case that raises `ConformanceError`; `report` shows results.
"""

from ugat_marl.testing.determinism import DETERMINISM_CHECKS, check_determinism
from ugat_marl.testing.environment import ENVIRONMENT_CHECKS, check_environment
from ugat_marl.testing.episodes import EnvironmentCase, Episode, Moment
from ugat_marl.testing.policies import POLICY_CHECKS, PolicyCase, check_policy
from ugat_marl.testing.results import (
    ConformanceError,
    NotChecked,
    Result,
    failures,
    report,
    run_checks,
)
from ugat_marl.testing.scenarios import SCENARIO_CHECKS, ScenarioCase, check_scenario
from ugat_marl.testing.toy import ToyTraffic

__all__ = [
    "DETERMINISM_CHECKS",
    "ENVIRONMENT_CHECKS",
    "POLICY_CHECKS",
    "SCENARIO_CHECKS",
    "ConformanceError",
    "EnvironmentCase",
    "Episode",
    "Moment",
    "NotChecked",
    "PolicyCase",
    "Result",
    "ScenarioCase",
    "ToyTraffic",
    "check_determinism",
    "check_environment",
    "check_policy",
    "check_scenario",
    "failures",
    "report",
    "run_checks",
]
