"""Outcome of a transfer in one sentence: what grounding changed in the real domain, how surely."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ugat_marl.experiments.row_names import CONTROL, DIRECT, GROUNDED_NAME
from ugat_marl.experiments.scores import Evaluation, seconds_text
from ugat_marl.experiments.statistics import PairedTest

LEVEL = 0.05
"""Level below which a difference is called shown."""


@dataclass(frozen=True)
class TransferOutcome:
    """The grounded policy of a run beside direct transfer, in the real domain.

    Attributes:
        real: Name of the real domain.
        policy: Name of the grounded policy.
        att_s: Its mean ATT, s.
        test: Its ATT minus that of direct transfer in episodes with the same vehicles, s.
        rule: Name of the best rule there; "" if none was sought.
        rule_s: Mean ATT of that rule, s; nan without one.
        control_s: Mean ATT there after as much more training in plain sim, s; nan without it.
    """

    real: str
    policy: str
    att_s: float
    test: PairedTest
    rule: str
    rule_s: float
    control_s: float = math.nan

    @property
    def shown(self) -> bool:
        """True if chance between episodes does not explain the difference."""
        return self.test.p < LEVEL

    def sentence(self) -> str:
        """Return the outcome in words."""
        change, n = self.test.difference, self.test.count
        begin = f"In {self.real} vehicles need {seconds_text(self.att_s)} s with {self.policy}"
        if self.shown:
            low, high = sorted((abs(change.low), abs(change.high)))
            text = (
                f"{begin}, {_seconds(abs(change.mean))} s {'less' if change.mean < 0 else 'more'} "
                f"than with direct transfer (95 % interval {_seconds(low)} to {_seconds(high)} s, "
                f"p = {self.test.p:.1g}, {n} episodes with the same vehicles)"
            )
        elif change.low == change.high == 0.0:
            text = f"{begin}, to the last digit as with direct transfer"
        elif math.isfinite(change.low):
            text = (
                f"{begin}; no difference from direct transfer is shown "
                f"({_seconds(change.low, '+')} to {_seconds(change.high, '+')} s, {n} episodes "
                "with the same vehicles)"
            )
        elif n == 1:
            text = (
                f"{begin}, {_seconds(change.mean, '+')} s against direct transfer in a single "
                "episode"
            )
        else:
            text = f"{begin}; some of the {n} episodes have no travel time, so no test is possible"
        if not math.isnan(self.control_s):
            text += f"; after as many more episodes in plain sim, {seconds_text(self.control_s)} s"
        if self.rule:
            text += f"; the best rule there, {self.rule}, needs {seconds_text(self.rule_s)} s"
        return f"{text}."


def _seconds(value: float, sign: str = "") -> str:
    """Return a time in whole seconds from 10 s on, and with two digits below; "+" shows signs."""
    return f"{value:{sign}.0f}" if abs(value) >= 9.5 else f"{value:{sign}.2g}"


def outcome_of(evaluation: Evaluation) -> TransferOutcome | None:
    """Compare the grounded policy of a run with direct transfer in the real domain.

    Returns:
        None if the run has no grounded policy, no direct transfer or no real domain.
    """
    grounded = [name for name in evaluation.policies if name in GROUNDED_NAME.values()]
    if DIRECT not in evaluation.policies or not grounded or len(evaluation.domains) < 2:
        return None
    real, policy = evaluation.domains[1], grounded[0]
    own, direct = (evaluation.values(name, real, "att_s") for name in (policy, DIRECT))
    rule = evaluation.best_rule_policy(real)
    rule_s = math.nan if rule is None else evaluation.estimate(rule, real, "att_s").mean
    plain = CONTROL in evaluation.policies
    return TransferOutcome(
        real,
        policy,
        float(own.mean()),
        PairedTest.of(own, direct),
        evaluation.best_rule(real) or "",
        rule_s,
        evaluation.estimate(CONTROL, real, "att_s").mean if plain else math.nan,
    )
