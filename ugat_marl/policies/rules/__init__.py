"""Controllers that follow a rule; a learned policy has to beat them.

Most rules read queues and vehicles from the observation `movements`. Two rules read waiting times
from the observation `waiting`. No rule reads the state of the simulator.
"""

from ugat_marl.policies.rules.actuated import Actuated, DelayActuated
from ugat_marl.policies.rules.approaches import ControlledNetwork, covering_phases
from ugat_marl.policies.rules.catalogue import (
    RULE_NAMES,
    RULES,
    STANDARD_RULES,
    Rule,
    RuleParameter,
    example_of,
    format_rule,
    make_rule,
    parse_rule,
)
from ugat_marl.policies.rules.green_wave import GreenWave
from ugat_marl.policies.rules.open_loop import FixedTime, ProgrammeControl, Random
from ugat_marl.policies.rules.phase_scores import (
    LargestQueue,
    LongestWaiting,
    MaxPressure,
    MaxPressureLoss,
)
from ugat_marl.policies.rules.sotl import SelfOrganising
from ugat_marl.policies.rules.webster import Webster, webster_plan

__all__ = [
    "RULES",
    "RULE_NAMES",
    "STANDARD_RULES",
    "Actuated",
    "ControlledNetwork",
    "DelayActuated",
    "FixedTime",
    "GreenWave",
    "LargestQueue",
    "LongestWaiting",
    "MaxPressure",
    "MaxPressureLoss",
    "ProgrammeControl",
    "Random",
    "Rule",
    "RuleParameter",
    "SelfOrganising",
    "Webster",
    "covering_phases",
    "example_of",
    "format_rule",
    "make_rule",
    "parse_rule",
    "webster_plan",
]
