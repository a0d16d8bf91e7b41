"""Gate: the choice between the policy's action and the grounded action, per agent and step.

The gate takes a grounded action where the uncertainty u of h is below the threshold alpha. In UGAT
alpha starts at infinity, so every grounded action is taken. Later alpha is the mean of the logged
u. Alpha can also start at the mean u of the first fit. The paper's ablations have a fixed alpha, or
an infinite one (GAT, no gate). Where every u was 0, alpha keeps its value.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ugat_marl.errors import CheckpointError, OptionError, require_kinds, require_ranges
from ugat_marl.grounding.reports import complaint
from ugat_marl.policies import Usual, UsualName, UsualNumber, UsualValue

_INTERSECTION: Any = UsualName("intersection")


@dataclass(frozen=True)
class GateConfig:
    """Settings of alpha.

    Attributes:
        mode: "infinite" takes every grounded action, "static" compares with `static_alpha`,
            "dynamic" with the mean of the u logged before the last update.
        static_alpha: Threshold in (0, 1], for mode "static".
        scope: One alpha per intersection, or one pooled over all.
        window_epochs: Number of the last epochs (episodes of grounded training) whose u enter the
            mean. Epochs of earlier iterations count, too.
        start: Alpha of "dynamic" before any u is logged: "open" is infinite, as in the paper;
            "fitted" is the mean u of h's answers to the predictions of f after the first fit.
        uncertainty_of: The u that is compared: "h-after-f" asks h for the prediction of every
            network of f, and counts their disagreement; "h" asks it for their mean, as in the
            paper. With one network (`forward.members`) both are the same.
    """

    mode: Literal["infinite", "static", "dynamic"] = "dynamic"
    static_alpha: float = UsualNumber(0.5)
    scope: Literal["intersection", "pooled"] = _INTERSECTION
    window_epochs: int = Usual(20)
    start: Literal["open", "fitted"] = "open"
    uncertainty_of: Literal["h-after-f", "h"] = "h-after-f"

    def __post_init__(self) -> None:
        require_kinds(self, "gate")
        if not 0.0 < self.static_alpha <= 1.0:
            raise OptionError(f"gate static_alpha is {self.static_alpha}; allowed: in (0, 1]")
        require_ranges(self, "gate", at_least={"window_epochs": 1})

    def require_settings_count(self, *, also_dynamic: bool = False) -> None:
        """Refuse settings that the mode would ignore.

        Args:
            also_dynamic: True if a dynamic alpha is trained beside the one of `mode`.

        Raises:
            OptionError: `static_alpha` is given and no alpha is static, or `window_epochs` and no
                alpha is dynamic.
        """
        modes = {self.mode, "dynamic"} if also_dynamic else {self.mode}
        for name, mode in (("static_alpha", "static"), ("window_epochs", "dynamic")):
            value = getattr(self, name)
            if mode not in modes and not isinstance(value, UsualValue):
                raise OptionError(
                    f"--gate.{name.replace('_', '-')} {value:g} counts with --gate.mode {mode} "
                    f"alone, not {self.mode}; give that mode, or leave it out"
                )


@dataclass(frozen=True)
class GateReport:
    """Decisions of the gate since the last update; arrays over the agents.

    Attributes:
        agents: Names of the agents.
        iteration: Number of updates before these decisions.
        decisions: Number of decisions.
        alpha: Threshold of these decisions.
        acceptance: Share of decisions in which the grounded action was taken.
        mean_u: Mean uncertainty, in [0, 1].
        change_rate: Share of decisions with a grounded action other than the policy's.
        trusted: True for agents whose grounded actions may be taken (`Gate.trust`).
        warning: A sentence if the gate accepted everything or nothing, else "".
    """

    agents: tuple[str, ...]
    iteration: int
    decisions: NDArray[np.int64]
    alpha: NDArray[np.float64]
    acceptance: NDArray[np.float64]
    mean_u: NDArray[np.float64]
    change_rate: NDArray[np.float64]
    trusted: NDArray[np.bool_]
    warning: str

    def as_dict(self) -> dict[str, float]:
        """Return flat numbers: means over agents, and the same per agent."""
        numbers: dict[str, float] = {"decisions": float(self.decisions.sum())}
        for name in ("alpha", "acceptance", "mean_u", "change_rate", "trusted"):
            values: NDArray[Any] = getattr(self, name)
            numbers[name] = float(values.mean())
            numbers |= {f"{name}/{a}": float(v) for a, v in zip(self.agents, values, strict=True)}
        return numbers


class Gate:
    """Threshold alpha of every agent: accepts or refuses grounded actions, and counts them.

    Args:
        agents: Names, in the order of all arrays.
        config: Settings.
    """

    def __init__(self, agents: Sequence[str], config: GateConfig) -> None:
        self.agents = tuple(agents)
        self.config = config
        start = config.static_alpha if config.mode == "static" else np.inf
        self.alpha: NDArray[np.float64] = np.full(len(self.agents), start)
        self.trusted: NDArray[np.bool_] = np.ones(len(self.agents), bool)
        self.iteration = 0
        # Line 7 of Algorithm 1: the list U forgets what is older than the window.
        self._epochs: deque[NDArray[np.float64]] = deque(maxlen=config.window_epochs)
        self._running = np.zeros((2, len(self.agents)))  # sum and number of u in this epoch
        self._counts = np.zeros((4, len(self.agents)))  # decisions, accepted, changed, sum of u

    def trust(self, agents: NDArray[np.bool_]) -> None:
        """Set the agents, ``(agents,)`` bool, whose grounded actions may be taken.

        Alpha is infinite at first, so the gate would take every answer of a poor h. All agents are
        trusted until this is called; `FitReport.trusted` gives the agents to trust.
        """
        self.trusted = np.asarray(agents, bool).copy()

    def begin(self, mean_u: NDArray[np.float64]) -> None:
        """Set the first alpha of a gate that starts "fitted"; later iterations use logged u.

        Args:
            mean_u: ``(agents,)`` mean u to expect; where it is 0, alpha is infinite.
        """
        if self.config.mode != "dynamic" or self.config.start != "fitted" or self.iteration:
            return
        expected = np.full_like(mean_u, mean_u.mean()) if self._pooled else mean_u
        self.alpha = np.where(expected > 0, expected, np.inf)

    @property
    def _pooled(self) -> bool:
        return self.config.scope == "pooled"

    def accepts(
        self, u: NDArray[np.floating[Any]], permitted: NDArray[np.bool_] | None = None
    ) -> NDArray[np.bool_]:
        """Return true where `decide` would take the grounded action; nothing is logged."""
        accepted = (u < self.alpha) & self.trusted
        return accepted if permitted is None else accepted & permitted

    def decide(
        self,
        u: NDArray[np.floating[Any]],
        action: NDArray[np.int64],
        grounded: NDArray[np.int64],
        permitted: NDArray[np.bool_] | None = None,
        asked: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.bool_]:
        """Decide which grounded actions are taken; log u and count.

        Args:
            u: ``(agents,)`` uncertainties.
            action: ``(agents,)`` the policy's actions.
            grounded: ``(agents,)`` the grounded actions.
            permitted: ``(agents,)`` false where the grounded action is masked out.
            asked: ``(agents,)`` false where there is nothing to ground; these are not logged.

        Returns:
            ``(agents,)`` bool: u < alpha, and the agent is permitted, asked and trusted.
        """
        accepted = self.accepts(u, permitted)
        one = np.ones_like(u) if asked is None else asked.astype(u.dtype)
        accepted = accepted & (one > 0)
        self._running += (u * one, one)
        self._counts += (one, accepted, accepted & (action != grounded), u * one)
        return accepted

    def end_epoch(self) -> None:
        """Close an epoch and add its u to the window; an epoch without decisions is not added."""
        if self._running[1].any():
            self._epochs.append(self._running)
            self._running = np.zeros_like(self._running)

    @contextlib.contextmanager
    def uncounted(self) -> Iterator[None]:
        """Leave the decisions of a block out: alpha follows those of the learner alone."""
        state = self.state_dict()
        try:
            yield
        finally:
            self.load_state_dict(state)

    def update(self) -> GateReport:
        """End an iteration: report, set a dynamic alpha to mean(u), and reset the counts."""
        self.end_epoch()
        report = self.report()
        if self.config.mode == "dynamic" and self._epochs:
            total = np.sum(self._epochs, axis=0)
            if self._pooled:
                total = np.broadcast_to(total.sum(1, keepdims=True), total.shape)
            self.alpha = np.divide(total[0], total[1], out=self.alpha.copy(), where=total[0] > 0)
        self._counts = np.zeros_like(self._counts)
        self.iteration += 1
        return report

    def report(self) -> GateReport:
        """Return the decisions since the last update."""
        decisions, accepted, changed, total = self._counts
        count = np.maximum(decisions, 1.0)
        return GateReport(
            agents=self.agents,
            iteration=self.iteration,
            decisions=decisions.astype(np.int64),
            alpha=self.alpha.copy(),
            acceptance=accepted / count,
            mean_u=total / count,
            change_rate=changed / count,
            trusted=self.trusted.copy(),
            warning=self._warning(accepted, decisions),
        )

    def _warning(self, accepted: NDArray[np.float64], decisions: NDArray[np.float64]) -> str:
        if self.iteration == 0 or self.config.mode == "infinite":
            return ""
        parts: list[str] = []
        for share, everywhere in (
            ("no grounded action was taken", accepted == 0),
            ("every grounded action was taken", accepted == decisions),
        ):
            warned = everywhere & (decisions > 0) & self.trusted
            if warned.any():
                parts.append(complaint(share, warned, self.agents))
        if not parts:
            return ""
        return (
            f"iteration {self.iteration + 1}: {'; '.join(parts)}: the gate does not discriminate "
            "there; look at alpha and the calibration of u in the report"
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state, from which a gate continues without a difference."""
        epochs = np.array(self._epochs).reshape(-1, 2, len(self.agents))
        return {
            "agents": list(self.agents),
            "iteration": self.iteration,
            # Checkpoints hold finite numbers only; where the gate is open, alpha is infinite.
            "alpha": torch.from_numpy(np.where(np.isinf(self.alpha), 0.0, self.alpha)),
            "open": torch.from_numpy(np.isinf(self.alpha)),
            "trusted": torch.from_numpy(self.trusted.copy()),
            "epochs": torch.from_numpy(epochs),
            "running": torch.from_numpy(self._running.copy()),
            "counts": torch.from_numpy(self._counts.copy()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict`; a gate whose alpha does not move keeps its own.

        Raises:
            CheckpointError: The state has other agents, is incomplete or has impossible numbers.
        """
        if state.get("agents") != list(self.agents):
            raise CheckpointError(
                "the gate in the checkpoint belongs to other agents; start a new run"
            )
        count = len(self.agents)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("alpha", "open", "trusted"), (count,))
        shapes |= {"running": (2, count), "counts": (4, count)}
        epochs = state.get("epochs")
        shapes["epochs"] = (len(epochs) if isinstance(epochs, torch.Tensor) else 0, 2, count)
        arrays: dict[str, NDArray[np.float64]] = {}
        for name, shape in shapes.items():
            value = state.get(name)
            if not isinstance(value, torch.Tensor) or tuple(value.shape) != shape:
                raise CheckpointError(f"the gate in the checkpoint has no {name} of shape {shape}")
            if not torch.isfinite(value).all() or bool((value < 0).any()):
                raise CheckpointError(f"the gate in the checkpoint has an impossible {name}")
            arrays[name] = value.numpy().astype(np.float64)
        iteration = state.get("iteration")
        if not isinstance(iteration, int) or iteration < 0:
            raise CheckpointError(f"the gate in the checkpoint has iteration {iteration!r}")
        if self.config.mode == "dynamic":
            self.alpha = np.where(arrays["open"] > 0, np.inf, arrays["alpha"])
        self.trusted = arrays["trusted"] > 0
        self._running, self._counts = arrays["running"], arrays["counts"]
        self._epochs = deque(arrays["epochs"], maxlen=self.config.window_epochs)
        self.iteration = iteration
