"""Residual: f, h and gate on top of a fitted street, for what none of its parts explains.

f learns from the log of the street, h from roll-outs in worlds drawn from the fitted street. The
gate looks at the uncertainty of h after f. Grounded actions are taken only where f predicts the
street better than the fitted world does (`trust`): a street that the world explains is left alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ugat_marl.data import TransitionLog
from ugat_marl.envs import AnyParallelEnv
from ugat_marl.errors import UnknownNameError, first_names, require_kinds, require_least
from ugat_marl.grounding.fitting import Fitter
from ugat_marl.grounding.gate import GateReport
from ugat_marl.grounding.reports import FitReport
from ugat_marl.grounding.transform import Transform
from ugat_marl.grounding.trust import Trust, TrustConfig, compare
from ugat_marl.grounding.wrappers import GroundedEnv

RESIDUALS = ("none", "phase", "timed")


@dataclass(frozen=True)
class ResidualConfig:
    """Settings of f, h and gate on top of a fitted street.

    Attributes:
        kind: "none", or the kind of grounded action: "phase" is another phase, "timed" is a green
            that begins later. With "phase", s' holds the phase that runs.
        worlds: Roll-outs per iteration in worlds drawn from the fitted street, with which f is
            compared. Timed grounding needs as many again, with random delays.
        members: Networks of f; their disagreement is part of u.
        history: With "phase", least number of last observations that f sees, with the phases that
            were asked for. "timed" does not raise it, because lost times are then biased.
        trust: Settings of the comparison of f and the fitted world.
    """

    kind: Literal["none", "phase", "timed"] = "none"
    worlds: int = 6
    members: int = 5
    history: int = 4
    trust: TrustConfig = field(default_factory=TrustConfig)

    def __post_init__(self) -> None:
        if self.kind not in RESIDUALS:
            raise UnknownNameError("residual", self.kind, RESIDUALS)
        require_kinds(self, "residual")
        require_least(2, **{"residual worlds": self.worlds})
        require_least(1, **{"residual members": self.members, "residual history": self.history})


@dataclass(frozen=True)
class ResidualReport:
    """Quality of f and h on top of the fitted world, and where they are trusted.

    Attributes:
        fit: Errors of f and h.
        trust: Comparison of f and the fitted world.
        acting: Agents whose actions are grounded.
    """

    fit: FitReport
    trust: Trust
    acting: tuple[str, ...]

    def describe(self) -> str:
        """Return where the residual acts, in one line."""
        agents = self.trust.agents
        if np.isnan(self.trust.world_error).all():
            return "residual: off, too few decisions of the street, or of its worlds, to compare"
        better = int(self.trust.better.sum())
        told = f"residual: f predicts better than the fitted world at {better} of {len(agents)}"
        if not better:
            return f"{told} intersections; no action is grounded"
        shown = first_names(self.acting) or "none"
        return f"{told} intersections; trusted at {len(self.acting)} ({shown})"

    def as_dict(self) -> dict[str, float]:
        """Return flat numbers, all named ``residual/...``."""
        numbers = self.fit.as_dict() | {f"trust/{k}": v for k, v in self.trust.as_dict().items()}
        numbers["acting"] = float(len(self.acting))
        return {f"residual/{name}": value for name, value in numbers.items()}


class Residual:
    """Grounding of single actions on top of a fitted street.

    Args:
        transform: f, h and gate.
        config: Settings.
        least_accuracy: Smallest accuracy of h, as in `UgatConfig`.
    """

    def __init__(
        self, transform: Transform, config: ResidualConfig, least_accuracy: float | None
    ) -> None:
        self.transform = transform
        self.config = config
        self._least_accuracy = least_accuracy

    @property
    def acts(self) -> bool:
        """True if some action may be grounded."""
        return self.transform.fitted and bool(self.transform.acting.any())

    def fit(
        self,
        real: TransitionLog,
        world: TransitionLog,
        fitter: Fitter,
        delayed: TransitionLog | None = None,
        earlier: Sequence[TransitionLog] = (),
    ) -> ResidualReport:
        """Fit f to the street and h to the fitted world; ground only where f is better.

        f is compared with the fitted world on logs of one policy, or it would look better for
        having seen where another policy leads.

        Args:
            real: Transitions of the street.
            world: Transitions of the fitted street, under the policy of `real`.
            fitter: Settings, seed and device of the training.
            delayed: The same under random delays, for timed grounding.
            earlier: Transitions of the street under other policies, from which f learns as well.

        Raises:
            LogError: The logs are refused by `Transform.fit`.
        """
        transform, agents = self.transform, self.transform.stack.agents
        known = TransitionLog.concatenate([*earlier, real])
        report = transform.fit(known, delayed or world, fitter, on_top=True)
        trust = compare(transform, real, world, fitter, self.config.trust)
        proven = np.ones(len(agents), bool)
        if self._least_accuracy is not None:
            proven = report.trusted(self._least_accuracy)
        transform.gate.trust(proven)
        transform.restrict(trust.better)
        transform.gate.begin(report.expected_u)
        acting = [a for a, on in zip(agents, transform.acting, strict=True) if on]
        return ResidualReport(report, trust, tuple(acting))

    def rest(self) -> None:
        """Ground no action until the next fit."""
        self.transform.restrict(np.zeros(len(self.transform.stack.agents), bool))

    def around(self, env: AnyParallelEnv) -> AnyParallelEnv:
        """Return the environment with grounded actions; the same if none may be grounded."""
        return GroundedEnv(env, self.transform) if self.acts else env

    def end_iteration(self) -> GateReport:
        """Set alpha for the next iteration and return the decisions of the gate."""
        return self.transform.gate.update()

    def save(self, path: Path) -> None:
        """Write models and gate to a file atomically."""
        self.transform.save(path)

    def load(self, path: Path) -> None:
        """Restore a file of `save`.

        Raises:
            CheckpointError: The file is unreadable, or of other agents or options.
        """
        self.transform.load(path)


def of_one_street(logs: list[TransitionLog]) -> TransitionLog:
    """Return roll-outs in several worlds of a fitted street as one log.

    Their domains differ. Together they are the street, as far as it is known.
    """
    together = [
        TransitionLog(replace(log.provenance, domain="fitted street", scenario_hash=""), log.frame)
        for log in logs
    ]
    return TransitionLog.concatenate(together)
