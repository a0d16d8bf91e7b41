"""Base of all groundings: models and gate of a network, fitted, asked, saved and loaded.

The policy chooses action a in state s. f predicts the next state of the real domain, s' = f(s, a).
h answers with the action that leads to s' in the simulation, a' = h(s, s'). The gate takes a' where
h is sure enough. In `PhaseTransform` a' is another phase; in `TimedTransform` it is a delay.
"""

from __future__ import annotations

import abc
import copy
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ugat_marl.data import AgentLayout, TransitionLog, read_checkpoint, write_checkpoint
from ugat_marl.errors import CheckpointError, EpisodeError, OptionError, first_names
from ugat_marl.grounding.delays import EpisodeRewards
from ugat_marl.grounding.fitting import Changes, Fitter
from ugat_marl.grounding.forward import ForwardConfig, ForwardModel
from ugat_marl.grounding.gate import Gate, GateConfig
from ugat_marl.grounding.inverse import AnswerModel
from ugat_marl.grounding.reports import FitReport
from ugat_marl.grounding.stacked import Stack, StackedTransitions
from ugat_marl.grounding.uncertainty import Method
from ugat_marl.grounding.view import InputsConfig, Moment, Neighbours, View
from ugat_marl.policies import one_thread
from ugat_marl.seeding import torch_generator

KIND = "grounding"
"""Name of this kind of checkpoint, written into the file."""


@dataclass(frozen=True)
class GroundedActions:
    """Grounded actions of all agents at one step; arrays ``(agents,)``.

    Attributes:
        executed: int64, the phases that the simulation executes.
        grounded: int64, the answers of the inverse model.
        u: float32, uncertainties of these answers, in [0, 1].
        accepted: bool, true where the grounded action was taken.
        delay_s: float32, delays of the greens, in s.
    """

    executed: NDArray[np.int64]
    grounded: NDArray[np.int64]
    u: NDArray[np.float32]
    accepted: NDArray[np.bool_]
    delay_s: NDArray[np.float32]


class Transform(abc.ABC):
    """Models and gate of a network: the policy's actions in, grounded actions out.

    Args:
        layouts: Agent to the division of its observation, in the environment's order.
        seed: Seed of the initial weights.
        forward: Shape of the forward models.
        gate: Settings of alpha.
        inputs: Inputs of the models beside the intersection's own state and action.
        neighbours: Agent to the agents one road away, for inputs with hops.

    Attributes:
        stack: The agents.
        inputs: Inputs of the models.
        local: View of h: neighbours, if there are hops. The view of f has the history, too.
        forward: f of every intersection.
        inverse: h of every intersection.
        gate: Choice between the policy's actions and the answers of h.
    """

    inverse: AnswerModel

    def __init__(
        self,
        layouts: Mapping[str, AgentLayout],
        seed: int,
        forward: ForwardConfig,
        gate: GateConfig | None,
        inputs: InputsConfig | None,
        neighbours: Neighbours | None,
    ) -> None:
        self.stack = Stack(layouts)
        self.inputs = inputs or InputsConfig()
        near = self.inputs.near(self.stack.agents, neighbours)
        self.local = View(self.stack, near=near)
        view = View(self.stack, self.inputs.history, near)
        self.forward = ForwardModel(
            self.stack, forward, torch_generator(seed, "forward"), view=view
        )
        self.gate = Gate(self.stack.agents, gate or GateConfig())

    @property
    def models(self) -> dict[str, nn.Module]:
        """All modules with weights, by their names in a checkpoint."""
        return {"forward": self.forward, "inverse": self.inverse}

    @property
    def fitted(self) -> bool:
        """True once f and h have been fitted; actions cannot be grounded before."""
        return bool(self.forward.fitted) and bool(self.inverse.fitted)

    @property
    def draws(self) -> int:
        """Number of predictions of f for which h is asked."""
        composed = self.gate.config.uncertainty_of == "h-after-f"
        return self.forward.members if composed else 1

    @abc.abstractmethod
    def fit(
        self,
        real: TransitionLog,
        simulated: TransitionLog,
        fitter: Fitter,
        rewards: EpisodeRewards | None = None,
        *,
        on_top: bool = False,
    ) -> FitReport:
        """Fit f on the real log and h on the simulated log, and measure both.

        Args:
            real: Transitions of the real domain, D_real. f learns the outcomes of the *asked*
                actions.
            simulated: Transitions of the simulation, D_sim. h learns the *executed* action, or the
                delay, from the outcome.
            fitter: Settings, seed and device of the training.
            rewards: Rewards of the policy in both worlds, for a grounding that matches them.
            on_top: True if f begins as a model of the simulation and learns from there.

        Raises:
            LogError: A log has other agents or is too short to be split, or the logs differ in
                observation or decision interval.
        """

    @abc.abstractmethod
    def training_data(self, data: StackedTransitions) -> tuple[Changes, Tensor]:
        """Return what f learns from transitions, and the decisions that can be grounded.

        The second part is ``(agents, n)``, 1 for such a decision and 0 for others and for padding.
        """

    @property
    def acting(self) -> NDArray[np.bool_]:
        """True for agents whose actions may be grounded, ``(agents,)``."""
        return self.gate.trusted.copy()

    def restrict(self, agents: NDArray[np.bool_]) -> None:
        """Leave the actions of all other agents as they are.

        Args:
            agents: ``(agents,)`` bool, true for agents whose actions may be grounded.
        """
        self.gate.trust(self.gate.trusted & agents)

    @abc.abstractmethod
    def ground(
        self,
        observations: Tensor,
        actions: NDArray[np.int64],
        permitted: NDArray[np.bool_] | None,
        earlier: Sequence[Moment],
    ) -> GroundedActions:
        """Ground one action per agent with fitted models; the arguments are those of `__call__`."""

    @one_thread()
    @torch.no_grad()
    def __call__(
        self,
        observations: Tensor,
        actions: NDArray[np.int64],
        permitted: NDArray[np.bool_] | None = None,
        earlier: Sequence[Moment] = (),
    ) -> GroundedActions:
        """Ground one action per agent, all of them together.

        Args:
            observations: ``(agents, 1, width)`` float32, padded (`Stack.observations`).
            actions: ``(agents,)`` the policy's actions.
            permitted: ``(agents, phases)`` action masks; a masked grounded action is not taken.
            earlier: Earlier decisions of this episode, latest first, for models with a history.

        Raises:
            EpisodeError: The models have not been fitted.
        """
        if not self.fitted:
            raise EpisodeError(
                "actions cannot be grounded before the models are fitted; "
                "call fit first or load a checkpoint"
            )
        return self.ground(observations, actions, permitted, earlier)

    def state_dict(self) -> dict[str, Any]:
        """Return weights, statistics, method of uncertainty and gate as plain values."""
        return {
            "method": asdict(self.inverse.method),
            "layouts": {a: list(_sizes(v)) for a, v in self.stack.layouts.items()},
            "inputs": _sights(self.inputs, self.local),
            **{name: model.state_dict() for name, model in self.models.items()},
            "gate": self.gate.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict`, including the method of uncertainty of h.

        An error leaves this transform unchanged.

        Raises:
            CheckpointError: The state has other agents or shapes, is incomplete or not finite.
        """
        layouts = state.get("layouts")
        layout_sizes = [
            (agent, list(_sizes(layout))) for agent, layout in self.stack.layouts.items()
        ]
        if not isinstance(layouts, Mapping) or list(layouts.items()) != layout_sizes:
            raise CheckpointError(
                "the grounding in the checkpoint belongs to other agents or another observation; "
                f"this one has {len(layout_sizes)} agents ({first_names(self.stack.agents)})"
            )
        sights = _sights(self.inputs, self.local)
        if state.get("inputs") != sights:
            raise CheckpointError(
                f"the models in the checkpoint see {state.get('inputs')!r}, these see {sights!r}; "
                "use the same inputs (history, hops) and the same network"
            )
        method = _method(state)
        inverse = copy.deepcopy(self.inverse)
        inverse.renew(method, torch_generator(0))
        for name, model in {**self.models, "inverse": inverse}.items():
            _refuse_foreign(name, state.get(name), model.state_dict())
        if not isinstance(state.get("gate"), Mapping):
            raise CheckpointError("the grounding in the checkpoint has no gate")
        self.gate.load_state_dict(state["gate"])
        self.inverse.renew(method, torch_generator(0))
        for name, model in self.models.items():
            model.load_state_dict(dict(state[name]))

    def save(self, path: Path) -> None:
        """Write `state_dict` to a file atomically.

        Raises:
            CheckpointError: A weight is not finite; an existing file at `path` stays unchanged.
        """
        write_checkpoint(path, KIND, self.state_dict())

    def load(self, path: Path) -> None:
        """Restore a file of `save`.

        Raises:
            CheckpointError: The file is unreadable, has other agents or shapes, or is not finite.
        """
        state = read_checkpoint(path, KIND)
        try:
            self.load_state_dict(state)
        except CheckpointError as error:
            raise CheckpointError(f"{path}: {error}") from None


def _method(state: Mapping[str, Any]) -> Method:
    """Return the method of uncertainty of a checkpoint."""
    try:
        return Method(**state["method"])
    except (KeyError, TypeError, OptionError) as error:
        raise CheckpointError(
            f"the inverse model in the checkpoint is of no method: {error}"
        ) from None


def _sights(inputs: InputsConfig, local: View) -> dict[str, Any]:
    """Return the inputs of the models and their neighbours as plain values."""
    return {**asdict(inputs), "near": {agent: list(near) for agent, near in local.near.items()}}


def _sizes(layout: AgentLayout) -> tuple[int, int, int]:
    return layout.features, layout.phases, layout.context


def _refuse_foreign(name: str, read: Any, expected: Mapping[str, Tensor]) -> None:
    """Refuse parts of a model of other names or shapes than `expected`, or not finite."""
    if not isinstance(read, Mapping) or set(read) != set(expected):
        raise CheckpointError(f"the {name} model in the checkpoint has other parts than this one")
    for part, value in expected.items():
        tensor = read[part]
        if not isinstance(tensor, Tensor) or tensor.shape != value.shape:
            shape = tuple(tensor.shape) if isinstance(tensor, Tensor) else type(tensor).__name__
            raise CheckpointError(
                f"{name}.{part} in the checkpoint is {shape}; expected {tuple(value.shape)}; "
                "it was made with other options"
            )
        if not torch.isfinite(tensor).all():
            raise CheckpointError(
                f"{name}.{part} in the checkpoint is not finite; use an earlier checkpoint"
            )
