"""Trained policies as files for other programs: TorchScript, ONNX, plain matrices.

An exported policy is two files: the model, and a JSON file of the same name that describes the
rows and columns of the model. The model has two inputs: ``observations``, float32 ``(agents,
observation_width)``, padded with zeros, and ``allowed``, bool ``(agents, action_width)``, false
where padded. Its output is the allowed action of highest value, int64 ``(agents,)``. The JSON file
holds:

- ``agents``, ``observation_sizes``, ``action_counts``: the rows, and how many columns each uses.
- ``observation_width``, ``action_width``: numbers of columns, padding included.
- ``env_options``: options of `ugat_marl.parallel_env` that the policy was trained with.
- ``decision_interval_s``, ``intersections``: seconds between decisions, and agent to traffic light;
  null for an export without an environment.
- ``sha256``: hash of the model; it shows whether the two files belong together.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import warnings
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import Actions, AgentSet, AnyParallelEnv, Infos, Observations
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.files import require_writable, write_whole

if TYPE_CHECKING:
    from ugat_marl.policies.network_policy import NetworkPolicy

_KIND = "ugat_marl.exported_policy"
_OPSET = 17
_IR_VERSION = 8
_UNREADABLE = (OSError, EOFError, ValueError, LookupError, TypeError, zipfile.BadZipFile)
"""Errors that numpy and JSON raise for a damaged file."""

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Weights ``(agents or 1, n_in, n_out)`` and biases ``(agents or 1, 1, n_out)``."""


def export_policy(policy: NetworkPolicy, path: Path, env: AnyParallelEnv | None = None) -> Path:
    """Write a policy for other programs, and a JSON file beside it.

    Args:
        policy: Policy to export.
        path: File of the model. Its suffix chooses the format: ``.ts`` TorchScript, ``.onnx`` ONNX
            (needs the extra ``onnx``), ``.npz`` matrices for `NumpyPolicy`.
        env: Environment of the policy; adds decision interval and traffic lights to the JSON file.

    Returns:
        The path of the JSON file.

    Raises:
        OptionError: The suffix is unknown, the extra is missing, the environment has other agents,
            or a network with structure is to be written to another format than ``.ts``.
        CheckpointError: An option of the environment is not plain data.
        OutputError: A file cannot be written.
    """
    if path.suffix not in FORMATS:
        known = ", ".join(f"{suffix} ({name})" for suffix, (name, _) in FORMATS.items())
        raise OptionError(f"{path}: the suffix {path.suffix!r} is no format; choose from {known}")
    side_car = path.with_suffix(".json")
    for place in (path, side_car):
        require_writable(place)
    about = _about(policy, env)
    model = FORMATS[path.suffix][1](policy)
    write_whole(path, model)
    about["sha256"] = hashlib.sha256(model).hexdigest()
    write_whole(side_car, json.dumps(about, indent=1) + "\n")
    return side_car


def layers_of(policy: NetworkPolicy) -> list[Layer]:
    """Return the policy's network as affine maps with ReLU between them.

    A shared first layer has one matrix of weights for all agents. A ceiling c adds a layer:
    ``min(x, c) = c - ReLU(c - x)``.

    Raises:
        OptionError: The network has structure (FRAP, CoLight) and is not made of such layers only.
    """
    if policy.structure is not None:
        raise OptionError(
            f"a policy with network {policy.structure.network!r} is more than layers of matrices, "
            "which is what .npz and .onnx hold here; export it to .ts"
        )
    layers: list[Layer] = []
    parameters = [p.numpy().copy() for p in policy._network.parameters()]
    for weight, bias in zip(parameters[::2], parameters[1::2], strict=True):
        layers.append((weight if weight.ndim == 3 else weight[None], bias))
    if policy.ceiling is None:
        return layers
    ceiling = policy.ceiling[:, None, :]
    (weight, bias), *later = layers
    mirror = np.negative(np.eye(weight.shape[1], dtype=np.float32))[None]
    moved = np.add(bias, np.matmul(ceiling, weight), dtype=np.float32)
    return [(mirror, ceiling), (np.negative(weight), moved), *later]


class NumpyPolicy:
    """An exported policy that needs numpy only, not torch.

    It takes the same actions as the original, except where two values differ only by rounding.

    Args:
        agents: The agents it acts for.
        layers: Affine maps, as `layers_of` returns them.
        env_options: Options of the environment that the policy relies on.

    Raises:
        ValueError: The layers do not fit each other or the agents.
    """

    def __init__(
        self, agents: AgentSet, layers: list[Layer], env_options: Mapping[str, Any]
    ) -> None:
        _require_fitting(agents, layers)
        self.agents = agents
        self.layers = layers
        self.env_options: Mapping[str, Any] = dict(env_options)

    @classmethod
    def load(cls, path: Path) -> NumpyPolicy:
        """Read a policy from the ``.npz`` and JSON files that `export_policy` wrote.

        Raises:
            CheckpointError: A file is missing, damaged or not finite, or the two do not belong
                together.
        """
        try:
            about = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
            model = path.read_bytes()
            if about["kind"] != _KIND or about["sha256"] != hashlib.sha256(model).hexdigest():
                raise ValueError("the JSON file beside it belongs to another model")
            with np.load(io.BytesIO(model), allow_pickle=False) as arrays:
                count = len(arrays.files) // 2
                layers = [(arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(count)]
            sizes = (tuple(about[key]) for key in ("agents", "observation_sizes", "action_counts"))
            return cls(AgentSet(*sizes), layers, about["env_options"])
        except _UNREADABLE as error:
            raise CheckpointError(
                f"{path}: not a whole exported policy ({error}); export it again"
            ) from None

    def reset(self, seed: int) -> None:
        """Do nothing: the policy has no memory."""

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the greedy action of every agent.

        Raises:
            OptionError: The observations belong to other agents than those the policy was trained
                for.
        """
        values = self.values(self.agents.stack(observations))
        values[~self.agents.masks(infos)] = -np.inf
        return self.agents.actions(values.argmax(axis=1))

    def values(self, stacked: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the values of actions, ``(agents, action_width)``.

        Args:
            stacked: Observations padded with zeros, ``(agents, observation_width)``.
        """
        hidden = stacked[:, None, :]
        for place, (weight, bias) in enumerate(self.layers):
            hidden = (np.maximum(hidden, 0) if place else hidden) @ weight + bias
        return hidden[:, 0, :]


def _about(policy: NetworkPolicy, env: AnyParallelEnv | None) -> dict[str, Any]:
    from ugat_marl.policies.network_policy import checkpoint_header

    agents = policy.agents
    description = checkpoint_header(agents, policy.hidden, policy.env_options, policy.shared)
    if env is not None and AgentSet.of(env) != agents:
        raise OptionError(
            f"the policy acts for {_brief(agents)}, the environment has "
            f"{_brief(AgentSet.of(env))}; give the scenario it was trained in"
        )
    base: Any = env.unwrapped if env is not None else None
    return {
        "kind": _KIND,
        **{key: description[key] for key in ("agents", "observation_sizes", "action_counts")},
        "observation_width": agents.widest_observation,
        "action_width": agents.most_actions,
        "env_options": json.loads(description["env_options"]),
        "decision_interval_s": getattr(base, "decision_interval_s", None),
        "intersections": getattr(base, "intersection_of", None),
    }


def _brief(agents: AgentSet) -> str:
    """Describe the first three agents and their sizes."""
    columns = (agents.names, agents.observation_sizes, agents.action_counts)
    rows = [f"{name} ({n} numbers, {m} actions)" for name, n, m in zip(*columns, strict=True)]
    return ", ".join(rows[:3]) + f" and {len(rows) - 3} more" * (len(rows) > 3)


def _require_fitting(agents: AgentSet, layers: list[Layer]) -> None:
    width, count = agents.widest_observation, len(agents)
    if not len(agents.observation_sizes) == len(agents.action_counts) == count:
        raise ValueError(f"sizes and actions of other than {count} agents")
    for weight, bias in layers:
        shapes = weight.shape, bias.shape
        fits = len(shapes[0]) == len(shapes[1]) == 3 and shapes[0][1] == width
        fits = fits and {shapes[0][0], shapes[1][0]} <= {1, count}
        if not fits or shapes[1][1:] != (1, shapes[0][2]):
            raise ValueError(f"a layer of shapes {shapes} for {count} agents and {width} inputs")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise ValueError("a weight is NaN or infinite")
        width = shapes[0][2]
    if width != agents.most_actions or not layers:
        raise ValueError(f"{width} outputs for {agents.most_actions} actions")


def _matrices(policy: NetworkPolicy) -> bytes:
    arrays: dict[str, NDArray[np.float32]] = {}
    for place, (weight, bias) in enumerate(layers_of(policy)):
        arrays |= {f"weight_{place}": weight, f"bias_{place}": bias}
    buffer = io.BytesIO()
    np.savez(buffer, **cast(dict[str, Any], arrays))
    return buffer.getvalue()


def _torchscript(policy: NetworkPolicy) -> bytes:
    import torch
    from torch import Tensor, nn

    class Greedy(nn.Module):
        """Map observations and masks to actions."""

        def __init__(self) -> None:
            super().__init__()
            self.network = policy._network

        def forward(self, observations: Tensor, allowed: Tensor) -> Tensor:
            values = self.network(observations.unsqueeze(1)).squeeze(1)
            return values.masked_fill(~allowed, -torch.inf).argmax(dim=1)

    rows, agents = len(policy.agents), policy.agents
    observations = torch.zeros(rows, agents.widest_observation)
    allowed = torch.ones(rows, agents.most_actions, dtype=torch.bool)
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # torch advises torch.export, whose files are unpickled when loaded
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.trace(Greedy().eval(), (observations, allowed)), buffer)
    return _without_debug_files(buffer)


def _without_debug_files(archive: io.BytesIO) -> bytes:
    """Return a TorchScript archive without ``.debug_pkl``, which holds local paths."""
    slim = io.BytesIO()
    with zipfile.ZipFile(archive) as full, zipfile.ZipFile(slim, "w") as kept:
        for name in full.namelist():
            if not name.endswith(".debug_pkl"):
                kept.writestr(zipfile.ZipInfo(name), full.read(name))
    return slim.getvalue()


def _onnx(policy: NetworkPolicy) -> bytes:
    """Build the graph by hand, because torch's exporter leaves paths of this machine in the file.

    Raises:
        OptionError: The package onnx is not installed.
    """
    try:
        onnx: Any = importlib.import_module("onnx")
    except ModuleNotFoundError:
        raise OptionError(
            "writing .onnx needs the package onnx; run pip install 'ugat-marl[onnx]', or export "
            "to .npz or .ts"
        ) from None
    helper, kinds, layers, agents = onnx.helper, onnx.TensorProto, layers_of(policy), policy.agents
    constants = {"one": np.array([1]), "never": np.array(-np.inf, np.float32)}
    nodes = [helper.make_node("Unsqueeze", ["observations", "one"], ["in_0"])]
    for i, (weight, bias) in enumerate(layers):
        constants |= {f"weight_{i}": weight, f"bias_{i}": bias}
        nodes.append(helper.make_node("MatMul", [f"in_{i}", f"weight_{i}"], [f"product_{i}"]))
        nodes.append(helper.make_node("Add", [f"product_{i}", f"bias_{i}"], [f"sum_{i}"]))
        if i + 1 < len(layers):
            nodes.append(helper.make_node("Relu", [f"sum_{i}"], [f"in_{i + 1}"]))
    nodes += [
        helper.make_node("Squeeze", [f"sum_{len(layers) - 1}", "one"], ["values"]),
        helper.make_node("Where", ["allowed", "values", "never"], ["permitted"]),
        helper.make_node("ArgMax", ["permitted"], ["actions"], axis=1, keepdims=0),
    ]
    value, rows = helper.make_tensor_value_info, len(agents)
    graph = helper.make_graph(
        nodes,
        "ugat_marl_policy",
        [
            value("observations", kinds.FLOAT, [rows, agents.widest_observation]),
            value("allowed", kinds.BOOL, [rows, agents.most_actions]),
        ],
        [value("actions", kinds.INT64, [rows])],
        [onnx.numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    opset = [helper.make_opsetid("", _OPSET)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=_IR_VERSION)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


FORMATS: dict[str, tuple[str, Callable[[Any], bytes]]] = {
    ".ts": ("TorchScript", _torchscript),
    ".onnx": ("ONNX", _onnx),
    ".npz": ("matrices", _matrices),
}
"""Suffix to the name of the format and the function that writes it."""
