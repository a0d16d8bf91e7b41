"""Negative controls on a toy: what there is to see when there is nothing to learn."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.grounding import (
    FitConfig,
    Fitter,
    InverseConfig,
    PhaseTransform,
    Stack,
    answer_with_noise,
    stack_log,
)
from ugat_marl.grounding.controls import shuffled
from ugat_marl.grounding.fitting import split
from ugat_marl.grounding.forward import ForwardConfig, ForwardModel
from ugat_marl.grounding.phase import PhaseReport
from ugat_marl.testing import ToyTraffic

FIT = FitConfig(epochs=25, learning_rate=3e-3)
LAYOUTS = ToyTraffic().layouts
STACK = Stack(LAYOUTS)
CHANCE = np.array([1 / layout.phases for layout in LAYOUTS.values()])


def played(served: int, seed: int, episodes: int = 12) -> TransitionLog:
    """The toy under random phases."""
    env = ToyTraffic(steps=60, served=served)
    rng = np.random.default_rng(seed)
    recorder = TransitionRecorder(Provenance("toy", "", "sim", (), 10.0, "count", LAYOUTS))
    for episode in range(episodes):
        seen, _ = env.reset(seed=100 * seed + episode)
        for step in range(env.steps):
            did = {a: int(rng.integers(v.phases)) for a, v in LAYOUTS.items()}
            then, got, *_ = env.step(did)
            recorder.record(episode, step, seen, did, did, got, then)
            seen = then
    return recorder.log()


SIMULATED = played(6, seed=2)
STATES = stack_log(played(6, seed=9, episodes=3), STACK)


def fitted(real: TransitionLog, noise: bool = False) -> tuple[PhaseTransform, PhaseReport]:
    made = PhaseTransform(
        LAYOUTS, 0, ForwardConfig((32, 32)), InverseConfig((32, 32), embedding=16)
    )
    if noise:
        answer_with_noise(made.forward, 0)
    return made, made.fit(real, SIMULATED, Fitter(FIT, seed=0))


def grounded(made: PhaseTransform) -> tuple[float, float, float]:
    """Grounds an episode; acceptance, share of changed actions, and mean u, over all agents."""
    for k in range(STATES.observation.shape[1]):
        made(STATES.observation[:, k : k + 1], STATES.executed[:, k].numpy())
    report = made.gate.update()
    shares = report.acceptance, report.change_rate, report.mean_u
    acceptance, changed, u = (float(x.mean()) for x in shares)
    return acceptance, changed, u


@pytest.fixture(scope="module")
def honest() -> tuple[PhaseTransform, PhaseReport]:
    """A real world with half the saturation flow."""
    return fitted(played(3, seed=1))


def test_of_the_same_world_nothing_is_changed() -> None:
    made, report = fitted(played(6, seed=3))
    assert (report.agreement > 0.95).all()
    for _ in range(2):  # with the gate open, and with the first alpha
        acceptance, changed, _ = grounded(made)
        assert acceptance > 0.5 and changed <= 0.05


def test_a_gate_that_asks_for_proof_stays_shut_on_shuffled_data(honest) -> None:
    """u does not show them: f answers with the mean, and h knows which phase leads there."""
    made, report = fitted(shuffled(played(3, seed=1), seed=0))
    own = honest[1]
    assert (own.accuracy_on_real > 0.7).all() and (own.agreement > 0.9).all()
    assert (report.accuracy_on_real < CHANCE + 0.15).all()
    assert (report.agreement < CHANCE + 0.2).all()
    # Of two independent numbers one is as far off as sqrt(2) of the other's deviation: the mean
    # beats "no change" without knowing anything.
    assert (report.forward.ratio < 0.9).all()
    assert (report.forward.error > 0.99 * report.forward.mean_outcome).all()
    assert (own.forward.error < 0.6 * own.forward.mean_outcome).all()
    assert any(
        "f is not shown to be better than one answer for every state" in w for w in report.warnings
    )
    assert not report.trusted(0.8).any() and own.trusted(0.8).all()
    made.gate.trust(report.trusted(0.8))
    assert grounded(made)[:2] == (0.0, 0.0)


def test_the_rival_with_one_answer_is_the_mean_of_the_rows_trained_on(honest) -> None:
    data = stack_log(played(3, seed=1), STACK)
    parts = split(data, FIT.held_out_every, STACK)
    for i, layout in enumerate(LAYOUTS.values()):
        after = data.next_observation[i, :, : layout.features].numpy()
        train, held_out = parts.train[i].bool().numpy(), parts.held_out[i].bool().numpy()
        error = np.sqrt(((after[held_out] - after[train].mean(0)) ** 2).mean())
        assert honest[1].forward.mean_outcome[i] == pytest.approx(error, rel=1e-4)


def test_noise_is_as_large_as_what_happens_and_knows_nothing() -> None:
    made, _ = fitted(played(3, seed=1), noise=True)
    asked = STATES.observation, STATES.executed
    with torch.no_grad():
        answer = made.forward(*asked)
        assert torch.equal(answer, made.forward(*asked))  # the same question, the same noise
        other = made.forward(STATES.observation + 1e-6, STATES.executed)
        predicted = made.forward.predict(*asked)
    change = predicted - STATES.observation[..., : predicted.shape[-1]]
    assert not torch.isclose(answer, other).any(-1)[0].all()
    assert not answer[1, :, 3:].any()  # padding stays empty
    happened = made.forward.change(STATES.observation, STATES.next_observation)
    for i, layout in enumerate(LAYOUTS.values()):
        own, truth = (x[i, :, : layout.features].flatten() for x in (change, happened))
        assert abs(np.corrcoef(own, truth)[0, 1]) < 0.1
        assert own.std().item() == pytest.approx(made.forward.scale[i].item(), rel=0.1)


def test_with_noise_for_f_u_rises_and_a_gate_that_asks_for_proof_stays_shut(honest) -> None:
    made, report = fitted(played(3, seed=1), noise=True)
    assert (report.forward.ratio > 1.2).all()  # of two independent changes the ratio is sqrt(2)
    assert any("f is not shown to be better than no change" in text for text in report.warnings)
    assert (report.mean_u_on_predictions > 1.1 * honest[1].mean_u_on_predictions).all()
    assert not report.trusted(0.8).any() and honest[1].trusted(0.8).all()
    made.gate.trust(report.trusted(0.8))
    acceptance, changed, u = grounded(made)
    assert acceptance == changed == 0.0
    assert u > 1.2 * grounded(honest[0])[2]


def test_noise_of_several_networks_is_as_large() -> None:
    stack = Stack({"a": AgentLayout(3, 2)})
    model = ForwardModel(stack, ForwardConfig(members=5), torch.Generator().manual_seed(0))
    answer_with_noise(model, 0)
    with torch.no_grad():
        answer = model(torch.randn(1, 4000, 5), torch.zeros(1, 4000, dtype=torch.long))
    assert float(answer[..., :3].std()) == pytest.approx(1.0, abs=0.05)


def test_another_seed_makes_another_noise() -> None:
    answers = []
    for seed in (0, 1):
        made = PhaseTransform(LAYOUTS, 0)
        answer_with_noise(made.forward, seed)
        with torch.no_grad():
            answers.append(made.forward(STATES.observation, STATES.executed))
    assert not torch.isclose(*answers).any(-1)[0].all()
