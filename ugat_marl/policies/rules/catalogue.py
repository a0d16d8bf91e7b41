"""Every rule by name, and its spelling: ``name``, ``name:number`` or ``name:number:number``.

A new rule is a class in a module of this folder and a row in `RULES`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ugat_marl.envs import AnyParallelEnv
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.policies.protocols import Policy
from ugat_marl.policies.rules.actuated import Actuated, DelayActuated
from ugat_marl.policies.rules.approaches import ControlledNetwork
from ugat_marl.policies.rules.green_wave import GreenWave
from ugat_marl.policies.rules.open_loop import FixedTime, ProgrammeControl, Random
from ugat_marl.policies.rules.phase_scores import (
    LargestQueue,
    LongestWaiting,
    MaxPressure,
    MaxPressureLoss,
)
from ugat_marl.policies.rules.sotl import SelfOrganising
from ugat_marl.policies.rules.webster import Webster
from ugat_marl.scenarios import parse_decimal


@dataclass(frozen=True)
class RuleParameter:
    """A number in the spelling of a rule.

    Attributes:
        name: Meaning of the number, for messages.
        unit: Unit of the number.
        default: Value if the spelling leaves it out.
        choices: Values that tuning tries.
        least: Smallest plausible value; smaller ones are mistaken for another number.
    """

    name: str
    unit: str
    default: float
    choices: tuple[float, ...]
    least: float = 0.0


@dataclass(frozen=True)
class Rule:
    """A rule that can be named.

    Attributes:
        make: Function that makes the rule from a `ControlledNetwork` and the parameters.
        parameters: Parameters of the rule, in the order of the spelling.
    """

    make: Callable[..., Policy]
    parameters: tuple[RuleParameter, ...] = ()


_HOLDS = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
_LONGEST = (20.0, 30.0, 40.0, 60.0, 80.0, 120.0)


def _held(default: float, choices: tuple[float, ...] = _HOLDS) -> RuleParameter:
    return RuleParameter("shortest time of a phase", "seconds", default, choices)


RULES: Mapping[str, Rule] = {
    "actuated": Rule(
        Actuated,
        (
            RuleParameter("longest time of a phase", "seconds", 40, _LONGEST),
            RuleParameter("headway that ends a green", "seconds", 3, (2, 3, 5)),
        ),
    ),
    "delay-actuated": Rule(
        DelayActuated,
        (
            RuleParameter("longest time of a phase", "seconds", 40, _LONGEST),
            RuleParameter("waiting on a lane that is left out", "vehicle-seconds", 10, (1, 10, 40)),
        ),
    ),
    "fixed-time": Rule(FixedTime, (RuleParameter("time of a phase", "seconds", 30, _HOLDS),)),
    "green-wave": Rule(
        GreenWave,
        (
            RuleParameter("time of a phase", "seconds", 20, (10, 20, 30)),
            RuleParameter("time of the phase along the road", "seconds", 30, (20, 30, 40, 60)),
        ),
    ),
    "largest-queue": Rule(LargestQueue, (_held(20),)),
    "longest-waiting": Rule(LongestWaiting, (_held(20),)),
    "max-pressure": Rule(MaxPressure, (_held(10),)),
    "max-pressure-loss": Rule(MaxPressureLoss, (_held(10),)),
    "programme": Rule(ProgrammeControl),
    "random": Rule(Random),
    "sotl": Rule(
        SelfOrganising,
        (
            RuleParameter(
                "impatience that switches", "vehicle-seconds", 600, (150, 300, 600, 1200, 2400)
            ),
            _held(10, (10, 20, 30)),
        ),
    ),
    "webster": Rule(
        Webster,
        (
            RuleParameter(
                "saturation flow",
                "vehicles an hour and lane",
                1800,
                (900, 1200, 1500, 1800, 2100),
                300,
            ),
        ),
    ),
}
"""Every rule by name."""

RULE_NAMES = tuple(RULES)
"""Names of all rules."""

STANDARD_RULES = (
    *(f"largest-queue:{hold_s}" for hold_s in (10, 20, 30, 40)),
    *(f"max-pressure:{hold_s}" for hold_s in (10, 20, 30)),
    *(f"max-pressure-loss:{hold_s}" for hold_s in (10, 20)),
    *(f"actuated:{longest_s}" for longest_s in (40, 80)),
    "sotl:300:20",
    "webster:1500",
    "programme",
)
"""Rules that the search for the best rule of a domain tries."""


def make_rule(spec: str, env: AnyParallelEnv) -> Policy:
    """Make a rule from its spelling, such as ``"largest-queue:30"``.

    Args:
        spec: A name of `RULES`, and optionally its parameters, each after a colon.
        env: Any environment of the scenario; only its network is read. Make the environment in
            which the rule acts with the rule's `env_options`.

    Raises:
        UnknownNameError: No rule has this name.
        OptionError: A parameter is not a number above 0, or there are too many. Or the environment
            stacks observations, of which a rule would read the oldest.
    """
    name, values = parse_rule(spec)
    rule = RULES[name].make(ControlledNetwork.of(env), *values)
    frames = getattr(env.unwrapped, "frames", 1)
    if "observation" in rule.env_options and frames > 1:
        raise OptionError(
            f"rule {spec!r}: a rule reads one observation, and frame_stack shows "
            f"{frames}; give the rule the environment without frame_stack"
        )
    return rule


def parse_rule(spec: str) -> tuple[str, tuple[float, ...]]:
    """Return the name and the parameters of a spelling, with defaults filled in.

    Raises:
        UnknownNameError: No rule has this name.
        OptionError: A parameter is not a number above 0, or there are too many.
    """
    name, *texts = spec.split(":")
    if name not in RULES:
        raise UnknownNameError("rule", name, RULE_NAMES)
    parameters = RULES[name].parameters
    if len(texts) > len(parameters):
        takes = ", ".join(f"{p.name} in {p.unit}" for p in parameters) or "no number"
        raise OptionError(f"rule {spec!r}: {name} takes {takes}; write {example_of(name)!r}")
    values = [parameter.default for parameter in parameters]
    for place, text in enumerate(texts):
        try:
            values[place] = parse_decimal(text)
        except ValueError:
            values[place] = math.nan
        one = parameters[place]
        if not 0 < values[place] < math.inf or values[place] < one.least:
            bound = f"of at least {one.least:g}" if one.least else "above 0"
            raise OptionError(
                f"rule {spec!r}: {text!r} is not a number of {one.unit} {bound} ({one.name}); "
                f"write for example {example_of(name)!r}"
            )
    return name, tuple(values)


def example_of(name: str) -> str:
    """Return the spelling of a rule with its defaults written out."""
    return format_rule(name, [parameter.default for parameter in RULES[name].parameters])


def format_rule(name: str, values: tuple[float, ...] | list[float]) -> str:
    """Return the spelling of a rule with these parameters."""
    return ":".join([name, *(f"{value:g}" for value in values)])
