"""Reports of a fit: held-out errors of f, calibration of u, and the base of all reports.

Numbers are measured on held-out rows, from which no weight was learnt. The same rows choose the
epoch whose weights are kept, so errors come out a little too small. Exceptions are lost times and u
of timed grounding, which are means over all greens of the street's log.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import stdtr
from torch import Tensor

from ugat_marl.errors import first_names
from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.grounding.uncertainty import InversePrediction, MethodName

Floats = NDArray[np.float64]
Numbers = NDArray[np.floating] | NDArray[np.integer] | NDArray[np.bool_]

QUANTILES = 5
"""Number of groups of rising u for error rates."""

MARGIN = 0.05
"""Share by which the squared error of f must be below that of a trivial answer. Held-out rows
choose its epoch: on 60 or more shuffled ones it was up to 5 % better than the mean outcome."""
LEVEL = 0.05
"""Chance that f passes at an intersection where it is not better by the margin, or h where it is
not better at all. The margin alone does not do: on 30 shuffled rows the best epoch was up to 17 %
better."""
BLOCK = 15
"""Held-out decisions of a block. Neighbouring decisions are not independent, so tests compare the
means of blocks. An hour holds out 90 decisions, of which doubled blocks would be too few."""

# --- calibration statistics


def spearman(one: Numbers, other: Numbers) -> float:
    """Return the rank correlation of two samples; NaN if one of them is constant, or empty."""
    if not len(one):
        return float("nan")
    a, b = _ranks(one), _ranks(other)
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum() / norm) if norm > 0 else float("nan")


def auroc(score: Numbers, positive: NDArray[np.bool_]) -> float:
    """Return the probability that a positive scores above a negative; ties count half.

    This is the statistic of Mann and Whitney over the number of pairs; NaN without positives or
    without negatives.
    """
    pairs = int(positive.sum()) * int((~positive).sum())
    if not pairs:
        return float("nan")
    least = positive.sum() * (positive.sum() + 1) / 2  # of the sum of the positives' ranks
    return float((_ranks(score)[positive].sum() - least) / pairs)


def _ranks(values: Numbers) -> Floats:
    """Return the rank of each value from 1 on; equal values share their mean rank.

    All ranks are NaN if a value is.
    """
    if np.isnan(values).any():
        return np.full(len(values), np.nan)
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - 0.5 * (counts - 1))[place]


def rate_by_quantile(score: Numbers, hit: NDArray[np.bool_], bins: int) -> tuple[float, ...]:
    """Return the share of hits in `bins` equally filled groups of rising score.

    NaN for an empty group.
    """
    order = np.argsort(score, kind="stable")
    groups = np.array_split(hit[order], bins)
    return tuple(float(group.mean()) if len(group) else float("nan") for group in groups)


def risk_by_coverage(u: Numbers, wrong: NDArray[np.bool_], bins: int) -> tuple[float, ...]:
    """Return the error rate among the 1/bins, 2/bins, ... of the answers with the lowest u.

    This is the risk-coverage curve of selective classification (El-Yaniv and Wiener, JMLR 2010): a
    gate that accepts this share of the answers has this error rate. Answers with equal u share
    their errors evenly, so the curve is flat for a constant u. NaN for a share without an answer.
    """
    _, group, counts = np.unique(u, return_inverse=True, return_counts=True)
    rate = np.bincount(group, weights=wrong) / counts
    errors = np.concatenate([[0.0], np.cumsum(np.repeat(rate, counts))])
    shares = [round(len(u) * (i + 1) / bins) for i in range(bins)]
    return tuple(float(errors[n] / n) if n else float("nan") for n in shares)


def p_of_mean(values: Floats, group: NDArray[np.int64]) -> float:
    """Return the p-value of "the mean is not above 0", if only groups are independent.

    A group with few decisions counts for little: the mean is a ratio of sums, and its deviations
    are those of its linearisation.
    """
    sizes = np.bincount(group)
    if (sizes > 0).sum() < 2:
        return 1.0  # one group says nothing of how groups differ
    total, number = (np.bincount(group, weights=w)[sizes > 0] for w in (values, None))
    mean = float(values.mean())
    deviation = (total - mean * number) / number.mean()
    spread = float(np.sqrt((deviation**2).sum() / (len(total) - 1) / len(total)))
    if spread == 0.0:
        return float(mean <= 0.0)
    return float(stdtr(len(total) - 1, -mean / spread))


def blocks_of(rows: Tensor, size: int) -> Tensor:
    """Return the number of each row's block of consecutive rows, ``(agents, n)`` int64.

    An agent's last block takes the rest. It is -1 for what is no row.

    Args:
        rows: ``(agents, n)`` weights of the rows, in the order of time; 0 for what is no row.
        size: Number of rows of a block.
    """
    place = rows.bool().cumsum(1) - 1
    last = (rows.bool().sum(1, keepdim=True) // size - 1).clamp(min=0)
    return torch.where(rows.bool(), (place // size).minimum(last), -1)


def better_than_chance(gain: Tensor, held_out: Tensor) -> NDArray[np.bool_]:
    """Return the agents whose mean gain is above 0 by more than chance at `LEVEL`, ``(agents,)``.

    An agent with fewer than two blocks of held-out rows is not among them.

    Args:
        gain: ``(agents, n)`` by how much the answer to each row is better than a trivial one.
        held_out: ``(agents, n)`` weights of the held-out rows, in the order of time.
    """
    blocks, kept = blocks_of(held_out, BLOCK).numpy(), held_out.bool().numpy()
    each = zip(gain.double().numpy(), blocks, kept, strict=True)
    return np.array([p_of_mean(own[rows], block[rows]) < LEVEL for own, block, rows in each])


def expected_calibration_error(
    confidence: Numbers, correct: NDArray[np.bool_], bins: int = 15
) -> float:
    """Return the mean distance of confidence from accuracy over equally wide bins of confidence.

        sum over bins of |sum of (confidence - correct) in the bin| / number of answers

    Guo, Pleiss, Sun, Weinberger, "On Calibration of Modern Neural Networks", ICML 2017, equation 3,
    with their 15 bins. Confidence is the probability of the answer; NaN without answers.
    """
    if not len(correct):
        return float("nan")
    place = np.clip(np.ceil(confidence * bins).astype(int) - 1, 0, bins - 1)
    surplus = np.bincount(place, weights=confidence - correct, minlength=bins)
    return float(np.abs(surplus).sum() / len(correct))


# --- numbers and sentences of a report


def flat(name: str, values: Floats, agents: Sequence[str]) -> dict[str, float]:
    """Return an array over agents as flat numbers: its mean, and one entry per agent."""
    known = values[~np.isnan(values)]
    numbers = {name: float(known.mean()) if len(known) else float("nan")}
    by_agent = zip(agents, values, strict=True)
    return numbers | {f"{name}/{agent}": float(value) for agent, value in by_agent}


def complaint(text: str, where: NDArray[np.bool_], agents: Sequence[str]) -> str:
    """Return a sentence about the agents that `where`, ``(agents,)``, marks; empty if none."""
    names = [agent for agent, marked in zip(agents, where, strict=True) if marked]
    return f"{text} at {len(names)} of {len(agents)} ({first_names(names)})" if names else ""


def mean_of_known(u: Floats) -> Floats:
    """Return u per agent with NaN replaced by the mean of the others, or by 1 if all are NaN."""
    known = u[~np.isnan(u)]
    return np.where(np.isnan(u), known.mean() if known.size else 1.0, u)


# --- parts of a report


@dataclass(frozen=True)
class TrainingRecord:
    """Course of a training.

    Attributes:
        epochs: Number of epochs run.
        train_loss: Mean training loss of the last epoch, over agents.
        held_out_loss: Mean held-out loss of the kept weights.
        split: "episodes", or "steps" if the log has only one episode.
    """

    epochs: int
    train_loss: float
    held_out_loss: float
    split: str

    def as_dict(self, prefix: str) -> dict[str, float]:
        """Return epochs and losses as flat numbers."""
        return {
            f"{prefix}/epochs": float(self.epochs),
            f"{prefix}/train_loss": self.train_loss,
            f"{prefix}/held_out_loss": self.held_out_loss,
        }


@dataclass(frozen=True)
class ForwardReport:
    """Held-out error of f, per agent: root mean squares in the unit of the features.

    Attributes:
        training: Course of the training.
        error: Error of f.
        no_change: Error of the prediction that nothing changes.
        mean_outcome: Error of the mean next features in training as the constant prediction.
        beats_no_change: Agents whose f is better than no change by more than `MARGIN` and chance.
        beats_mean_outcome: The same against the mean outcome.
    """

    training: TrainingRecord
    error: Floats
    no_change: Floats
    mean_outcome: Floats
    beats_no_change: NDArray[np.bool_]
    beats_mean_outcome: NDArray[np.bool_]

    @property
    def ratio(self) -> Floats:
        """Ratio error / no_change, per agent; below 1, f is better than predicting no change."""
        return self.error / np.maximum(self.no_change, 1e-12)

    @property
    def learnt(self) -> NDArray[np.bool_]:
        """Agents whose f beats no change and the mean outcome.

        On shuffled rows f beats no change, but not the mean outcome.
        """
        return self.beats_no_change & self.beats_mean_outcome

    def doubts(self, model: str, agents: Sequence[str]) -> Iterator[str]:
        """Yield sentences about problems of the model of this name; some of them are empty."""
        poor = ~self.beats_no_change
        mixed = self.beats_no_change & ~self.beats_mean_outcome
        yield complaint(f"{model} is not shown to be better than no change", poor, agents)
        yield complaint(
            f"{model} is not shown to be better than one answer for every state", mixed, agents
        )

    def as_dict(self, prefix: str, agents: Sequence[str]) -> dict[str, float]:
        """Return training and errors as flat numbers."""
        numbers = self.training.as_dict(prefix)
        for name in ("error", "no_change", "mean_outcome", "ratio"):
            numbers |= flat(f"{prefix}/{name}", getattr(self, name), agents)
        return numbers


@torch.no_grad()
def forward_report(
    model: ForwardModel,
    predicted: Tensor,
    happened: Tensor,
    off_mean: Tensor,
    held_out: Tensor,
    training: TrainingRecord,
) -> ForwardReport:
    """Measure predicted changes on held-out rows.

    Args:
        model: Model of changes.
        predicted: ``(agents, n, outputs)`` predicted changes.
        happened: ``(agents, n, outputs)`` true changes.
        off_mean: ``(agents, n, outputs)`` next features minus their mean in training.
        held_out: ``(agents, n)`` weights of the held-out rows, in the order of time.
        training: Course of the training.
    """
    outputs = model.valid_outputs.sum(-1).double()
    kept = held_out.bool().numpy()

    def squares(error: Tensor) -> Tensor:
        """Return the squared error of each row, ``(agents, n)``."""
        return (error.double() ** 2).sum(-1) / outputs

    def root(rows: Tensor) -> Floats:
        return np.sqrt([own[on].mean() for own, on in zip(rows.numpy(), kept, strict=True)])

    def beats(trivial: Tensor) -> NDArray[np.bool_]:
        return better_than_chance((1 - MARGIN) * trivial - own, held_out)

    own, no_change, mean_outcome = map(squares, (predicted - happened, happened, off_mean))
    return ForwardReport(
        training=training,
        error=root(own),
        no_change=root(no_change),
        mean_outcome=root(mean_outcome),
        beats_no_change=beats(no_change),
        beats_mean_outcome=beats(mean_outcome),
    )


@dataclass(frozen=True)
class UncertaintyQuality:
    """Quality of u over all agents together: wrong answers and inputs off the data need a high u.

    Attributes:
        spearman: Rank correlation of u with wrong answers.
        auroc: Probability that u is higher for a wrong answer than for a right one.
        error_by_quantile: Error rate in fifths of rising u.
        risk_by_coverage: Error rate of the fifth with the lowest u, of two fifths, ..., of all.
        ece: Expected calibration error of the probability of the answer.
        mean_u: Mean u on held-out data.
        mean_u_off_data: Mean u on states and changes drawn around the data (`OffData`).
        auroc_off_data: Probability that u is higher off the data than on it.
    """

    spearman: float
    auroc: float
    error_by_quantile: tuple[float, ...]
    risk_by_coverage: tuple[float, ...]
    ece: float
    mean_u: float
    mean_u_off_data: float
    auroc_off_data: float

    @classmethod
    def of(
        cls,
        answer: InversePrediction,
        wrong: Tensor,
        held_out: Tensor,
        off_data: InversePrediction,
    ) -> UncertaintyQuality:
        """Measure answers on held-out rows and answers off the data.

        Args:
            answer: Answers to all rows, ``(agents, n)``.
            wrong: ``(agents, n)`` bool, true for wrong answers.
            held_out: ``(agents, n)`` bool, true for held-out rows.
            off_data: Answers to invented rows.
        """
        on_u, on_wrong = answer.u[held_out].numpy(), wrong[held_out].numpy()
        off_u = off_data.u.flatten().numpy()
        both = np.concatenate([on_u, off_u])
        likeliest = answer.probability.amax(-1)[held_out].numpy()
        return cls(
            spearman=spearman(on_u, on_wrong),
            auroc=auroc(on_u, on_wrong),
            error_by_quantile=rate_by_quantile(on_u, on_wrong, QUANTILES),
            risk_by_coverage=risk_by_coverage(on_u, on_wrong, QUANTILES),
            ece=expected_calibration_error(likeliest, ~on_wrong),
            mean_u=float(on_u.mean()) if len(on_u) else math.nan,
            mean_u_off_data=float(off_u.mean()),
            auroc_off_data=auroc(both, np.arange(len(both)) >= len(on_u)),
        )

    def as_dict(self) -> dict[str, float]:
        """Return flat numbers, one entry per fifth."""
        numbers: dict[str, float] = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, tuple):
                for i, rate in enumerate(value):
                    numbers[f"calibration/{entry.name}/{i}"] = rate
            else:
                numbers[f"calibration/{entry.name}"] = value
        return numbers


@dataclass(frozen=True)
class InverseReport(abc.ABC):
    """Held-out quality of h.

    Attributes:
        training: Course of the training.
        calibration: Quality of u, pooled over agents.
        uncertainty: Method of uncertainty.
    """

    training: TrainingRecord
    calibration: UncertaintyQuality
    uncertainty: MethodName

    @abc.abstractmethod
    def as_dict(self, agents: Sequence[str]) -> dict[str, float]:
        """Return everything as flat numbers; arrays as their mean and one entry per agent."""


@dataclass(frozen=True)
class FitReport(abc.ABC):
    """Quality of f and h after a fit, alone and together.

    Attributes:
        agents: Names of the agents, in the order of all arrays.
        forward: Errors of f on held-out real transitions.
        inverse: Quality of h on held-out simulated transitions.
        mean_u_on_predictions: Per agent, mean u of h's answers to predictions of f, as the gate
            gets them. NaN for an agent without such rows.
    """

    agents: tuple[str, ...]
    forward: ForwardReport
    inverse: InverseReport
    mean_u_on_predictions: Floats

    @property
    def calibration(self) -> UncertaintyQuality:
        """Quality of u."""
        return self.inverse.calibration

    @property
    def expected_u(self) -> Floats:
        """Mean u to expect at the gate, per agent; the mean of the others for one without rows."""
        return mean_of_known(self.mean_u_on_predictions)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to doubt the grounded actions; empty if there are none."""
        return tuple(sentence for sentence in self.doubts() if sentence)

    @abc.abstractmethod
    def doubts(self) -> Iterator[str]:
        """Yield sentences about problems; some of them are empty."""

    @abc.abstractmethod
    def trusted(self, least_accuracy: float = 0.0) -> NDArray[np.bool_]:
        """Return true for trusted agents, ``(agents,)`` bool, for `Gate.trust`.

        Args:
            least_accuracy: Required quality of h, from 0 to 1; 0 requires only that the models beat
                trivial answers.
        """

    @abc.abstractmethod
    def as_dict(self) -> dict[str, float]:
        """Return flat numbers; arrays as their mean over agents and as one entry per agent."""
