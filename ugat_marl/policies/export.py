"""Trained policies as files for other programs: TorchScript, ONNX, plain matrices.

An exported policy is two files: the model, and a JSON file of the same name that describes the
rows and columns of the model. The model has two inputs: ``observations``, float32 ``(agents,
observation_width)``, padded with zeros, and ``allowed``, bool ``(agents, action_width)``, false
where padded. Its output is the allowed action of highest value, int64 ``(agents,)``. The JSON file
holds:

- ``kind``: what the file is, which `load` requires.
- ``network``: name of the network, as in `DQNConfig.network`.
- ``agents``, ``observation_sizes``, ``action_counts``: the rows, and how many columns each uses.
- ``observation_width``, ``action_width``: numbers of columns, padding included.
- ``env_options``: options of `ugat_marl.parallel_env` that the policy was trained with.
- ``decision_interval_s``, ``intersections``: seconds between decisions, and agent to traffic light,
  both of the environment that was given; null without one.
- ``parameters``: hash of the policy's parameters, its ceiling included.
- ``sha256``: suffix of each format to the hash of its model; it shows which files belong
  together.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import io
import json
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import Actions, AgentSet, AnyParallelEnv, Infos, Observations
from ugat_marl.errors import CheckpointError, OptionError, install_command
from ugat_marl.files import MALFORMED, read_json, require_stored, require_writable, write_whole
from ugat_marl.policies.portable import (
    PORTABLE,
    Layer,
    NumpyOperations,
    PortableLayers,
    PortableNetwork,
    PortableUniversal,
)

if TYPE_CHECKING:
    from ugat_marl.policies.network_policy import NetworkPolicy

_KIND = "ugat_marl.exported_policy"
_OPSET = 17
_IR_VERSION = 8
_UNREADABLE = (OSError, EOFError, ValueError, LookupError, TypeError, zipfile.BadZipFile)
"""Errors that numpy and JSON raise for a damaged file."""


def export_policy(
    policy: NetworkPolicy, path: str | Path, env: AnyParallelEnv | None = None
) -> Path:
    """Write a policy for other programs, and a JSON file beside it.

    Args:
        policy: Policy to export.
        path: File of the model. Its suffix chooses the format: ``.ts`` TorchScript, ``.onnx`` ONNX
            (needs the extra ``onnx``), ``.npz`` matrices for `NumpyPolicy`.
        env: Environment of the policy; adds its decision interval and traffic lights to the JSON
            file. Networks other than ``universal`` do not know the interval of their training, so
            that any is taken.

    Returns:
        The path of the JSON file.

    Raises:
        OptionError: The suffix is unknown, the extra is missing, the environment has other agents,
            or other movements, phases or another decision interval than the network holds, FRAP or
            CoLight is to be written to another format than ``.ts``, another policy's model would
            lose its JSON file, or the file is no model that this function wrote.
        CheckpointError: An option of the environment is not plain data.
        OutputError: A file cannot be written.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        known = ", ".join(f"{suffix} ({name})" for suffix, (name, _) in FORMATS.items())
        raise OptionError(
            f"{path}: the suffix {path.suffix!r} is not a format; choose from {known}"
        )
    side_car = path.with_suffix(".json")
    for place in (path, side_car):
        require_writable(place)
    held = _held(side_car)
    about = _about(policy, env)
    written = held.get("sha256", {}).get(path.suffix)
    if path.exists() and _sum(path.read_bytes()) != written:
        raise OptionError(
            f"{path}: is there, and {side_car.name} tells of no model in it; give the model "
            "another name, or remove the file"
        )
    same = _of_the_policy(held) == json.loads(json.dumps(_of_the_policy(about)))
    if held and not same:
        _refuse_models_beside(path)
    if same and env is None:  # what an earlier export told of the site holds for the policy
        about |= {key: held.get(key) for key in _OF_THE_SITE}
    model = FORMATS[path.suffix][1](policy)
    write_whole(path, model)
    sums = {path.suffix: _sum(model), ".json": _sum_of(about)}
    about["sha256"] = (held["sha256"] if same else {}) | sums
    write_whole(side_car, json.dumps(about, indent=1) + "\n")
    return side_car


def _sum(model: bytes) -> str:
    return hashlib.sha256(model).hexdigest()


def _sum_of(about: Mapping[str, Any]) -> str:
    """Return the check sum of a side-car, without the check sums that it holds."""
    told = {key: value for key, value in about.items() if key != "sha256"}
    return _sum(json.dumps(told, sort_keys=True).encode())


def _held(side_car: Path) -> dict[str, Any]:
    """Return the content of a side-car that is there; empty without one.

    Raises:
        OptionError: The file is no side-car, and would be lost.
    """
    if not side_car.exists():
        return {}
    with contextlib.suppress(CheckpointError, *MALFORMED):
        held = dict(read_json(side_car, CheckpointError))
        if held["kind"] == _KIND:
            return {**held, "sha256": dict(held.get("sha256", {}))}
    raise OptionError(
        f"{side_car}: is there and describes no exported policy; give the model another name, "
        "because this file is written beside it"
    )


_OF_THE_SITE = ("decision_interval_s", "intersections")
"""What a side-car tells only if the environment was given."""


def _of_the_policy(content: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in content.items() if k not in (*_OF_THE_SITE, "sha256")}


def _refuse_models_beside(path: Path) -> None:
    """Refuse to replace the side-car of another policy's models, which could not be loaded then."""
    beside = [path.with_suffix(suffix) for suffix in FORMATS if suffix != path.suffix]
    if others := [model.name for model in beside if model.exists()]:
        raise OptionError(
            f"{path.with_suffix('.json')} belongs to another policy, of which {others[0]} is "
            f"there; give the model another name, or remove {others[0]}"
        )


def portable_network(policy: NetworkPolicy) -> PortableNetwork:
    """Return the policy's network as arrays and operations, its ceiling included.

    Raises:
        OptionError: The network has no such form (FRAP, CoLight).
    """
    name = _network_name(policy)
    if name not in PORTABLE:
        raise OptionError(
            f"a policy with network {name!r} cannot be written as .npz or .onnx; export it to .ts"
        )
    if name == "mlp":
        return PortableLayers.of(_layers(policy))
    network = policy._network
    tensors = (*network.named_buffers(), *network.named_parameters())
    # behind a ceiling the network is a part of `Held`
    held = {name.removeprefix("network."): tensor.numpy().copy() for name, tensor in tensors}
    return PortableUniversal(held)


def _layers(policy: NetworkPolicy) -> list[Layer]:
    """Return a network of layers as affine maps with ReLU between them.

    A shared first layer has one matrix of weights for all agents. A ceiling c adds a layer:
    ``min(x, c) = c - ReLU(c - x)``.
    """
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
        network: Network, as `portable_network` returns it.
        env_options: Options of the environment that the policy relies on.

    Raises:
        ValueError: The arrays of the network do not fit each other or the agents.
    """

    def __init__(
        self, agents: AgentSet, network: PortableNetwork, env_options: Mapping[str, Any]
    ) -> None:
        if not len(agents.observation_sizes) == len(agents.action_counts) == len(agents):
            raise ValueError(f"sizes and actions of other than {len(agents)} agents")
        network.require_fitting(agents)
        self.agents = agents
        self.network = network
        self.env_options: Mapping[str, Any] = dict(env_options)

    @classmethod
    def load(cls, path: str | Path) -> NumpyPolicy:
        """Read a policy from the ``.npz`` and JSON files that `export_policy` wrote.

        Raises:
            CheckpointError: A file is missing, damaged or not finite, or the two do not belong
                together.
        """
        path = Path(path)
        try:
            about = read_json(path.with_suffix(".json"), CheckpointError)
            model = path.read_bytes()
            if about["kind"] != _KIND or dict(about["sha256"]).get(path.suffix) != _sum(model):
                raise ValueError("the JSON file beside it belongs to another model")
            if dict(about["sha256"]).get(".json") != _sum_of(about):
                raise ValueError("the JSON file beside it was changed")
            with zipfile.ZipFile(io.BytesIO(model)) as archive:
                require_stored(archive)
            with np.load(io.BytesIO(model), allow_pickle=False) as arrays:
                network = PORTABLE[about["network"]]({name: arrays[name] for name in arrays.files})
            sizes = (tuple(about[key]) for key in ("agents", "observation_sizes", "action_counts"))
            return cls(AgentSet(*sizes), network, about["env_options"])
        except (CheckpointError, *_UNREADABLE) as error:
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
        observations = stacked[:, None, :]
        return self.network.values(NumpyOperations(), self.network.arrays, observations)[:, 0, :]


def _network_name(policy: NetworkPolicy) -> str:
    return "mlp" if policy.structure is None else policy.structure.network


def _about(policy: NetworkPolicy, env: AnyParallelEnv | None) -> dict[str, Any]:
    from ugat_marl.policies.network_policy import checkpoint_header

    agents = policy.agents
    description = checkpoint_header(agents, policy.hidden, policy.env_options, policy.shared)
    if env is not None and (misfit := policy.misfit(env)):
        raise OptionError(
            "the policy was trained for other intersections than those of the environment: "
            f"{misfit}; give the scenario it was trained in"
        )
    base = env.unwrapped if env is not None else None
    interval_s, made_for_s = getattr(base, "decision_interval_s", None), policy.decision_interval_s
    if interval_s is not None and made_for_s not in (None, interval_s):
        raise OptionError(
            f"the policy was trained for a decision every {made_for_s:g} s, the environment takes "
            f"one every {interval_s:g} s; give the scenario it was trained in"
        )
    return {
        "kind": _KIND,
        "network": _network_name(policy),
        **{key: description[key] for key in ("agents", "observation_sizes", "action_counts")},
        "observation_width": agents.widest_observation,
        "action_width": agents.most_actions,
        "env_options": json.loads(description["env_options"]),
        "decision_interval_s": interval_s,
        "intersections": getattr(base, "intersection_of", None),
        "parameters": _sum(_parameters(policy)),
    }


def _parameters(policy: NetworkPolicy) -> bytes:
    """Return all that decides the values besides the sizes: weights, ceiling and structure."""
    ceiling, structure = policy.ceiling, policy.structure
    written = "" if structure is None else json.dumps(structure.written(), sort_keys=True)
    limits = b"" if ceiling is None else ceiling.tobytes()
    return policy.parameters.tobytes() + limits + written.encode()


def _matrices(policy: NetworkPolicy) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **cast(dict[str, Any], portable_network(policy).arrays))
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
            f"writing .onnx needs the package onnx; run {install_command('onnx')}, or export "
            "to .npz or .ts"
        ) from None
    network, agents, rows = portable_network(policy), policy.agents, len(policy.agents)
    graph = _OnnxOperations(onnx, dict(network.arrays))
    observations = graph.reshape("observations", (rows, 1, -1))
    values = network.values(graph, {name: name for name in network.arrays}, observations)
    graph.constants["never"] = np.array(-np.inf, np.float32)
    permitted = graph.node("Where", "allowed", graph.reshape(values, (rows, -1)), "never")
    helper, kinds = onnx.helper, onnx.TensorProto
    greedy = helper.make_node("ArgMax", [permitted], ["actions"], axis=1, keepdims=0)
    value = helper.make_tensor_value_info
    whole = helper.make_graph(
        [*graph.nodes, greedy],
        "ugat_marl_policy",
        [
            value("observations", kinds.FLOAT, [rows, agents.widest_observation]),
            value("allowed", kinds.BOOL, [rows, agents.most_actions]),
        ],
        [value("actions", kinds.INT64, [rows])],
        [onnx.numpy_helper.from_array(array, name) for name, array in graph.constants.items()],
    )
    opset = [helper.make_opsetid("", _OPSET)]
    model = helper.make_model(whole, opset_imports=opset, ir_version=_IR_VERSION)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


class _OnnxOperations:
    """The operations of a portable network as nodes of a graph; names stand for arrays.

    Args:
        onnx: The package.
        constants: Arrays of the graph by name; more are added where an operation needs them.
    """

    def __init__(self, onnx: Any, constants: dict[str, NDArray[Any]]) -> None:
        self._onnx = onnx
        self.constants = constants
        self.nodes: list[Any] = []

    def node(self, kind: str, *inputs: str, **attributes: int) -> str:
        """Add a node and return the name of its output."""
        output = f"result_{len(self.nodes)}"
        made = self._onnx.helper.make_node(kind, [*inputs], [output], **attributes)
        self.nodes.append(made)
        return output

    def matmul(self, left: str, right: str) -> str:
        return self.node("MatMul", left, right)

    def add(self, left: str, right: str) -> str:
        return self.node("Add", left, right)

    def multiply(self, left: str, right: str) -> str:
        return self.node("Mul", left, right)

    def minimum(self, left: str, right: str) -> str:
        return self.node("Min", left, right)

    def relu(self, array: str) -> str:
        return self.node("Relu", array)

    def concat(self, arrays: Sequence[str]) -> str:
        return self.node("Concat", *arrays, axis=-1)

    def last(self, array: str) -> str:
        # an index of one axis keeps the axis
        return self.node("Gather", array, self._integers(-1), axis=-1)

    def reshape(self, array: str, shape: tuple[int, ...]) -> str:
        return self.node("Reshape", array, self._integers(*shape))

    def _integers(self, *numbers: int) -> str:
        name = "integers_" + "_".join(map(str, numbers))
        self.constants[name] = np.array(numbers, np.int64)
        return name


FORMATS: dict[str, tuple[str, Callable[[Any], bytes]]] = {
    ".ts": ("TorchScript", _torchscript),
    ".onnx": ("ONNX", _onnx),
    ".npz": ("matrices", _matrices),
}
"""Suffix to the name of the format and the function that writes it."""
