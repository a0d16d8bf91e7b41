"""Controllers that follow a rule: what a learned policy has to beat.

The rules read queues and vehicles from the observation `movements` (two of them waiting times from
`waiting`), as a detector would give them; a rule never looks into the simulator.
"""

from ugat_marl.policies.rules.actuated import Actuated, DelayActuated
from ugat_marl.policies.rules.green_wave import GreenWave
from ugat_marl.policies.rules.plain import FixedTime, ProgrammeControl, Random
from ugat_marl.policies.rules.scored import (
    LargestQueue,
    LongestWaiting,
    MaxPressure,
    MaxPressureLoss,
)
from ugat_marl.policies.rules.sotl import SelfOrganising
from ugat_marl.policies.rules.spelling import (
    NAMES,
    RULES,
    STANDARD_RULES,
    Parameter,
    Rule,
    controller_for,
    example_of,
    parse_spec,
    spell,
)
from ugat_marl.policies.rules.streets import Streets, covering_phases
from ugat_marl.policies.rules.webster import Webster, webster_plan

__all__ = [
    "NAMES",
    "RULES",
    "STANDARD_RULES",
    "Actuated",
    "DelayActuated",
    "FixedTime",
    "GreenWave",
    "LargestQueue",
    "LongestWaiting",
    "MaxPressure",
    "MaxPressureLoss",
    "Parameter",
    "ProgrammeControl",
    "Random",
    "Rule",
    "SelfOrganising",
    "Streets",
    "Webster",
    "controller_for",
    "covering_phases",
    "example_of",
    "parse_spec",
    "spell",
    "webster_plan",
]
