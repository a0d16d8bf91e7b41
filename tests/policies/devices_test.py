"""Learning elsewhere than on the CPU: on a stand-in for a GPU, and on a GPU where there is one.

The stand-in computes on the CPU and says that it does not: tensors that were moved there refuse to
meet tensors that were not, or numpy, as a GPU's do. So whatever an update or a fit forgets to move
is an error on any machine, and what comes out must equal the CPU's to the bit.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from studies.bench.learning_program import Noise
from tests.runs import SMALL, play_nothing, q_values
from ugat_marl.__main__ import main
from ugat_marl.data import SETTINGS_FILE, AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.envs import AgentSet
from ugat_marl.errors import OptionError
from ugat_marl.experiments import PaperConfig, transfer
from ugat_marl.experiments.paper import Planner
from ugat_marl.grounding import (
    UNCERTAINTY_METHODS,
    FitConfig,
    Fitter,
    InputsConfig,
    InverseConfig,
    PhaseTransform,
    TimedConfig,
    TimedTransform,
    Ugat,
    answer_with_noise,
)
from ugat_marl.grounding.fitting import OffData
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.transform import Transform
from ugat_marl.policies import CPU, DQN, NetworkPolicy, device_of, on_device, require_device_name
from ugat_marl.policies.learners.dqn import DQNConfig
from ugat_marl.policies.learners.replay import Batch
from ugat_marl.policies.networks.structure import Junction, Structure

THERE = torch.device("meta")
"""The one device beside the CPU that every torch knows; its tensors hold nothing, ours do."""

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU here")


class Moved(Tensor):
    """A tensor that is on the stand-in; `inner` holds its numbers."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> Moved:
        return Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), dtype=inner.dtype, device=THERE
        )

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func == Tensor.data.__set__:  # would leave `inner` as it was
            args[0].inner = args[1].inner
            return None
        with torch._C.DisableTorchFunctionSubclass():  # what comes to the CPU is a plain tensor
            return func(*args, **(kwargs or {}))

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


class Standin(TorchDispatchMode):
    """While it lasts, there is a second device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


def computed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """One operation on one device; only copies may go from one to the other."""
    given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    moved = {id(leaf.inner): leaf for leaf in given if isinstance(leaf, Moved)}
    # A GPU takes single numbers from the CPU, too.
    here = [leaf for leaf in given if not isinstance(leaf, Moved) and leaf.dim()]
    copies = func in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
    if moved and here and not copies:
        raise AssertionError(f"{func} is given tensors of both devices")
    device = kwargs.get("device") or (THERE if moved else CPU)
    if func is torch.ops.aten.copy_.default:
        device = args[0].device
    elif device == THERE and kwargs.get("generator") is not None:
        raise AssertionError(f"{func} draws there with a generator of the CPU")
    known = {key: CPU if key == "device" and value else value for key, value in kwargs.items()}
    inner = tree_map(lambda x: x.inner if isinstance(x, Moved) else x, (args, known))
    found = func(*inner[0], **inner[1])
    if device != THERE:
        return found

    def wrapped(leaf: Any) -> Any:  # what an operation changed in place is the tensor that it was
        if not isinstance(leaf, Tensor):
            return leaf
        return moved[id(leaf)] if id(leaf) in moved else Moved(leaf)

    return tree_map(wrapped, found)


@pytest.fixture
def standin(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """A second device, for as long as the test lasts."""
    # Adam knows by name which devices have the kernel that it is told to take
    adam = sys.modules["torch.optim.adam"]
    monkeypatch.setattr(adam, "_device_dtype_check_for_fused", lambda *_, **__: None)
    with Standin():
        yield THERE


@pytest.fixture(params=["standin", pytest.param("cuda", marks=needs_gpu)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """The stand-in, and a GPU."""
    if request.param == "standin":
        return request.getfixturevalue("standin")
    return device_of("cuda")


def assert_same(one: Any, other: Any, device: torch.device) -> None:
    """To the bit on the stand-in, which computes as the CPU does; within tolerance on a GPU."""
    tolerance = {"rtol": 0.0, "atol": 0.0} if device == THERE else {"rtol": 2e-3, "atol": 2e-4}
    np.testing.assert_allclose(np.asarray(one), np.asarray(other), **tolerance)


# --- names


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:-1", "cuda:01", "cpu:0", "mps", "CUDA", ""])
def test_what_is_no_devices_name_is_refused(name: str) -> None:
    for check in (require_device_name, device_of):
        with pytest.raises(OptionError, match=r"must be cpu, cuda, or cuda:N"):
            check(name)


@pytest.mark.parametrize(("built", "why"), [(False, "built without CUDA"), (True, "finds no GPU")])
def test_a_gpu_that_is_not_there_is_refused(
    monkeypatch: pytest.MonkeyPatch, built: bool, why: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.cuda, "is_built", lambda: built)
    assert device_of("cpu") == CPU
    with pytest.raises(OptionError, match=f"device = 'cuda:1': .*{why}.*; leave it at cpu"):
        device_of("cuda:1")


def test_a_gpu_beyond_those_there_are_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert device_of("cuda") == torch.device("cuda")
    assert device_of("cuda:1") == torch.device("cuda:1")
    with pytest.raises(OptionError, match="'cuda:3': torch sees 2 GPUs here; name cuda:0, cuda:1"):
        device_of("cuda:3")


# --- the stand-in itself


def test_tensors_of_both_devices_do_not_meet(standin: torch.device) -> None:
    there = torch.ones(3).to(standin)
    assert there.device == standin and float(there.sum()) == 3.0
    assert there.to(CPU).numpy().tolist() == [1, 1, 1]
    with pytest.raises(AssertionError, match="both devices"):
        _ = there + torch.ones(3)
    with pytest.raises(AssertionError, match="generator of the CPU"):
        torch.rand(3, device=standin, generator=torch.Generator())
    with pytest.raises(RuntimeError, match="numpy"):
        there.numpy()


# --- DQN


SIZES = [(7, 3), (5, 2), (6, 2)]
"""Numbers observed and phases of each intersection: four lanes or three, and which phase is on."""
SETTINGS = {"hidden": (16, 16), "batch_size": 8, "warmup_decisions": 10, "replay_capacity": 20}
KINDS = {
    "independent": DQNConfig(**SETTINGS),
    "shared": DQNConfig(**SETTINGS, shared=True),
    "frap": DQNConfig(**SETTINGS, network="frap"),
    "colight": DQNConfig(**SETTINGS, network="colight"),
}


def junction(width: int, phases: int) -> Junction:
    """A movement per lane; the phases take turns in giving them green."""
    lanes = range(width - phases)
    greens = tuple(
        tuple(float(lane % phases == phase) for lane in lanes) for phase in range(phases)
    )
    return Junction(tuple(((lane,),) for lane in lanes), greens, len(lanes))


def learner(kind: str, device: torch.device, *, greedy: bool, seed: int = 0) -> tuple[DQN, Noise]:
    """A learner and where it learns; unless `greedy`, no action depends on what was learnt."""
    env = Noise(SIZES, decisions=16)
    end = {"epsilon_end": 0.1, "epsilon_decay_decisions": 16} if greedy else {"epsilon_end": 1.0}
    structure = None
    if kind == "frap":
        structure = Structure("frap", tuple(junction(*sizes) for sizes in SIZES))
    if kind == "colight":
        structure = Structure("colight", neighbours=((1,), (0, 2), (1,)))
    config = dataclasses.replace(KINDS[kind], **end)
    return DQN(AgentSet.of(env), config, seed, {}, structure, device), env


def trained(
    kind: str, device: torch.device, greedy: bool
) -> tuple[DQN, list[dict[str, float]], dict[str, np.ndarray]]:
    """A learner after two episodes, what it said of them, and the values its policy knows."""
    made, env = learner(kind, device, greedy=greedy)
    told: list[dict[str, float]] = []
    policy = made.learn(env, 2, 0, lambda _, numbers: told.append(dict(numbers)))
    return made, told, q_values(policy, env.reset(seed=9)[0])


@pytest.mark.parametrize("kind", KINDS)
def test_dqn_learns_the_same_elsewhere(kind: str, device: torch.device) -> None:
    greedy = device == THERE
    one, told, values = trained(kind, CPU, greedy)
    other, told_there, values_there = trained(kind, device, greedy)
    assert other._weights.device.type == device.type and one._weights.device == CPU
    assert one.updates == other.updates > 20
    for numbers, there in zip(told, told_there, strict=True):
        assert_same(list(numbers.values()), list(there.values()), device)
    for agent, own in values.items():
        assert_same(own, values_there[agent], device)


@pytest.mark.parametrize("kind", KINDS)
def test_checkpoints_go_on_on_either_device(
    kind: str, device: torch.device, tmp_path: Path
) -> None:
    greedy = device == THERE
    unbroken, env = learner(kind, CPU, greedy=greedy)
    wanted = unbroken.learn(env, 2, 0).parameters
    for number, (begun, ended) in enumerate(((device, CPU), (CPU, device))):
        path = tmp_path / f"{number}.pt"
        first, env = learner(kind, begun, greedy=greedy)
        first.learn(env, 1, 0)
        first.save(path)
        kept = torch.load(path, weights_only=True)  # as it lies there: moved to no device
        assert {leaf.device for leaf in tree_leaves(kept) if isinstance(leaf, Tensor)} == {CPU}
        second, env = learner(kind, ended, greedy=greedy, seed=1)
        second.learn(env, 1, 5)
        second.load(path)
        assert_same(second.learn(env, 1, 0).parameters, wanted, device)


def test_weights_that_another_learner_changes_act_at_the_next_decision(
    standin: torch.device,
) -> None:
    made, _ = learner("shared", standin, greedy=True)
    other, _ = learner("shared", standin, greedy=True, seed=1)
    made._acting.network()
    with torch.no_grad():
        made._weights.copy_(other._weights)
    for one, two in zip(
        made._acting.network().parameters(), other._acting.network().parameters(), strict=True
    ):
        assert torch.equal(one, two)


def test_policies_are_on_the_cpu_and_keep_what_they_know(standin: torch.device) -> None:
    made, env = learner("independent", standin, greedy=True)
    policy = made.learn(env, 1, 0)
    before = policy.parameters
    made.learn(env, 1, 0)
    np.testing.assert_array_equal(policy.parameters, before)
    assert not np.array_equal(made.policy().parameters, before)
    assert {parameter.device for parameter in policy._network.parameters()} == {CPU}


def test_a_batch_that_was_not_moved_is_noticed(
    standin: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tests above can fail."""
    monkeypatch.setattr(Batch, "to", lambda self, _device: self)
    made, env = learner("independent", standin, greedy=True)
    with pytest.raises(AssertionError, match="both devices"):
        made.learn(env, 1, 0)


# --- f and h


LAYOUTS = {"a_0": AgentLayout(4, 3), "b_0": AgentLayout(3, 2, 1), "c_0": AgentLayout(4, 2)}
NEAR = {"a_0": ("b_0",), "b_0": ("a_0", "c_0"), "c_0": ("b_0",)}
INPUTS = {"own": InputsConfig(), "wide": InputsConfig(history=2, hops=1)}
SHAPES = {
    "forward": ForwardConfig(hidden=(16,)),
    "inverse": InverseConfig(hidden=(16,), embedding=8),
}


def recorded(rate: float, seed: int, episodes: int = 4, steps: int = 40) -> TransitionLog:
    """Phase k empties the lanes k, k + K, ... by `rate`, the less the later it begins."""
    rng = np.random.default_rng(seed)
    seeds = tuple(range(episodes))
    recorder = TransitionRecorder(Provenance("planted", "", "sim", seeds, 10.0, "count", LAYOUTS))

    def seen(lanes: np.ndarray, phase: int, layout: AgentLayout) -> np.ndarray:
        return np.concatenate([lanes, np.eye(layout.phases)[phase], np.zeros(layout.context)])

    for episode in range(episodes):
        lanes = {agent: rng.random(layout.features) for agent, layout in LAYOUTS.items()}
        phase = dict.fromkeys(LAYOUTS, 0)
        for step in range(steps):
            before = {a: seen(lanes[a], phase[a], layout) for a, layout in LAYOUTS.items()}
            delay = {a: float(rng.integers(4)) for a in LAYOUTS}
            for agent, layout in LAYOUTS.items():
                phase[agent] = int(rng.integers(layout.phases))
                served = np.arange(layout.features) % layout.phases == phase[agent]
                gone = rate * served * (1 - delay[agent] / 5)
                came = rng.random(layout.features) / 10
                lanes[agent] = np.clip(lanes[agent] - gone + came, 0, 1)
            after = {a: seen(lanes[a], phase[a], layout) for a, layout in LAYOUTS.items()}
            paid = dict.fromkeys(LAYOUTS, 0.0)
            recorder.record(episode, step, before, phase, phase, paid, after, delay)
    return recorder.log()


@pytest.fixture(scope="module")
def logs() -> tuple[TransitionLog, TransitionLog]:
    """Of the street, and of the simulation."""
    return recorded(0.15, seed=1), recorded(0.3, seed=2)


def fitted(
    logs: tuple[TransitionLog, TransitionLog],
    device: torch.device,
    how: FitConfig,
    *,
    inputs: str = "own",
    timed: bool = False,
    noise: bool = False,
) -> tuple[dict[str, float], Transform]:
    """A fit on a device: what is said of it, and its models."""
    around = {"inputs": INPUTS[inputs], "neighbours": NEAR, **SHAPES}
    if timed:
        late = TimedTransform(LAYOUTS, 0, timed=TimedConfig(most_s=3), **around)
        return late.fit(*logs, Fitter(how, 0, device=device)).as_dict(), late
    made = PhaseTransform(LAYOUTS, 0, **around)
    if noise:
        answer_with_noise(made.forward, 0)
    return made.fit(*logs, Fitter(how, 0, device=device)).as_dict(), made


@pytest.fixture
def trainings(monkeypatch: pytest.MonkeyPatch) -> list[torch.device]:
    """Where each training of a fit took place."""
    found: list[torch.device] = []

    def noted(device: torch.device, *modules: torch.nn.Module) -> Any:
        found.append(device)
        return on_device(device, *modules)

    monkeypatch.setattr("ugat_marl.grounding.fitting.on_device", noted)
    return found


CASES = {
    **{f"{name}": (FitConfig(name), {}) for name in UNCERTAINTY_METHODS},
    **{f"timed {name}": (FitConfig(name), {"timed": True}) for name in UNCERTAINTY_METHODS},
    "smoothed": (FitConfig(pairs="smoothed"), {}),
    "nothing off the data": (FitConfig(off_data_weight=0.0), {}),
    "history and neighbours": (FitConfig(), {"inputs": "wide"}),
    "timed, history and neighbours": (FitConfig(), {"inputs": "wide", "timed": True}),
    "noise for f": (FitConfig(), {"noise": True}),
}


@pytest.mark.parametrize("case", CASES)
def test_fits_find_the_same_elsewhere(
    case: str,
    device: torch.device,
    logs: tuple[TransitionLog, TransitionLog],
    trainings: list[torch.device],
) -> None:
    config, options = CASES[case]
    how = dataclasses.replace(config, epochs=4, members=2, passes=3)
    numbers, here = fitted(logs, CPU, how, **options)
    numbers_there, there = fitted(logs, device, how, **options)
    assert trainings == [CPU] * 3 + [device] * 3  # f, a model of the simulation, and h
    assert list(numbers) == list(numbers_there)
    assert_same(list(numbers.values()), list(numbers_there.values()), device)
    for name, model in there.models.items():
        own = here.models[name].state_dict()
        for part, value in model.state_dict().items():
            assert value.device == CPU
            assert_same(own[part], value, device)
        assert {tensor.device for tensor in model.buffers()} <= {CPU}
    assert there.fitted


def test_a_warm_start_goes_on_on_either_device(
    device: torch.device, logs: tuple[TransitionLog, TransitionLog], tmp_path: Path
) -> None:
    how = FitConfig(epochs=2, warm_start=True)
    _, unbroken = fitted(logs, CPU, how)
    numbers = unbroken.fit(*logs, Fitter(how, 1)).as_dict()
    _, first = fitted(logs, device, how)
    first.save(tmp_path / "grounding.pt")
    second = PhaseTransform(LAYOUTS, 5, **SHAPES)
    second.load(tmp_path / "grounding.pt")
    found = second.fit(*logs, Fitter(how, 1, device=device)).as_dict()
    assert_same(list(numbers.values()), list(found.values()), device)


def test_models_come_back_from_a_fit_that_failed(
    standin: torch.device, logs: tuple[TransitionLog, TransitionLog]
) -> None:
    made = PhaseTransform(LAYOUTS, 0, **SHAPES)

    def stop(_model: str, _epoch: int, _loss: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        made.fit(*logs, Fitter(FitConfig(epochs=2), 0, stop, standin))
    assert {tensor.device for tensor in made.forward.state_dict().values()} == {CPU}


def test_invented_inputs_that_were_not_moved_are_noticed(
    standin: torch.device,
    logs: tuple[TransitionLog, TransitionLog],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The tests above can fail."""
    monkeypatch.setattr(OffData, "to", lambda self, _device: self)
    with pytest.raises(AssertionError, match="both devices"):
        fitted(logs, standin, FitConfig(epochs=1))


def test_placed_modules_are_on_the_device_for_a_while(standin: torch.device) -> None:
    layer = torch.nn.Linear(2, 2)
    with on_device(standin, layer):
        assert layer.weight.device == standin
    assert layer.weight.device == CPU


# --- commands


RUN = dataclasses.replace(SMALL, ugat=dataclasses.replace(SMALL.ugat, iterations=1))


def test_a_run_is_the_same_elsewhere_and_goes_on_here(
    standin: torch.device,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    trainings: list[torch.device],
) -> None:
    play_nothing(monkeypatch)
    used: list[str] = []

    def named(name: str) -> torch.device:
        used.append(name)
        return standin if name == "cuda" else CPU

    for module in ("ugat_marl.policies.devices", "ugat_marl.grounding.ugat"):
        monkeypatch.setattr(f"{module}.device_of", named)

    def final(folder: Path) -> np.ndarray[Any, Any]:
        return NetworkPolicy.load(folder / "policies" / "phase.pt").parameters

    transfer(RUN, tmp_path / "cpu")
    elsewhere = dataclasses.replace(RUN, device="cuda")
    transfer(elsewhere, tmp_path / "cuda")
    np.testing.assert_array_equal(final(tmp_path / "cuda"), final(tmp_path / "cpu"))
    # Of the learner, checked before anything runs and when it is made; and of f and h.
    assert used == ["cpu"] * 3 + ["cuda"] * 3
    assert trainings == [CPU] * 3 + [standin] * 3
    told = json.loads((tmp_path / "cuda" / SETTINGS_FILE).read_text())
    assert told["settings"]["device"] == "cuda"

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Ugat, "_fit", stop)
        with pytest.raises(KeyboardInterrupt):
            transfer(elsewhere, tmp_path / "broken")
    transfer(RUN, tmp_path / "broken", resume=True)
    np.testing.assert_array_equal(final(tmp_path / "broken"), final(tmp_path / "cpu"))


@pytest.mark.parametrize(
    "command",
    [["train", "single-v1"], ["paper", "gap"]],
)
def test_commands_refuse_what_is_not_there_and_leave_nothing(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main([*command, "--device", "cuda"]) == 2
    assert "--device cuda: torch" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert main([*command, "--device", "gpu"]) == 2
    assert "must be cpu, cuda, or cuda:N" in capsys.readouterr().err


def test_trainings_of_a_table_are_the_same_jobs_on_any_device(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own, there = (
        Planner("gap", "single-v1", PaperConfig(seeds=1, device=name)).bases[0]
        for name in ("cpu", "cuda")
    )
    assert own.name == there.name
    assert (own.device, there.device) == ("cpu", "cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert main(["paper", "gap", "--device", "cuda", "--ray", "local"]) == 2
    assert "leave --ray or --device out" in capsys.readouterr().err
