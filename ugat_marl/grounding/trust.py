"""Trust in f: the intersections where it predicts the street better than the fitted world does.

Two models predict decisions of the street that neither has seen. Both begin as the same model of
the fitted world, and both learn on from as many decisions: f from the street, its twin from the
fitted world. If the world explains the street, nothing tells them apart. f is trusted where its
errors are smaller by more than a margin and by more than chance:

    d     = (1 - margin) * squared error of the twin - squared error of f
    trust = mean of d > 0, by t-tests over blocks of decisions and over folds

The street's log is cut into folds, and each is predicted by models that were fitted without it.
Neighbouring decisions are not independent, so one test compares the means of blocks. Decisions of a
fold share their models, and two fits to equal data differ. So another test compares the means of
folds, and the larger p counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ugat_marl.data import TransitionLog
from ugat_marl.errors import require_kinds, require_ranges
from ugat_marl.grounding.fitting import Changes, Fitter, Split
from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.grounding.reports import Floats, blocks_of, flat, p_of_mean
from ugat_marl.grounding.stacked import alike, stack_log
from ugat_marl.grounding.transform import Transform
from ugat_marl.policies import one_thread
from ugat_marl.seeding import derive_seed, torch_generator

BLOCK = 30
"""Decisions of a block. Halved, errors of neighbouring blocks are less independent; doubled, there
are too few blocks in an hour."""
LEAST_BLOCKS = 6
"""Fewest blocks of decisions from which anything is concluded."""
STOPPING = 4
"""n; every n-th block that a model may see decides when its training ends."""


@dataclass(frozen=True)
class TrustConfig:
    """Settings of the comparison of f and the fitted world.

    Attributes:
        margin: Share by which the squared error of f must be smaller.
        level: Chance to trust f at one of the intersections if it is not better anywhere. The test
            of each intersection has this level divided by their number (Bonferroni).
        folds: Parts of the street's log of which each is predicted by models fitted to the others.
    """

    margin: float = 0.05
    level: float = 0.05
    folds: int = 5

    def __post_init__(self) -> None:
        require_kinds(self, "trust")
        require_ranges(self, "trust", at_least={"folds": 2}, below_one=("margin", "level"))


@dataclass(frozen=True)
class Trust:
    """Comparison of f and the fitted world on the street; arrays ``(agents,)``.

    Attributes:
        agents: Names of the agents.
        error: Root mean square error of f on decisions that it has not seen, in units of features.
        world_error: The same of the fitted world; NaN where there are too few decisions.
        p: Chance of a difference as large if f were not better by the margin.
        better: True where f is trusted.
    """

    agents: tuple[str, ...]
    error: Floats
    world_error: Floats
    p: Floats
    better: NDArray[np.bool_]

    @classmethod
    def nowhere(cls, agents: tuple[str, ...]) -> Trust:
        """Return a comparison for which there are too few decisions."""
        unknown = np.full(len(agents), np.nan)
        return cls(agents, unknown, unknown, np.ones(len(agents)), np.zeros(len(agents), bool))

    def as_dict(self) -> dict[str, float]:
        """Return flat numbers; arrays as their mean over agents and as one entry per agent."""
        numbers: dict[str, float] = {}
        for name, values in (
            ("trusted", self.better.astype(float)),
            ("error", self.error),
            ("world_error", self.world_error),
            ("p", self.p),
        ):
            numbers |= flat(name, values, self.agents)
        return numbers


@dataclass(frozen=True)
class _Part:
    """Data of a fit, in blocks.

    Attributes:
        training_data: Data from which a model learns.
        rows: ``(agents, n)`` 1 for a row, 0 for padding.
        weight: ``(agents, n)`` 1 for decisions that are compared.
        block: ``(agents, n)`` int64, number of the row's block; -1 in padding.
    """

    training_data: Changes
    rows: Tensor
    weight: Tensor
    block: Tensor

    @property
    def blocks(self) -> Tensor:
        """Number of blocks of each agent, ``(agents, 1)``."""
        return self.block.amax(1, keepdim=True) + 1

    def split(self, use: Tensor, most: Tensor) -> Split:
        """Return rows of at most `most` blocks, ``(agents, 1)``, evenly among those in `use`."""
        rows = torch.zeros_like(self.rows)
        stops = torch.zeros_like(self.rows)
        for i, own in enumerate(self.block):
            there = torch.unique(own[use[i] & (own >= 0)])
            count = min(len(there), int(most[i]))
            places = torch.linspace(0, len(there) - 1, count).round().long()
            kept = there[places]
            rows[i] = torch.isin(own, kept)
            stops[i] = torch.isin(own, kept[1::STOPPING])
        return Split(rows - stops, stops, "blocks")


@one_thread()
def compare(
    transform: Transform,
    real: TransitionLog,
    world: TransitionLog,
    fitter: Fitter,
    config: TrustConfig,
) -> Trust:
    """Compare f with the fitted world on the street.

    Args:
        transform: f and its inputs; it stays as it is.
        real: Transitions of the street.
        world: Transitions of the fitted street, without random delays.
        fitter: Settings, seed and device of the training.
        config: Settings.

    Raises:
        LogError: A log has other agents, or is too short to be split.
    """
    stack = transform.stack
    street, simulated = (
        _part(transform.training_data(data), data.weight)
        for data in alike(stack_log(real, stack), stack_log(world, stack))
    )
    if min(int(street.blocks.min()), int(simulated.blocks.min()) // 2) < LEAST_BLOCKS:
        return Trust.nowhere(stack.agents)

    def model() -> ForwardModel:
        one = replace(transform.forward.config, members=1)
        generator = torch_generator(fitter.seed, "trust", "weights")
        return ForwardModel(stack, one, generator, view=transform.forward.view)

    def errors(fitted: ForwardModel) -> Tensor:
        """Return mean squared errors on the street, ``(agents, n)``."""
        training_data = street.training_data
        with torch.no_grad():
            inputs = fitted.inputs(training_data.observation, training_data.action)
            predicted = fitted.read_all(inputs) * fitted.scale
        happened = fitted.change(training_data.observation, training_data.outcome)
        return ((predicted - happened) ** 2).sum(-1) / fitted.valid_outputs.sum(-1)

    first = simulated.block < simulated.blocks // 2
    start, every = model(), simulated.blocks
    fitter.fit_changes(start, simulated.training_data, simulated.split(first, every))
    of_street = _folds(street.block, torch.zeros_like(street.blocks), config.folds)
    of_world = _folds(simulated.block, simulated.blocks // 2, config.folds)
    found = torch.zeros(2, *street.rows.shape)
    for fold, (test, left) in enumerate(zip(of_street, of_world, strict=True)):
        own = replace(fitter.further(), seed=derive_seed(fitter.seed, "trust", fold))
        most = torch.minimum(_number(street, ~test), _number(simulated, ~first & ~left))
        for place, (part, use) in enumerate(((street, ~test), (simulated, ~first & ~left))):
            fitted = model()
            fitted.begin_as(start)
            own.fit_changes(fitted, part.training_data, part.split(use, most))
            found[place] = torch.where(test, errors(fitted), found[place])
    fold = torch.stack([test * number for number, test in enumerate(of_street)]).sum(0)
    return _tested(stack.agents, found, street, fold, config)


def _part(training_data: tuple[Changes, Tensor], rows: Tensor) -> _Part:
    """Return the data of a fit in blocks; the last block of an agent takes the rest."""
    learnt, weight = training_data
    return _Part(learnt, rows, weight, blocks_of(rows, BLOCK))


def _folds(block: Tensor, first: Tensor, folds: int) -> list[Tensor]:
    """Return the rows of each fold, ``(agents, n)`` bool: consecutive blocks from `first` on."""
    blocks = block.amax(1, keepdim=True) + 1 - first
    fold = torch.where(block >= first, (block - first) * folds // blocks, -1)
    return [fold == number for number in range(folds)]


def _number(part: _Part, use: Tensor) -> Tensor:
    """Return the number of blocks of each agent among some rows, ``(agents, 1)``."""
    rows = zip(part.block, use, strict=True)
    counts = [len(torch.unique(own[on & (own >= 0)])) for own, on in rows]
    return torch.tensor(counts)[:, None]


def _tested(
    agents: tuple[str, ...], found: Tensor, street: _Part, fold: Tensor, config: TrustConfig
) -> Trust:
    """Test squared errors ``(2, agents, n)`` of f and its twin, by blocks and by folds."""
    own, twin = found.double().numpy()
    surplus = (1.0 - config.margin) * twin - own
    p = np.ones(len(agents))
    means = np.full((2, len(agents)), np.nan)
    for i in range(len(agents)):
        counted = street.weight[i].bool().numpy()
        if not counted.any():
            continue
        means[:, i] = own[i, counted].mean(), twin[i, counted].mean()
        block, part = (groups[i].numpy()[counted] for groups in (street.block, fold))
        if len(np.unique(block)) >= LEAST_BLOCKS:
            p[i] = max(p_of_mean(surplus[i, counted], groups) for groups in (block, part))
    root = np.sqrt(means)
    return Trust(agents, root[0], root[1], p, p < config.level / len(agents))
