"""What a fit of timed grounding was worth, measured on episodes it did not see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ugat_marl.grounding.arrays import Floats
from ugat_marl.grounding.fit_report import (
    Calibration,
    ForwardReport,
    TrainingRecord,
    entries,
    said_of,
)
from ugat_marl.grounding.lost_time import LostTime
from ugat_marl.grounding.matching import Matched
from ugat_marl.grounding.uncertainty import MethodName

END_S = 0.5
"""A best delay so close to the longest one tried may well be longer."""


@dataclass(frozen=True)
class DelayReport:
    """Held-out quality of h, per agent where an array; delays and errors in s.

    Attributes:
        training: How the training went.
        error_s: Mean absolute error on the changes it was trained to read, of held-out states.
        error_on_transitions_s: The same on single transitions as they happened, whose noise no
            answer can see through.
        guess_s: Mean absolute error of always answering the middle of the range.
        calibration: u against naming another second, and off the data.
        uncertainty: Where u came from.
    """

    training: TrainingRecord
    error_s: Floats
    error_on_transitions_s: Floats
    guess_s: float
    calibration: Calibration
    uncertainty: MethodName


@dataclass(frozen=True)
class TimedReport:
    """What the parts of timed grounding are worth.

    Attributes:
        agents: Names, the order of all arrays.
        forward: f, on held-out real transitions.
        simulated: The model of the simulation with delays, on held-out simulated transitions.
        lost: The delays that fit the street best.
        inverse: h.
        most_s: Longest delay tried.
        expected_u: Mean u to expect at the gate, per agent: of h's answers to what f predicts where
            greens begin on the street; of all agents where one has none.
        matched: What rewards say of the delays, if they were asked.
    """

    agents: tuple[str, ...]
    forward: ForwardReport
    simulated: ForwardReport
    lost: LostTime
    inverse: DelayReport
    most_s: int
    expected_u: Floats
    matched: Matched | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to doubt the delays; empty if there are none."""
        found = [
            *self.forward.doubts("f", self.agents),
            *self.simulated.doubts("the model of the simulation", self.agents),
            said_of(
                f"too few greens begin to tell how late they are (0 to {self.most_s} s would all "
                "fit; give more roll-outs or longer episodes)",
                self.lost.high_s - self.lost.low_s > self.most_s - END_S,
                self.agents,
            ),
            said_of(
                f"the best delay is the longest tried ({self.most_s} s; raise timed most_s)",
                self._delay_s > self.most_s - END_S,
                self.agents,
            ),
        ]
        if self.inverse.uncertainty == "none":
            found.append("without uncertainty u is 0, and the gate takes every answer of h")
        elif (off := self.inverse.calibration.auroc_off_data) <= 0.5:
            found.append(f"u does not rise off the data (AUROC {off:.2f})")
        return tuple(sentence for sentence in found if sentence)

    @property
    def _delay_s(self) -> Floats:
        """What greens are late by in the mean, per agent."""
        beyond_s = 0.0 if self.matched is None else self.matched.beyond_s
        return self.lost.best_s * self._found + beyond_s

    @property
    def _found(self) -> NDArray[np.bool_]:
        """Where there is a lost time, by models that have learnt something."""
        return self.forward.learnt & self.simulated.learnt & self.lost.shown

    def trusted(self, least_accuracy: float = 0.0) -> NDArray[np.bool_]:
        """Agents whose h may be obeyed, for `Gate.trust`; the others take the best constant.

        f and the model of the simulation have learnt something, there is a lost time for h to
        refine, and h, on its own task, beats a guess by the share `least_accuracy`.
        """
        return self._found & (self.inverse.error_s < (1.0 - least_accuracy) * self.inverse.guess_s)

    def as_dict(self) -> dict[str, float]:
        """Flat numbers; arrays as their mean over agents and as one entry per agent."""
        numbers: dict[str, float] = {}
        for prefix, part in (("forward", self.forward), ("simulated", self.simulated)):
            numbers |= part.training.as_dict(prefix)
            for name in ("error", "no_change", "mean_outcome", "ratio"):
                numbers |= entries(f"{prefix}/{name}", getattr(part, name), self.agents)
        numbers |= self.inverse.training.as_dict("inverse")
        for name in ("error_s", "error_on_transitions_s"):
            numbers |= entries(f"inverse/{name}", getattr(self.inverse, name), self.agents)
        numbers["inverse/guess_s"] = self.inverse.guess_s
        for name in ("best_s", "low_s", "high_s"):
            numbers |= entries(f"lost_time/{name}", getattr(self.lost, name), self.agents)
        if self.matched is not None:
            numbers |= entries("lost_time/matched_s", self.matched.delay_s, self.agents)
            numbers |= entries("lost_time/beyond_s", self.matched.beyond_s, self.agents)
            numbers["lost_time/chance"] = self.matched.chance
        return numbers | self.inverse.calibration.as_dict()


def mean_error(found_s: Tensor, true_s: Tensor, weight: Tensor) -> Floats:
    """Mean absolute error per agent, ``(agents,)``; NaN without rows."""
    total = ((found_s - true_s).abs() * weight).sum(1).double()
    return (total / weight.sum(1).double()).numpy()
