"""The composed transformation: what it executes, and what it refuses to load."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ugat_marl.data import AgentLayout
from ugat_marl.errors import CheckpointError, EpisodeError, OptionError
from ugat_marl.grounding import UNCERTAINTY_METHODS, GateConfig, InverseConfig, PhaseTransform
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.uncertainty import Method, MethodName
from ugat_marl.seeding import torch_generator

LAYOUTS = {"a_0": AgentLayout(3, 4, 1), "b_0": AgentLayout(2, 2)}


def transform(seed: int = 0, **options: object) -> PhaseTransform:
    """Untrained models declared fitted: for composing them it does not matter what they learnt."""
    made = PhaseTransform(LAYOUTS, seed, **options)
    made.forward.fitted.fill_(True)
    made.inverse.fitted.fill_(True)
    return made


def state(made: PhaseTransform, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return made.stack.observations({a: rng.random(v.size, np.float32) for a, v in LAYOUTS.items()})


def test_composition_is_inverse_after_forward() -> None:
    made = transform(gate=GateConfig(mode="infinite"))
    observations, own = state(made), np.array([3, 1])
    outcome = made(observations, own)
    with torch.no_grad():
        predicted = made.forward.predict(observations, torch.tensor([[3], [1]]))
        answer = made.inverse.predict(observations, predicted)
    assert outcome.grounded.tolist() == answer.action[:, 0].tolist()
    assert outcome.u.tolist() == answer.u[:, 0].tolist()
    assert outcome.executed.tolist() == outcome.grounded.tolist()
    assert outcome.accepted.all()


def test_the_gate_decides_agent_by_agent() -> None:
    made = transform(gate=GateConfig(mode="static", static_alpha=0.5))
    observations, own = state(made), np.array([3, 1])
    u = made(observations, own).u
    made.gate.alpha = np.array([u[0] + 1e-3, u[1] - 1e-3])
    outcome = made(observations, own)
    assert outcome.accepted.tolist() == [True, False]
    assert outcome.executed.tolist() == [outcome.grounded[0], 1]
    assert made.gate.report().decisions.tolist() == [2, 2]


def test_a_masked_grounded_action_is_not_taken() -> None:
    made = transform()
    observations = state(made)
    grounded = made(observations, np.array([0, 0])).grounded
    own = np.array([(grounded[0] + 1) % 4, 1 - grounded[1]])
    made_again = made(observations, own)
    permitted = made.stack.masks({})
    permitted[0, made_again.grounded[0]] = False
    outcome = made(observations, own, permitted)
    assert not outcome.accepted[0] and outcome.executed[0] == own[0]
    assert outcome.accepted[1] and outcome.executed[1] == outcome.grounded[1]


def test_grounded_actions_are_always_phases_the_agent_has() -> None:
    made = transform()
    for seed in range(50):
        outcome = made(10 * state(made, seed) - 5, np.array([0, 0]))
        assert outcome.grounded[1] < 2 and (outcome.u > 0).all() and (outcome.u <= 1).all()


def test_nothing_is_grounded_before_the_models_are_fitted() -> None:
    made = PhaseTransform(LAYOUTS, 0)
    with pytest.raises(EpisodeError, match="before the models are fitted"):
        made(state(made), np.array([0, 0]))


def test_models_must_agree_on_the_phase() -> None:
    with pytest.raises(OptionError, match="include_phase is True in the forward and False"):
        transform(forward=ForwardConfig(include_phase=True))
    both = transform(
        forward=ForwardConfig(include_phase=True), inverse=InverseConfig(include_phase=True)
    )
    assert both(state(both), np.array([0, 0])).u.shape == (2,)


def test_save_and_load_give_the_same_actions_and_the_same_gate(tmp_path: Path) -> None:
    one, two = transform(seed=1), transform(seed=2)
    one(state(one), np.array([0, 1]))
    one.gate.update()
    one.save(tmp_path / "grounding.pt")
    two.load(tmp_path / "grounding.pt")
    for seed in range(5):
        own = np.array([seed % 4, seed % 2])
        first, second = one(state(one, seed), own), two(state(two, seed), own)
        assert first.executed.tolist() == second.executed.tolist()
        assert first.u.tolist() == second.u.tolist()
    assert one.gate.alpha.tolist() == two.gate.alpha.tolist()


@pytest.mark.parametrize("method", UNCERTAINTY_METHODS)
def test_a_checkpoint_brings_its_method_with_it(tmp_path: Path, method: MethodName) -> None:
    one, two = transform(seed=1), transform(seed=2)
    one.inverse.renew(Method(method, members=3, passes=4), torch_generator(7))
    one.inverse.fitted.fill_(True)
    one.save(tmp_path / "grounding.pt")
    two.load(tmp_path / "grounding.pt")
    assert two.inverse.method == Method(method, members=3, passes=4)
    for seed in range(5):
        own = np.array([seed % 4, seed % 2])
        first, second = one(state(one, seed), own), two(state(two, seed), own)
        assert first.executed.tolist() == second.executed.tolist()
        assert first.u.tolist() == second.u.tolist()
        assert method != "none" or (first.accepted.all() and not first.u.any())


def written(path: Path, **changes: object) -> Path:
    torch.save({"kind": "grounding", **transform().state_dict(), **changes}, path)
    return path


def with_part(model: str, name: str, value: torch.Tensor | None) -> dict[str, object]:
    state_dict = getattr(transform(), model).state_dict()
    if value is None:
        del state_dict[name]
    else:
        state_dict[name] = value
    return {model: state_dict}


def test_a_state_from_another_file_is_checked_as_well() -> None:
    """The driver keeps the state inside a checkpoint of its own."""
    broken = transform().state_dict()
    broken["forward"][BIAS].fill_(torch.nan)
    with pytest.raises(CheckpointError, match=f"forward.{BIAS} .* not finite"):
        transform().load_state_dict(broken)


BIAS = "network.layers.0.bias"


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        (with_part("forward", BIAS, torch.full((2, 1, 128), torch.nan)), f"{BIAS}.*NaN"),
        (with_part("inverse", "net.head.bias", torch.tensor([0, 0, torch.inf, 0])), "infinity"),
        (
            with_part("forward", BIAS, torch.zeros(2, 1, 64)),
            r"\(2, 1, 64\); expected \(2, 1, 128\)",
        ),
        (with_part("forward", BIAS, None), "other parts"),
        ({"inverse": None}, "inverse model .* other parts"),
        ({"layouts": {"a_0": [3, 4, 1]}}, "other agents"),
        ({"layouts": {"b_0": [2, 2, 0], "a_0": [3, 4, 1]}}, "other agents"),
        ({"method": {"name": "ensemble", "members": 2, "passes": 1}}, r"weight.*expected \(4, 11"),
        ({"method": {"name": "dropout", "members": 2, "passes": 1}}, "other parts"),
        ({"method": {"name": "bayes"}}, "no method: uncertainty is 'bayes'"),
        ({"method": {"name": "ensemble", "members": 10**9}}, "no method: members is 1000000000"),
        ({"method": {"name": "ensemble", "members": "many"}}, "no method"),
        ({"method": {"name": "dropout", "passes": 2.5}}, "no method: passes is 2.5"),
        ({"method": 3}, "no method"),
        ({"gate": None}, "no gate"),
        ({"gate": {"agents": ["a_0"]}}, "gate in the checkpoint belongs to other agents"),
    ],
)
def test_bad_checkpoints_are_named_and_change_nothing(
    tmp_path: Path, changes: dict, complaint: str
) -> None:
    made = transform(seed=5)
    before = made(state(made), np.array([0, 0])).u.tolist()
    with pytest.raises(CheckpointError, match=f"bad.pt: .*{complaint}"):
        made.load(written(tmp_path / "bad.pt", **changes))
    assert made(state(made), np.array([0, 0])).u.tolist() == before


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 half a zip", b"\x80\x02}q\x00."])
def test_files_that_are_no_checkpoint(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.pt").write_bytes(content)
    with pytest.raises(CheckpointError, match="bad.pt: not a readable checkpoint"):
        transform().load(tmp_path / "bad.pt")
    torch.save([1, 2], tmp_path / "list.pt")
    with pytest.raises(CheckpointError, match=r"list\.pt: holds None, expected 'grounding'"):
        transform().load(tmp_path / "list.pt")
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        transform().load(tmp_path / "absent.pt")


def test_half_a_checkpoint(tmp_path: Path) -> None:
    whole = written(tmp_path / "bad.pt").read_bytes()
    (tmp_path / "bad.pt").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match="bad.pt"):
        transform().load(tmp_path / "bad.pt")


def test_a_checkpoint_with_code_in_it_is_not_run(tmp_path: Path) -> None:
    torch.save({"layouts": Path("x")}, tmp_path / "bad.pt")
    with pytest.raises(CheckpointError, match="bad.pt"):
        transform().load(tmp_path / "bad.pt")
