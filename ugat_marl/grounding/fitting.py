"""Training of f and h: settings, held-out episodes, early stopping, and inputs off the data.

Each fit keeps its best weights. The number of an episode alone decides if it is held out; of a log
with one episode it is the last part. So an episode of a longer log never changes sides when the log
grows, and a warm start was never trained on held-out data.

The evidential loss alone does not limit the confidence far from the data, where a network of ReLUs
grows more and more confident. On planted dynamics u was 0.26 on the data and 0.10 off it. So h is
also trained to be unsure on invented inputs (`OffData`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from ugat_marl.data import TransitionLog
from ugat_marl.errors import LogError, require_kinds, require_ranges
from ugat_marl.grounding.forward import ForwardModel
from ugat_marl.grounding.inverse import AnswerModel
from ugat_marl.grounding.networks import TrainableModel, full_width, rows_at_once
from ugat_marl.grounding.reports import ForwardReport, TrainingRecord, forward_report
from ugat_marl.grounding.stacked import Stack, StackedTransitions
from ugat_marl.grounding.uncertainty import LossArguments, Method, MethodName, annealing
from ugat_marl.grounding.view import View
from ugat_marl.policies import CPU, Usual, UsualNumber, on_device
from ugat_marl.seeding import torch_generator


@dataclass(frozen=True)
class FitConfig:
    """Settings of the training of f and h.

    Attributes:
        uncertainty: Method for the uncertainty of h: "edl" (evidential), "dropout" (Concrete
            Dropout), "ensemble" (Deep Ensembles), or "none", with which every grounded action is
            taken.
        pairs: Transitions from which h learns in phase grounding: "observed" ones, as in the paper,
            or "smoothed" ones with the next state that a model of the simulation predicts. Later h
            reads predictions of f; these are means, and single transitions scatter around means.
        members: Number of networks of an ensemble.
        passes: Number of thinned networks that dropout averages over.
        epochs: Largest number of passes over the training rows.
        batch_size: Rows per agent and update.
        learning_rate: Learning rate of Adam.
        patience: Epochs without a lower held-out loss after which training ends.
        held_out_every: n; every n-th episode is held out, or the last n-th part of a single one.
        kl_epochs: Epochs over which the weights of the divergence term of the evidential loss and
            of the certainty on invented inputs rise linearly from 0.
        kl_weight: Final weight of that divergence, for "edl"; 1 in Sensoy et al. With eight phases
            that often look alike, 1 keeps h from learning: on grid2x2-v1 its held-out accuracy is
            0.60 (u 0.90, AUROC of u 0.72) against 0.70 (0.48, 0.73) at 0.1.
        off_data_weight: Weight of the certainty of h on invented inputs off the data, for all
            methods but "none". With 0 each method is that of its paper, and u need not rise off the
            data.
        warm_start: Continue from the current weights instead of drawing new ones.
    """

    uncertainty: MethodName = "edl"
    pairs: Literal["observed", "smoothed"] = "observed"
    members: int = 5
    passes: int = 20
    epochs: int = Usual(100)
    batch_size: int = 64
    learning_rate: float = 1e-3
    patience: int = Usual(10)
    held_out_every: int = 4
    kl_epochs: int = 10
    kl_weight: float = UsualNumber(0.1)
    off_data_weight: float = UsualNumber(0.1)
    warm_start: bool = False

    @property
    def method(self) -> Method:
        """Method of uncertainty of h."""
        return Method(self.uncertainty, self.members, self.passes)

    def __post_init__(self) -> None:
        _ = self.method  # refuses what is impossible
        require_kinds(self, "fit")
        require_ranges(
            self,
            "fit",
            at_least={
                "epochs": 1,
                "batch_size": 1,
                "patience": 1,
                "kl_epochs": 0,
                "held_out_every": 2,
            },
            positive=("learning_rate",),
            non_negative=("kl_weight", "off_data_weight"),
        )


# --- data of a fit

EpochCallback = Callable[[str, int, float], None]
"""Called as ``callback(name of the model, epoch, held_out_loss)`` after every epoch."""

RowLoss = Callable[[Tensor, int], Tensor]
"""Loss of some columns of the data in an epoch; epoch -1 is the final loss, for held-out rows.

Columns are ``(batch,)`` and losses ``(agents, batch)``. Every member of an ensemble has its own
order: columns are ``(members, batch)`` and losses ``(agents, members, batch)``.
"""


@dataclass(frozen=True)
class Split:
    """Weights ``(agents, n)`` of the rows to train on and to hold out; `kind` names the split."""

    train: Tensor
    held_out: Tensor
    kind: str

    def to(self, device: torch.device) -> Split:
        """Return the same on a device."""
        return Split(self.train.to(device), self.held_out.to(device), self.kind)


def split(data: StackedTransitions, every: int, stack: Stack) -> Split:
    """Hold out episodes 1, 1 + every, ...; of a single episode, the last of `every` parts.

    Of an agent that is missing in all episodes on one of the sides, the last part of each of its
    episodes is held out.

    Raises:
        LogError: An agent would have nothing to train on or nothing held out.
    """
    first, last = (_step_of_episode(data, end) for end in ("amin", "amax"))
    held, kind = data.step - first > (last - first) * (1 - 1 / every), "steps"
    if int(data.episode.max()) > 0:
        whole, kind = data.episode % every == 1 % every, "episodes"
        both = ((data.weight * whole).sum(1) > 0) & ((data.weight * ~whole).sum(1) > 0)
        held = torch.where(both[:, None], whole, held)
    train, held_out = data.weight * ~held, data.weight * held
    for agent, rows, others in zip(stack.agents, train.sum(1), held_out.sum(1), strict=True):
        if not rows or not others:
            raise LogError(
                f"{agent} has {int(rows)} rows to train on and {int(others)} to hold out; "
                "record at least two whole episodes"
            )
    return Split(train, held_out, kind)


def _step_of_episode(data: StackedTransitions, end: Literal["amin", "amax"]) -> Tensor:
    """Return the first or the last step of each row's episode, ``(agents, n)``."""
    rows, step = data.weight.bool(), data.step
    episode = torch.where(rows, data.episode + 1, 0)  # 0 for all that is no row
    ends = torch.zeros(len(step), int(episode.max()) + 1, dtype=torch.long)
    ends.scatter_reduce_(1, episode, step, end, include_self=False)
    return ends.gather(1, episode)


def refuse_mismatch(real: TransitionLog, simulated: TransitionLog) -> None:
    """Refuse logs whose models cannot be composed.

    Raises:
        LogError: The logs differ in observation or decision interval.
    """
    for name in ("observation", "decision_interval_s"):
        one, two = getattr(real.provenance, name), getattr(simulated.provenance, name)
        if one != two:
            raise LogError(
                f"the real log has {name} {one!r}, the simulated log {two!r}; record both with the "
                f"same {name}"
            )


OFF_DATA_REACH = 1.5
"""Half-width of the box in units of the observed range; the box is three times as wide."""


@dataclass(frozen=True)
class OffData:
    """The box around the training inputs of every agent.

    Attributes:
        inputs: ``(agents, n, width)`` unscaled inputs of h.
        candidates: ``(agents, m)`` positions along n from which observed rows are drawn: an agent's
            rows with weight, where they are fewer than another's the first ones again.
        low: ``(agents, 1, width)`` lower end of the box; `high` is the upper end.
        kept: ``(agents, 1, width)`` bool, columns that are never redrawn, such as phases.
        change: ``(agents, 1, width)`` bool, columns of the change of the features.
    """

    inputs: Tensor
    candidates: Tensor
    low: Tensor
    high: Tensor
    kept: Tensor
    change: Tensor

    @classmethod
    def around(
        cls, inputs: Tensor, weight: Tensor, view: View, fixed: Tensor | None = None
    ) -> OffData:
        """Return the box around the rows of `inputs` with weight.

            centre = (high + low) / 2,    ends = centre -+ OFF_DATA_REACH * (high - low)

        Args:
            inputs: ``(agents, n, width)``: the observation, and directly behind it the change.
            weight: ``(agents, n)`` weights of the rows; rows with 0 are ignored.
            view: View of h, with the length of observations and the columns of phases.
            fixed: ``(agents, 1, width)`` bool, further columns that are never redrawn.
        """
        on_rows = weight.bool()[..., None]
        low = torch.where(on_rows, inputs, torch.inf).amin(1, keepdim=True)
        high = torch.where(on_rows, inputs, -torch.inf).amax(1, keepdim=True)
        centre, reach = (high + low) / 2, (high - low) * OFF_DATA_REACH
        kept = nn.functional.pad(view.lights, (0, low.shape[-1] - view.width))
        change = torch.zeros(low.shape, dtype=torch.bool)
        for i, size in enumerate(view.sizes):
            change[i, 0, size:] = True
        if fixed is not None:
            kept = kept | fixed
        own = on_rows.sum(1).clamp(min=1)
        first = on_rows[..., 0].int().argsort(dim=1, descending=True, stable=True)
        candidates = first.gather(1, torch.arange(int(own.max())).expand(len(own), -1) % own)
        return cls(inputs, candidates, centre - reach, centre + reach, kept, change)

    def to(self, device: torch.device) -> OffData:
        """Return the same on a device."""
        return replace(self, **{name: part.to(device) for name, part in vars(self).items()})

    def draw(self, count: int, generator: torch.Generator, state_share: float) -> Tensor:
        """Draw invented inputs, ``(agents, count, width)``.

        Args:
            count: Rows per agent.
            generator: Source of the draws, on the CPU for inputs on any device.
            state_share: Share of rows with a drawn state and change. The other rows have an
                observed state and a drawn change.
        """
        device = self.inputs.device
        rows = torch.randint(self.candidates.shape[1], (count,), generator=generator).to(device)
        places = self.candidates[:, rows, None].expand(-1, -1, self.inputs.shape[-1])
        observed = self.inputs.gather(1, places)
        noise = torch.rand(observed.shape, generator=generator).to(device)
        drawn = torch.addcmul(self.low, self.high - self.low, noise)
        whole = torch.rand(1, count, 1, generator=generator).to(device) < state_share
        return torch.where((self.change | whole) & ~self.kept, drawn, observed)


@dataclass(frozen=True)
class Changes:
    """Data from which a model of changes learns.

    Attributes:
        name: Name of the model, for seeds and the callback.
        observation: ``(agents, n, view.width)`` observations in the model's view.
        outcome: ``(agents, n, features or more)``, the features afterwards.
        action: ``(agents, n)`` int64, phases.
        extra: ``(agents, n, extra)`` further inputs, if there are any.
    """

    name: str
    observation: Tensor
    outcome: Tensor
    action: Tensor
    extra: Tensor | None = None


@dataclass(frozen=True)
class Questions:
    """Questions and right answers from which h learns.

    Attributes:
        inputs: ``(agents, n, width)`` unscaled inputs.
        answers: ``(agents, n)`` int64, the true classes.
        off_data: Inputs on which h has to be unsure.
    """

    inputs: Tensor
    answers: Tensor
    off_data: OffData


# --- training


@dataclass(frozen=True)
class Fitter:
    """Settings, seed and device for the fit of several models.

    Attributes:
        config: Settings of the training.
        seed: Seed of fresh weights, of the order of batches, and of inputs off the data.
        on_epoch: Function called after every epoch.
        device: Device of the training; the models are on the CPU before and after it.
    """

    config: FitConfig
    seed: int
    on_epoch: EpochCallback | None = None
    device: torch.device = CPU

    def further(self) -> Fitter:
        """Return the same for a model that learns on from its current weights."""
        return replace(self, config=replace(self.config, warm_start=True))

    def split(self, data: StackedTransitions, stack: Stack) -> Split:
        """Hold out episodes as `split` does, with the settings of this fit."""
        return split(data, self.config.held_out_every, stack)

    def fit_changes(
        self, model: ForwardModel, training_data: Changes, rows: Split
    ) -> ForwardReport:
        """Fit a model of changes by least squares, each agent on its own rows.

        The loss of a row is the mean over outputs of (prediction - change / scale)^2.

        Args:
            model: Model of changes, changed in place.
            training_data: Data of the fit.
            rows: Rows to train on and to hold out.
        """
        change = model.change(training_data.observation, training_data.outcome)
        if not (bool(model.fitted) and self.config.warm_start):
            model.renew(torch_generator(self.seed, training_data.name, "weights"))
            model.fit_scale(training_data.observation, change, rows.train)
        outputs = model.valid_outputs.sum(-1).to(self.device)
        inputs = model.inputs(
            training_data.observation, training_data.action, training_data.extra
        ).to(self.device)
        truth = (change / model.scale).to(self.device)

        def loss(columns: Tensor, _epoch: int) -> Tensor:
            error = model.read(taken(inputs, columns)) - taken(truth, columns)
            squares = (error**2).sum(-1)
            return squares / outputs.view(-1, *[1] * (squares.dim() - 1))

        generator = torch_generator(self.seed, training_data.name, "batches")
        with on_device(self.device, model):
            record = self._train(training_data.name, model, loss, rows.to(self.device), generator)
            with torch.no_grad():
                predicted = (model.read_all(inputs) * model.scale).to(CPU)
        followed = training_data.observation[..., : change.shape[-1]] * model.valid_outputs + change
        share = (rows.train / rows.train.sum(1, keepdim=True))[..., None]
        off_mean = followed - (followed * share).sum(1, keepdim=True)
        return forward_report(model, predicted, change, off_mean, rows.held_out, record)

    def fit_answers(
        self, model: AnswerModel, training_data: Questions, rows: Split
    ) -> TrainingRecord:
        """Fit a model that answers with a class, with the loss of its method of uncertainty.

        Args:
            model: Inverse model, changed in place; its head learns from all agents at once.
            training_data: Data of the fit.
            rows: Rows to train on and to hold out.
        """
        config = self.config
        fresh = not (bool(model.fitted) and config.warm_start and model.method == config.method)
        if fresh:
            model.renew(config.method, torch_generator(self.seed, "inverse", "weights"))
            model.standardise.fit(training_data.inputs, rows.train)
        generator = torch_generator(self.seed, "inverse", "batches")
        inputs = model.standardise(training_data.inputs).to(self.device)
        answers = training_data.answers.to(self.device)
        rows, off_data = rows.to(self.device), training_data.off_data.to(self.device)
        count = rows.train.sum(1)

        def invent(number: int) -> Tensor:
            return model.standardise(off_data.draw(number, generator, state_share=0.5))

        def loss(columns: Tensor, epoch: int) -> Tensor:
            # A fresh model has to gather evidence first; misleading evidence is punished later.
            share = annealing(epoch, config.kl_epochs) if fresh and epoch >= 0 else 1.0
            about = LossArguments(
                held_out=epoch < 0,
                generator=generator,
                rows=count,
                share=share,
                kl_weight=config.kl_weight,
                off_data_weight=config.off_data_weight,
                invent=invent,
            )
            return model.net.loss(taken(inputs, columns), taken(answers, columns), about)

        with on_device(self.device, model):
            annealed = config.kl_epochs if fresh and config.uncertainty != "none" else 0
            return self._train("inverse", model, loss, rows, generator, annealed)

    def _train(
        self,
        name: str,
        model: TrainableModel,
        loss: RowLoss,
        rows: Split,
        generator: torch.Generator,
        annealed: int = 0,
    ) -> TrainingRecord:
        """Train until the held-out loss has stopped falling; the model keeps its best weights.

        Model, data and `rows` are on one device; `generator` is on the CPU. The held-out loss has
        all its terms from the start, but the training gets some of them gradually in the first
        `annealed` epochs. So patience is not counted in these epochs.
        """
        config, members = self.config, model.members
        best = _Best(model, rows.train.device)

        def held_out() -> Tensor:
            return model.loss_by_part(_mean_loss(loss, rows.held_out, members))

        if bool(model.fitted):  # keeps the weights of a warm start that does not improve
            best.offer(held_out())
        optimiser = torch.optim.Adam(model.parameters(), lr=config.learning_rate, fused=True)
        columns = rows.train.any(0).nonzero()[:, 0]
        waited = epoch = 0
        train_loss = float("nan")
        while epoch < config.epochs and waited < config.patience:
            batches = _shuffled(columns, members, generator).split(config.batch_size, dim=-1)
            with full_width(len(rows.train) * members):
                train_loss = _epoch(loss, rows.train, batches, epoch, optimiser)
                held_out_loss = held_out()
            improved = best.offer(held_out_loss)
            epoch += 1
            waited = 0 if improved or epoch <= annealed else waited + 1
            if self.on_epoch is not None:
                self.on_epoch(name, epoch, float(held_out_loss.mean()))
        best.restore()
        model.fitted.fill_(True)
        return TrainingRecord(
            epochs=epoch,
            train_loss=train_loss,
            held_out_loss=float(best.loss.mean()),
            split=rows.kind,
        )


class _Best:
    """Weights with the lowest held-out loss, kept separately for each part of the model."""

    def __init__(self, model: TrainableModel, device: torch.device) -> None:
        self._model = model
        self._weights = {name: p.detach().clone() for name, p in model.named_parameters()}
        self.loss = torch.full((model.parts,), torch.inf, device=device)

    def offer(self, loss: Tensor) -> bool:
        """Keep the model's current weights where `loss`, ``(parts,)``, is lower than before."""
        better = loss < self.loss
        if not better.any():
            return False
        self.loss = torch.where(better, loss, self.loss)
        parts = len(better)
        for name, parameter in self._model.named_parameters():
            self._weights[name].view(parts, -1)[better] = parameter.detach().view(parts, -1)[better]
        return True

    def restore(self) -> None:
        """Put the kept weights back into the model."""
        self._model.load_state_dict(self._weights, strict=False)


def taken(data: Tensor, columns: Tensor) -> Tensor:
    """Return some columns of ``(agents, n, ...)``; each member may have its own."""
    # Plain indexing gives the same, but takes seven times as long.
    return data.index_select(1, columns) if columns.dim() == 1 else data[:, columns]


def _shuffled(columns: Tensor, members: int, generator: torch.Generator) -> Tensor:
    """Return columns in random order, ``(n,)``, or one order per member, ``(members, n)``."""
    orders = [torch.randperm(len(columns), generator=generator) for _ in range(members)]
    order = orders[0] if members == 1 else torch.stack(orders)
    return columns[order.to(columns.device)]


def _epoch(
    loss: RowLoss,
    weight: Tensor,
    batches: Sequence[Tensor],
    epoch: int,
    optimiser: torch.optim.Optimizer,
) -> float:
    """Pass once over the batches; return the mean loss over agents, members and batches."""
    losses: list[Tensor] = []
    for batch in batches:
        batch_weight = taken(weight, batch)
        # The sum of the agents' means: the gradient of an agent does not depend on the others.
        mean = (loss(batch, epoch) * batch_weight).sum(-1) / batch_weight.sum(-1).clamp(min=1.0)
        optimiser.zero_grad(set_to_none=True)
        mean.sum().backward()
        optimiser.step()
        losses.append(mean.detach().mean())
    # Read once at the end, because each read waits for the GPU.
    return sum(torch.stack(losses).cpu().tolist()) / len(batches)


@torch.no_grad()
def _mean_loss(loss: RowLoss, weight: Tensor, members: int) -> Tensor:
    """Return mean losses over rows with weight, ``(agents,)`` or ``(agents, members)``."""
    chunk = rows_at_once(len(weight) * members)
    total, rows = weight.new_zeros(()), weight.new_zeros(())
    for batch in weight.any(0).nonzero()[:, 0].split(chunk):
        columns = batch if members == 1 else batch.expand(members, -1)
        batch_weight = taken(weight, columns)
        total, rows = (
            total + (loss(columns, -1) * batch_weight).sum(-1),
            rows + batch_weight.sum(-1),
        )
    return total / rows
