"""The grounded action transformation: forward, inverse and gate composed.

For the policy's action a in state s: s' = f(s, a) is what the real world would do; a' = h(s, s') is
the action with which the simulation does the same; the gate takes a' where h is sure enough.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ugat_marl.data import AgentLayout, read_checkpoint, write_checkpoint
from ugat_marl.errors import CheckpointError, EpisodeError, OptionError
from ugat_marl.grounding.forward import ForwardConfig, ForwardModel
from ugat_marl.grounding.gate import Gate, GateConfig
from ugat_marl.grounding.inverse import AnswerModel, InverseConfig, InverseModel
from ugat_marl.grounding.joint import alone, together, turns
from ugat_marl.grounding.stacked import Stack
from ugat_marl.grounding.uncertainty import Method
from ugat_marl.grounding.view import InputsConfig, Moment, Neighbours, View
from ugat_marl.policies import one_thread
from ugat_marl.seeding import torch_generator

KIND = "grounding"
"""What a checkpoint file of this module says it is."""


@dataclass(frozen=True)
class Grounding:
    """The outcome for all agents at one step; arrays ``(agents,)``.

    Attributes:
        executed: int64, what the simulation is told to do.
        grounded: int64, what the inverse model answered.
        u: float32, its uncertainty.
        accepted: bool, whether the grounded action was taken.
        delay_s: float32, for how long the greens are held back.
    """

    executed: NDArray[np.int64]
    grounded: NDArray[np.int64]
    u: NDArray[np.float32]
    accepted: NDArray[np.bool_]
    delay_s: NDArray[np.float32]


class Transform(abc.ABC):
    """Models and gate of a network: the policy's actions in, what the simulation is told out.

    Args:
        layouts: Agent to the division of its observation, in the environment's order.
        seed: Decides the initial weights.
        forward: Shape of the forward models.
        gate: How alpha is found.
        inputs: What the models see beside the intersection's own state and action.
        neighbours: Agent to the agents one road away, for inputs with hops.

    Attributes:
        stack: The agents.
        inputs: What the models see.
        local: The view of h: the neighbours, if there are hops; f's view has the history, too.
        forward: f of every intersection.
        inverse: h of every intersection.
        gate: Keeps or takes what h answers.
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
        """Whatever has weights, under its name in a checkpoint."""
        return {"forward": self.forward, "inverse": self.inverse}

    @property
    def fitted(self) -> bool:
        """Whether both models have been fitted; before that there is nothing to ground with."""
        return bool(self.forward.fitted) and bool(self.inverse.fitted)

    @abc.abstractmethod
    def ground(
        self,
        observations: Tensor,
        actions: NDArray[np.int64],
        permitted: NDArray[np.bool_] | None,
        earlier: Sequence[Moment],
    ) -> Grounding:
        """`__call__`, once the models are fitted."""

    @abc.abstractmethod
    def fresh_inverse(self, method: Method) -> AnswerModel:
        """An unfitted h of the same shape with this method of uncertainty."""

    @one_thread()
    @torch.no_grad()
    def __call__(
        self,
        observations: Tensor,
        actions: NDArray[np.int64],
        permitted: NDArray[np.bool_] | None = None,
        earlier: Sequence[Moment] = (),
    ) -> Grounding:
        """Grounds one action per agent, all of them together.

        Args:
            observations: ``(agents, 1, width)`` float32, padded (`Stack.observations`).
            actions: ``(agents,)`` the policy's actions.
            permitted: ``(agents, phases)`` action masks; a masked grounded action is not taken.
            earlier: The decisions of this episode before, latest first, for models with a history.

        Raises:
            EpisodeError: The models have not been fitted.
        """
        if not self.fitted:
            raise EpisodeError(
                "actions cannot be grounded before the models are fitted; "
                "call grounding.fitting.fit first or load a checkpoint"
            )
        return self.ground(observations, actions, permitted, earlier)

    def state_dict(self) -> dict[str, Any]:
        """Weights, statistics, method of uncertainty and gate, as tensors and plain values."""
        return {
            "method": asdict(self.inverse.method),
            "layouts": {a: list(_sizes(v)) for a, v in self.stack.layouts.items()},
            "inputs": _sights(self.inputs, self.local),
            **{name: model.state_dict() for name, model in self.models.items()},
            "gate": self.gate.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores `state_dict`, with the method of uncertainty h had; on an error nothing changes.

        Raises:
            CheckpointError: Of other agents or shapes, incomplete, or not finite.
        """
        layouts = state.get("layouts")
        own = [(agent, list(_sizes(layout))) for agent, layout in self.stack.layouts.items()]
        if not isinstance(layouts, Mapping) or list(layouts.items()) != own:
            raise CheckpointError(
                "the grounding in the checkpoint belongs to other agents or another observation; "
                f"this one has {len(own)} agents ({', '.join(self.stack.agents[:4])} ...)"
            )
        sights = _sights(self.inputs, self.local)
        # Checkpoints from before there were inputs do not say theirs.
        kept = state.get("inputs", _sights(InputsConfig(), View(self.stack)))
        if kept != sights:
            raise CheckpointError(
                f"the models in the checkpoint see {kept!r}, these see {sights!r}; use the same "
                "inputs (history, hops) and the same network"
            )
        method = _method(state)
        found = {name: state.get(name) for name in self.models}
        found["inverse"] = _renamed(found["inverse"])
        for name, model in {**self.models, "inverse": self.fresh_inverse(method)}.items():
            _refuse_foreign(name, found[name], model.state_dict())
        if not isinstance(state.get("gate"), Mapping):
            raise CheckpointError("the grounding in the checkpoint has no gate")
        self.gate.load_state_dict(state["gate"])
        self.inverse.renew(method, torch_generator(0))
        for name, model in self.models.items():
            model.load_state_dict(dict(found[name] or {}))

    def save(self, path: Path) -> None:
        """Writes `state_dict` to a file, whole or not at all.

        Raises:
            CheckpointError: A weight is not finite; a file at `path` is left as it was.
        """
        write_checkpoint(path, KIND, self.state_dict())

    def load(self, path: Path) -> None:
        """Restores what `save` wrote.

        Raises:
            CheckpointError: Unreadable, of other agents or shapes, or not finite.
        """
        state = read_checkpoint(path, KIND)
        try:
            self.load_state_dict(state)
        except CheckpointError as error:
            raise CheckpointError(f"{path}: {error}") from None


class GroundedActionTransform(Transform):
    """Phase grounding, the paper's: the grounded action is another phase.

    Args:
        layouts: Agent to the division of its observation, in the environment's order.
        seed: Decides the initial weights.
        forward: Shape of the forward models.
        inverse: Shape of the inverse models.
        gate: How alpha is found.
        inputs: What the models see beside the intersection's own state and action.
        neighbours: Agent to the agents one road away, for inputs with hops.
    """

    inverse: InverseModel

    def __init__(
        self,
        layouts: Mapping[str, AgentLayout],
        seed: int,
        forward: ForwardConfig | None = None,
        inverse: InverseConfig | None = None,
        gate: GateConfig | None = None,
        inputs: InputsConfig | None = None,
        neighbours: Neighbours | None = None,
    ) -> None:
        forward, inverse = forward or ForwardConfig(), inverse or InverseConfig()
        if forward.include_phase != inverse.include_phase:
            raise OptionError(
                f"include_phase is {forward.include_phase} in the forward and "
                f"{inverse.include_phase} in the inverse model; h must be given what f predicts"
            )
        super().__init__(layouts, seed, forward, gate, inputs, neighbours)
        self.inverse = InverseModel(
            self.stack, inverse, torch_generator(seed, "inverse"), view=self.local
        )
        self._in_turn = turns(self.stack.agents, self.local.near)

    def ground(
        self,
        observations: Tensor,
        actions: NDArray[np.int64],
        permitted: NDArray[np.bool_] | None,
        earlier: Sequence[Moment],
    ) -> Grounding:
        """f, then h, then the gate; where neighbours are seen, until all answers hold together."""
        asked = torch.from_numpy(actions)[:, None]

        def answer(phases: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
            running = torch.from_numpy(phases)[:, None]
            seen = self.forward.view.seen(observations, running, earlier)
            predicted = self.forward.predict(seen, asked)
            found = self.inverse.predict(self.local.seen(observations, running), predicted)
            return found.action[:, 0].numpy(), found.u[:, 0].numpy()

        if self.local.joint:
            settled = together(answer, self.gate, self._in_turn, actions, permitted)
        else:
            settled = alone(answer, actions, permitted)
        grounded, u = settled.grounded, settled.u
        accepted = self.gate.decide(u, actions, grounded, settled.allowed)
        executed = np.where(accepted, grounded, actions)
        return Grounding(executed, grounded, u, accepted, np.zeros_like(u))

    def fresh_inverse(self, method: Method) -> InverseModel:
        """An unfitted h of the same shape with this method of uncertainty."""
        return InverseModel(self.stack, self.inverse.config, torch_generator(0), method, self.local)


def _method(state: Mapping[str, Any]) -> Method:
    """The method of uncertainty; checkpoints of version 0.1 do not say theirs, it is "edl"."""
    found = state.get("method", asdict(Method()))
    try:
        return Method(**found)
    except (TypeError, OptionError) as error:
        raise CheckpointError(
            f"the inverse model in the checkpoint is of no method: {error}"
        ) from None


def _renamed(parts: Any) -> Any:
    """The parts of h under their names of today; in version 0.1 they lacked the ``net.``."""
    if not isinstance(parts, Mapping):
        return parts
    old = ("encoders.", "head.")
    return {f"net.{k}" if str(k).startswith(old) else k: value for k, value in parts.items()}


def _sights(inputs: InputsConfig, local: View) -> dict[str, Any]:
    """What models see, in plain values."""
    return {**asdict(inputs), "near": {agent: list(near) for agent, near in local.near.items()}}


def _sizes(layout: AgentLayout) -> tuple[int, int, int]:
    return layout.features, layout.phases, layout.context


def _refuse_foreign(name: str, found: Any, own: Mapping[str, Tensor]) -> None:
    if not isinstance(found, Mapping) or set(found) != set(own):
        raise CheckpointError(f"the {name} model in the checkpoint has other parts than this one")
    for part, value in own.items():
        tensor = found[part]
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
