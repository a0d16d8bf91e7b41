"""Is a policy trained? Its travel time in the simulation against that of rules.

A table of transfers means little where the policy is worse than a rule in the very simulation that
it was trained in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ugat_marl.experiments.comparison import Comparison
from ugat_marl.experiments.row_names import DIRECT, RULE
from ugat_marl.experiments.scores import Evaluation, seconds_text

MARGIN = 0.02
"""Share by which a trained policy may be slower than the rule. Halved, chance decides more often:
means over five episodes differ by about 1 %."""


@dataclass(frozen=True)
class SimCheck:
    """A policy and the best rule, in the simulation that the policy was trained in.

    Attributes:
        sim: Name of the simulation.
        policy: Name of the policy.
        policy_s: Its mean ATT, s.
        rule: Name of the rule.
        rule_s: Its mean ATT, s.
    """

    sim: str
    policy: str
    policy_s: float
    rule: str
    rule_s: float

    @property
    def trained(self) -> bool:
        """True if the policy is no more than `MARGIN` slower than the rule."""
        return self.policy_s <= (1.0 + MARGIN) * self.rule_s

    def sentence(self, option: str) -> str:
        """Return the comparison in words.

        Args:
            option: Option of the command line that makes the training longer.
        """
        times = (
            f"in {self.sim} {self.policy} needs {seconds_text(self.policy_s)} s, "
            f"{self.rule} {seconds_text(self.rule_s)} s"
        )
        if self.trained:
            return f"Trained: {times}."
        return f"Not trained yet: {times}; train longer ({option})."


def check_run(evaluation: Evaluation) -> SimCheck | None:
    """Compare the policy of a run with the rule that is best in its simulation.

    Returns:
        None if the run has no policy from plain training, or no rule was chosen in its simulation.
    """
    if not evaluation.results:
        return None
    sim = evaluation.domains[0]
    rule = evaluation.best_rule_policy(sim)
    if rule is None or not {DIRECT, rule} <= set(evaluation.policies):
        return None
    times = [evaluation.estimate(name, sim, "att_s").mean for name in (DIRECT, rule)]
    if not all(map(math.isfinite, times)):
        return None
    return SimCheck(sim, DIRECT, times[0], rule, times[1])


def check_table(comparison: Comparison) -> SimCheck | None:
    """Compare direct transfer with the fastest of the tuned rules of a table, in its simulation.

    Rules are tuned in the real domains; one tuned in the simulation may be faster still.

    Returns:
        None if the table has no row of rules, or none of direct transfer.
    """
    times = {
        (setting, target): float(comparison.values(setting, target, "att_s", comparison.sim).mean())
        for setting in (DIRECT, RULE)
        for target in comparison.targets
        if comparison.has(setting, target)
    }
    rules = {target: time for (setting, target), time in times.items() if setting == RULE}
    policy_s = [time for (setting, _), time in times.items() if setting == DIRECT]
    if not rules or not policy_s:
        return None
    target = min(rules, key=lambda name: rules[name])
    rule = f"the best rule, tuned in {target}"
    return SimCheck(comparison.sim, DIRECT, policy_s[0], rule, rules[target])
