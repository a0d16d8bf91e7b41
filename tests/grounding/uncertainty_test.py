"""Every method of uncertainty against a world whose answer is known.

In clear weather action k pushes the features in direction k of K: whoever saw the push knows the
action. In fog the push is the same whatever the action: the best answer is a guess, wrong in
1 - 1/K of the cases. Pushes of another length than 1 never happen.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.grounding import (
    UNCERTAINTY_METHODS,
    FitConfig,
    Fitter,
    GateConfig,
    InverseConfig,
    InverseModel,
    Stack,
    fit_inverse,
)
from ugat_marl.grounding.gate import Gate
from ugat_marl.grounding.phase import PhaseInverseReport
from ugat_marl.grounding.uncertainty import DropoutNet, EnsembleNet, MethodName
from ugat_marl.seeding import torch_generator

LAYOUTS = {"two_0": AgentLayout(3, 2), "three_0": AgentLayout(3, 3, 1)}
STACK = Stack(LAYOUTS)
UNSURE: tuple[MethodName, ...] = ("edl", "dropout", "ensemble")
CONFIG = FitConfig(epochs=40, learning_rate=3e-3)
Fits = dict[str, tuple[InverseModel, PhaseInverseReport]]


def features(fog: bool, direction: int, k: int, length: float = 1.0) -> list[float]:
    angle = 2 * np.pi * direction / k
    push = (0.0, -1.0) if fog else (np.cos(angle), np.sin(angle))
    return [float(fog), length * push[0], length * push[1]]


def world(
    steps: int = 160,
    fog: float = 0.3,
    noise: float = 0.2,
    layouts: dict[str, AgentLayout] = LAYOUTS,
) -> TransitionLog:
    """Four episodes, each agent with random numbers of its own."""
    streams = {a: np.random.default_rng(len(a)) for a in layouts}
    recorder = TransitionRecorder(
        Provenance("weather", "", "sim", (0, 1, 2, 3), 10.0, "count", dict(layouts))
    )
    for episode in range(4):
        for step in range(steps):
            before, after, action = {}, {}, {}
            for agent, layout in layouts.items():
                rng, rest = streams[agent], [0.0] * (layout.phases + layout.context)
                action[agent] = int(rng.integers(layout.phases))
                foggy = bool(rng.random() < fog)
                push = np.array(features(foggy, action[agent], layout.phases))
                push[1:] += noise * rng.standard_normal(2)
                before[agent] = np.array([float(foggy), 0.0, 0.0, *rest], np.float32)
                after[agent] = np.array([*push, *rest], np.float32)
            zeros = dict.fromkeys(layouts, 0.0)
            recorder.record(episode, step, before, action, action, zeros, after)
    return recorder.log()


def fitted(
    method: MethodName, log: TransitionLog, config: FitConfig = CONFIG, seed: int = 0
) -> tuple[InverseModel, PhaseInverseReport]:
    layouts = dict(log.provenance.layouts)
    shape = InverseConfig(hidden=(32, 32), embedding=16)
    h = InverseModel(Stack(layouts), shape, torch_generator(0))
    fitter = Fitter(dataclasses.replace(config, uncertainty=method), seed)
    return h, fit_inverse(h, log, fitter)


@pytest.fixture(scope="module")
def weather() -> TransitionLog:
    return world()


@pytest.fixture(scope="module")
def all_fits(weather: TransitionLog) -> Fits:
    return {name: fitted(name, weather) for name in UNCERTAINTY_METHODS}


def asked(h: InverseModel, agent: int, push: list[list[float]]) -> Any:
    """Answers of one agent to transitions from rest; the fog of s is that of s'."""
    there = torch.zeros(2, len(push), STACK.width)
    there[:, :, :3] = torch.tensor(push)
    here = there.clone()
    here[:, :, 1:] = 0.0
    with torch.no_grad():
        found = h.predict(here, there)
    k = list(LAYOUTS.values())[agent].phases
    return found.action[agent], found.probability[agent, :, :k], found.u[agent]


@pytest.mark.parametrize("method", UNCERTAINTY_METHODS)
@pytest.mark.parametrize("agent", [0, 1])
def test_every_method_finds_the_action_and_the_odds(
    method: str, agent: int, all_fits: Fits
) -> None:
    h, report = all_fits[method]
    k = STACK.phases[agent]
    clear = [features(False, direction, k) for direction in range(k)]
    action, probability, _ = asked(h, agent, clear)
    assert action.tolist() == list(range(k))
    assert (probability.amax(-1) > 0.85).all()
    _, probability, _ = asked(h, agent, [features(True, 0, k)])
    assert probability[0].tolist() == pytest.approx([1 / k] * k, abs=0.12)
    best = 0.7 + 0.3 / k  # nobody does better in the mean
    assert report.accuracy[agent] == pytest.approx(best, abs=0.07)
    assert report.calibration.ece < 0.1


@pytest.mark.parametrize("method", UNSURE)
@pytest.mark.parametrize("agent", [0, 1])
def test_u_is_low_where_all_is_clear_and_high_in_fog_and_off_the_data(
    method: str, agent: int, all_fits: Fits
) -> None:
    h, _ = all_fits[method]
    k = STACK.phases[agent]
    clear = [features(False, direction, k) for direction in range(k)]
    far = [features(False, direction, k, length=-3.0) for direction in range(k)]
    _, _, u = asked(h, agent, [*clear, features(True, 0, k), *far])
    assert (u[:k] < 0.3).all()
    assert u[k] > 2 * u[:k].max()
    assert method == "edl" or u[k] > 0.9  # even odds; evidence only has to be scarcer
    assert (u[k + 1 :] > 0.6).all()


@pytest.mark.parametrize("method", UNSURE)
def test_u_ranks_wrong_above_right_and_unknown_above_known(method: str, all_fits: Fits) -> None:
    calibration = all_fits[method][1].calibration
    # A perfect u is the same for all answers in fog: it reaches about 0.9, and not 1.
    assert calibration.auroc > 0.8
    assert calibration.mean_u_off_data > calibration.mean_u + 0.3
    assert calibration.auroc_off_data > 0.7  # fog on the data is as uncertain
    risks = calibration.risk_by_coverage
    assert risks[0] < 0.02 and risks[2] < 0.02 and risks[-1] > 0.12
    assert all_fits[method][1].uncertainty == method


def test_without_uncertainty_u_is_zero_and_says_nothing(all_fits: Fits) -> None:
    calibration = all_fits["none"][1].calibration
    assert calibration.mean_u == calibration.mean_u_off_data == 0.0
    assert calibration.auroc == calibration.auroc_off_data == 0.5
    assert len({round(risk, 12) for risk in calibration.risk_by_coverage}) == 1


@pytest.mark.parametrize("method", UNCERTAINTY_METHODS)
def test_the_gate_works_with_every_method_and_stays_open_without_any(
    method: str, all_fits: Fits
) -> None:
    h, _ = all_fits[method]
    gate = Gate(STACK.agents, GateConfig())
    own, other = np.array([0, 0]), np.array([1, 1])
    for _ in range(3):
        for fog in (False, False, True):
            u = torch.stack([asked(h, i, [features(fog, 0, STACK.phases[i])])[2] for i in (0, 1)])
            accepted = gate.decide(u[:, 0].numpy(), own, other)
            expected = gate.iteration == 0 or method == "none" or not fog
            assert accepted.tolist() == [expected] * 2
        blind = method == "none" and gate.iteration > 0
        assert ("every grounded action was taken" in gate.update().warning) == blind
    assert bool(np.isinf(gate.alpha).all()) == (method == "none")


@pytest.mark.parametrize("method", UNCERTAINTY_METHODS)
def test_the_same_seed_fits_the_same_and_answers_are_functions(method: MethodName) -> None:
    log, config = world(steps=40), dataclasses.replace(CONFIG, epochs=4)
    one, _ = fitted(method, log, config)
    torch.rand(5)  # the global generator must not matter
    two, _ = fitted(method, log, config)
    other, _ = fitted(method, log, config, seed=1)
    states = [h.state_dict() for h in (one, two, other)]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not torch.equal(states[0]["net.head.weight"], states[2]["net.head.weight"])
    rows = torch.randn(2, 300, 10, generator=torch_generator(1))
    with torch.no_grad():
        before = torch.get_rng_state()
        whole, again, alone = one.answer(rows), one.answer(rows), one.answer(rows[:, 7:8])
    assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(whole.u, again.u) and torch.equal(whole.action, again.action)
    assert torch.allclose(whole.u[:, 7:8], alone.u, atol=1e-6)


def test_an_ensemble_of_one_is_the_plain_network(weather: TransitionLog) -> None:
    config = dataclasses.replace(CONFIG, members=1, off_data_weight=0.0, epochs=8)
    one, first = fitted("ensemble", weather, config)
    plain, second = fitted("none", weather, config)
    for name, value in plain.state_dict().items():
        assert torch.equal(value, one.state_dict()[name]), name
    assert first.training == second.training
    assert first.accuracy.tolist() == second.accuracy.tolist()
    assert first.calibration.ece == second.calibration.ece
    assert first.calibration.auroc > 0.8  # what it lacks is the reading of u


def test_members_differ_in_weights_and_in_the_order_of_their_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[torch.Tensor] = []
    loss = EnsembleNet.loss

    def watching(net: EnsembleNet, inputs: torch.Tensor, *rest: Any) -> torch.Tensor:
        if not rest[1].held_out:
            seen.append(inputs)
        return loss(net, inputs, *rest)

    monkeypatch.setattr(EnsembleNet, "loss", watching)
    config = dataclasses.replace(CONFIG, epochs=1, members=3)
    h, _ = fitted("ensemble", world(steps=40), config)
    assert seen[0].shape[:3] == (2, 3, 64)
    whole = torch.cat(seen, dim=2)
    for m in (1, 2):
        assert not torch.equal(whole[:, 0], whole[:, m])
        assert torch.equal(whole[0, 0].sort(0).values, whole[0, m].sort(0).values)  # the same rows
    heads = h.net.head.weight.detach().view(3, 3, -1)
    assert not torch.equal(heads[0], heads[1]) and not torch.equal(heads[1], heads[2])


def test_little_data_is_thinned_more_than_much() -> None:
    """The divergence weighs 1/N: rates go towards a half with few rows, and down with many."""
    config = dataclasses.replace(CONFIG, epochs=150, patience=150, off_data_weight=0.0)
    layouts = {"two_0": AgentLayout(3, 2)}
    rates: list[float] = []
    for steps, epochs in ((8, 300), (500, 12)):  # about as many updates
        log = world(steps=steps, fog=0.0, layouts=layouts)
        h, _ = fitted("dropout", log, dataclasses.replace(config, epochs=epochs))
        assert isinstance(h.net, DropoutNet)
        logits = torch.cat([logit.detach().flatten() for logit in h.net._logits()])
        rates.append(float(logits.sigmoid().mean()))
    few, many = rates
    assert few > 0.2 and many < 0.6 * few


def test_a_warm_start_goes_on_with_its_own_method_only(weather: TransitionLog) -> None:
    config = dataclasses.replace(CONFIG, epochs=1, warm_start=True)
    h, first = fitted("ensemble", weather, dataclasses.replace(config, epochs=20))
    again = fit_inverse(h, weather, Fitter(dataclasses.replace(config, uncertainty="ensemble"), 3))
    assert again.training.held_out_loss <= first.training.held_out_loss + 0.01
    other = fit_inverse(h, weather, Fitter(dataclasses.replace(config, uncertainty="dropout"), 3))
    assert other.training.held_out_loss > first.training.held_out_loss
    assert h.method.name == "dropout" and isinstance(h.net, DropoutNet)
