"""The parts of timed grounding without any fit: delays, what is executed, and checkpoints."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ugat_marl.data import AgentLayout
from ugat_marl.errors import CheckpointError, EpisodeError, OptionError
from ugat_marl.grounding import (
    UNCERTAINTY_METHODS,
    GateConfig,
    InverseConfig,
    PhaseTransform,
    Stack,
    TimedConfig,
    TimedTransform,
)
from ugat_marl.grounding.delays import EpisodeRewards, LostTime
from ugat_marl.grounding.forward import DelayedForward, ForwardConfig
from ugat_marl.grounding.inverse import DelayModel
from ugat_marl.grounding.stacked import StackedTransitions
from ugat_marl.grounding.timed import likely_delay
from ugat_marl.grounding.transform import GroundedActions
from ugat_marl.grounding.uncertainty import Method, MethodName
from ugat_marl.seeding import torch_generator

LAYOUTS = {"a_0": AgentLayout(3, 4, 1), "b_0": AgentLayout(2, 2)}
STACK = Stack(LAYOUTS)
USUAL_S = torch.tensor([[0.5, 1.5, 2.5, 3.5], [1.0, 2.0, 0.0, 0.0]])


def transform(seed: int = 0, **options: object) -> TimedTransform:
    """Untrained models declared fitted, with constants that tell phases and agents apart."""
    made = TimedTransform(LAYOUTS, seed, **options)
    made.forward.fitted.fill_(True)
    made.inverse.fitted.fill_(True)
    made.constants.delay_s.copy_(USUAL_S)
    return made


def state(phases: tuple[int, int] = (0, 0), seed: int = 0) -> torch.Tensor:
    """Random traffic under these phases."""
    rng = np.random.default_rng(seed)
    rows = {}
    for (agent, layout), phase in zip(LAYOUTS.items(), phases, strict=True):
        rows[agent] = rng.random(layout.size, np.float32)
        lights = np.eye(layout.phases)[phase]
        rows[agent][layout.features : layout.features + layout.phases] = lights
    return STACK.observations(rows)


def same(one: GroundedActions, two: GroundedActions) -> bool:
    names = [field.name for field in dataclasses.fields(GroundedActions)]
    return all(np.array_equal(getattr(one, name), getattr(two, name)) for name in names)


# --- the likeliest delay


def test_even_odds_leave_the_expected_delay_as_it_is() -> None:
    expected = torch.tensor([0.0, 0.7, 2.0, 4.9, 5.0])
    found = likely_delay(torch.full((5, 6), 1 / 6), expected, 1.0)
    assert found.tolist() == pytest.approx(expected.tolist(), abs=1e-4)


def test_sharp_odds_win_over_what_is_expected() -> None:
    sharp = torch.full((6, 6), 1e-9) + torch.eye(6)
    assert likely_delay(sharp, torch.full((6,), 2.0), 1.0).tolist() == [0, 1, 2, 3, 4, 5]
    # The narrower the spread, the less a single state may say.
    weak = torch.tensor([0.1, 0.1, 0.1, 0.1, 0.1, 0.5])
    found = [float(likely_delay(weak, torch.tensor(2.0), spread)) for spread in (0.1, 1.0, 10.0)]
    assert found == sorted(found)
    assert found[0] == pytest.approx(2.0) and found[-1] == pytest.approx(5.0)


def test_two_likely_neighbours_are_decided_by_what_is_expected() -> None:
    torn = torch.tensor([[1e-6, 0.5, 0.5, 1e-6]]).expand(4, 4)
    found = likely_delay(torn, torch.tensor([0.0, 1.3, 1.7, 3.0]), 1.0)
    assert found.tolist() == pytest.approx([1.0, 1.3, 1.7, 2.0], abs=1e-4)


ODDS = st.lists(st.floats(0.0, 1.0), min_size=2, max_size=8)


@given(odds=ODDS, expected=st.floats(-2.0, 12.0), spread=st.floats(0.01, 100.0))
def test_a_likely_delay_is_always_one_that_was_tried(
    odds: list[float], expected: float, spread: float
) -> None:
    probability = torch.tensor(odds) / max(sum(odds), 1e-30)
    found = float(likely_delay(probability[None], torch.tensor([expected]), spread))
    assert 0.0 <= found <= len(odds) - 1


@given(classes=st.integers(2, 8), data=st.data(), spread=st.floats(0.1, 10.0))
def test_one_certain_answer_is_taken_whatever_was_expected(
    classes: int, data: st.DataObject, spread: float
) -> None:
    answer = data.draw(st.integers(0, classes - 1))
    expected = data.draw(st.floats(0.0, classes - 1.0))
    if abs(answer - expected) > 2 * spread:
        return  # so far off that even certainty on paper may be doubted
    certain = torch.nn.functional.one_hot(torch.tensor([answer]), classes).float()
    assert float(likely_delay(certain, torch.tensor([expected]), spread)) == answer


# --- the models


def test_inputs_for_a_delay_belong_to_the_whole_seconds_beside_it() -> None:
    model = DelayedForward(STACK, ForwardConfig(hidden=(4,)), 3, torch_generator(0))
    extra = model.extra(torch.tensor([[0.0, 1.0, 1.25, 3.0, 9.0], [0.5, 2.0, 2.5, 2.75, 3.5]]))
    assert extra[0].tolist() == [[0, 0, 0], [1, 0, 0], [0.75, 0.25, 0], [0, 0, 1], [0, 0, 0]]
    assert extra[1].tolist() == [[0.5, 0, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0.25, 0.75], [0, 0, 0.5]]  # fmt: skip  # noqa: E501


def test_what_the_model_predicts_between_seconds_depends_on_both() -> None:
    model = DelayedForward(STACK, ForwardConfig(hidden=(8,)), 2, torch_generator(0))
    observation, action = state(), torch.tensor([[1], [1]])
    with torch.no_grad():
        changes = [
            model(observation, action, model.extra(torch.full((2, 1), seconds)))
            for seconds in (0.0, 1.0, 1.001, 2.0)
        ]
    assert torch.allclose(changes[1], changes[2], atol=1e-2)
    assert not torch.allclose(changes[0], changes[1], atol=1e-3)
    assert not torch.allclose(changes[1], changes[3], atol=1e-3)


def test_h_reads_state_change_and_phase_directly_behind_each_other() -> None:
    model = DelayModel(STACK, InverseConfig(hidden=(4,)), 3, torch_generator(0))
    observation = torch.arange(2 * 8.0).view(2, 1, 8)
    change = -torch.arange(1, 2 * 3 + 1.0).view(2, 1, 3)
    inputs = model.inputs(observation, torch.tensor([[2], [1]]), change)
    assert inputs[0, 0].tolist() == [0, 1, 2, 3, 4, 5, 6, 7, -1, -2, -3, 0, 0, 1, 0]
    assert inputs[1, 0].tolist() == [8, 9, 10, 11, -4, -5, 0, 1] + [0] * 7
    assert model.action_columns[0, 0].nonzero()[:, 0].tolist() == [11, 12, 13, 14]
    assert model.action_columns[1, 0].nonzero()[:, 0].tolist() == [6, 7]
    answer = model.predict(observation, torch.tensor([[2], [1]]), change)
    assert answer.probability.shape == (2, 1, 4)
    assert torch.allclose(answer.probability.sum(-1), torch.ones(2, 1))


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"most_s": 0}, "most_s is 0; allowed: >= 1"),
        ({"answer": "both"}, "answer is 'both'; allowed: state, constant"),
        ({"spread_s": 0.0}, "spread_s"),
        ({"spread_s": float("nan")}, "spread_s"),
        ({"target_noise": -0.1}, "target_noise"),
        ({"target_noise": float("inf")}, "target_noise"),
    ],
)
def test_impossible_options_are_refused(options: dict, complaint: str) -> None:
    with pytest.raises(OptionError, match=complaint):
        TimedConfig(**options)


def test_a_phase_to_predict_is_refused() -> None:
    for part in (
        {"forward": ForwardConfig(include_phase=True)},
        {"inverse": InverseConfig(include_phase=True)},
    ):
        with pytest.raises(OptionError, match="include_phase says nothing; leave it off"):
            TimedTransform(LAYOUTS, 0, **part)


# --- what is executed


@pytest.mark.parametrize("answer", ["state", "constant"])
@pytest.mark.parametrize("mode", ["infinite", "static"])
def test_phases_never_change_and_a_green_that_goes_on_is_not_held_back(
    answer: str, mode: str
) -> None:
    made = transform(gate=GateConfig(mode=mode, static_alpha=0.5), timed=TimedConfig(answer=answer))
    held = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        shown = int(rng.integers(4)), int(rng.integers(2))
        own = np.array([rng.integers(4), rng.integers(2)])
        outcome = made(
            state(shown, seed), own, made.stack.masks({"a_0": np.eye(4, dtype=np.int8)[0]})
        )
        assert outcome.executed.tolist() == outcome.grounded.tolist() == own.tolist()
        stays = own == np.array(shown)
        assert (outcome.delay_s[stays] == 0).all()
        assert ((outcome.delay_s >= 0) & (outcome.delay_s <= made.timed.most_s)).all()
        assert outcome.delay_s.dtype == np.float32
        held += int((outcome.delay_s > 0).sum())
    assert held


def test_constant_answers_are_the_constants() -> None:
    made = transform(timed=TimedConfig(answer="constant"))
    for a in range(4):
        outcome = made(state((3 - a, 1)), np.array([a, 0]))
        assert outcome.delay_s.tolist() == [USUAL_S[0, a], 1.0]
        assert outcome.accepted.tolist() == [USUAL_S[0, a] > 0, True] and not outcome.u.any()
    stays = made(state((2, 0)), np.array([2, 0]))
    assert not stays.accepted.any() and not stays.delay_s.any()
    assert made.gate.report().decisions.tolist() == [0, 0]  # there is nothing to decide


def test_where_h_is_not_trusted_the_constant_is_taken_and_not_zero() -> None:
    made = transform(gate=GateConfig(mode="static", static_alpha=0.5))
    made.constants.delay_s.copy_(torch.full((2, 4), 2.0))
    observations, own = state((0, 1)), np.array([2, 0])
    u = made(observations, own).u
    answers, again = made.delays(observations, observations, torch.from_numpy(own)[:, None])
    assert again[:, 0].tolist() == pytest.approx(u.tolist())
    for accepted in ([True, False], [False, True], [False, False], [True, True]):
        made.gate.alpha = np.where(accepted, u + 1e-3, u)  # u = alpha is refused as well
        outcome = made(observations, own)
        assert outcome.accepted.tolist() == accepted
        expected = np.where(accepted, answers[:, 0].detach().numpy(), 2.0)
        assert outcome.delay_s.tolist() == pytest.approx(expected.tolist())
    made.gate.alpha = np.full(2, np.inf)
    made.gate.trust(np.array([False, True]))
    outcome = made(observations, own)
    assert outcome.delay_s[0] == 2.0 and outcome.accepted.tolist() == [False, True]


def test_f_is_compared_where_a_green_was_asked_for_that_begins() -> None:
    """Phase 0 is shown. A command for 1 may have been lost, and 1 may run after one for 0."""
    now = state((0, 0)).expand(-1, 3, -1)
    asked, ran = (torch.tensor([row] * 2) for row in ([1, 0, 1], [0, 1, 1]))
    number, weight = torch.zeros(2, 3), torch.tensor([[1.0, 1.0, 1.0], [1.0, 1.0, 0.0]])
    times = torch.arange(3).expand(2, 3)
    data = StackedTransitions(now, now, None, asked, ran, number, times, times, weight)
    changes, compared = transform().training_data(data)
    assert torch.equal(changes.action, asked)
    assert compared.tolist() == [[1.0, 0.0, 1.0], [1.0, 0.0, 0.0]]


def test_constant_delays_are_set_where_models_have_learnt_something() -> None:
    """All rewards are those of greens late by 4 s, beside a lost time of 0.5 s and of 1 s."""
    curve = np.array([-10.0, -12.0, -14.0, -17.0, -20.0])
    paid = EpisodeRewards(np.full((2, 2), -20.0), np.ones((5, 2, 2)) * curve[:, None, None])
    lost = LostTime(
        USUAL_S, np.array([0.5, 1.0]), np.full(2, 0.2), np.full(2, 2.0), np.full(2, 100)
    )
    for learnt, beyond_s in (([True, True], [3.5, 3.0]), ([True, False], [3.5, 0.0])):
        made = transform()
        matched = made._set_constants(lost, np.array(learnt), paid)
        assert matched is not None and matched.beyond_s.tolist() == beyond_s
        assert made.constants.beyond_s.flatten().tolist() == beyond_s
        assert torch.equal(made.constants.delay_s, USUAL_S * torch.tensor(learnt)[:, None])


def test_constant_delays_of_other_agents_are_taken_away() -> None:
    made = transform()
    made.constants.beyond_s.fill_(1.0)
    made.restrict(np.array([True, False]))
    assert made.acting.tolist() == [True, False]
    assert torch.equal(made.constants.delay_s, USUAL_S * torch.tensor([[1.0], [0.0]]))
    assert made.constants.beyond_s.flatten().tolist() == [1.0, 0.0]


def test_h_that_is_sure_moves_the_delay_away_from_the_constant() -> None:
    made = transform()
    made.constants.delay_s.copy_(torch.full((2, 4), 2.0))
    with torch.no_grad():  # h answers 4 s whatever it sees
        for parameter in made.inverse.parameters():
            parameter.zero_()
        made.inverse.net.head.bias.copy_(torch.tensor([0.0, 0, 0, 0, 1e6, 0]))
    outcome = made(state((0, 1)), np.array([2, 0]))
    assert outcome.delay_s.tolist() == pytest.approx([4.0, 4.0])
    assert made.gate.report().change_rate.tolist() == [1.0, 1.0]
    usual = transform()
    with torch.no_grad():
        for parameter in usual.inverse.parameters():
            parameter.zero_()
    outcome = usual(state((0, 1)), np.array([2, 0]))  # h knows nothing
    assert outcome.delay_s.tolist() == pytest.approx([2.5, 1.0], abs=0.051)
    assert usual.gate.report().change_rate.tolist() == [0.0, 0.0]


def test_nothing_is_grounded_before_the_models_are_fitted() -> None:
    with pytest.raises(EpisodeError, match="before the models are fitted"):
        TimedTransform(LAYOUTS, 0)(state(), np.array([0, 0]))


# --- checkpoints


@pytest.mark.parametrize("method", UNCERTAINTY_METHODS)
def test_save_and_load_give_identical_groundings(tmp_path: Path, method: MethodName) -> None:
    one, two = transform(seed=1), TimedTransform(LAYOUTS, 2)
    one.inverse.renew(Method(method, members=3, passes=4), torch_generator(7))
    one.inverse.fitted.fill_(True)
    one.gate.alpha = np.array([0.5, np.inf])
    one.save(tmp_path / "grounding.pt")
    two.load(tmp_path / "grounding.pt")
    assert two.fitted and two.inverse.method == Method(method, members=3, passes=4)
    assert torch.equal(two.constants.delay_s, USUAL_S)
    for seed in range(5):
        own = np.array([seed % 4, seed % 2])
        assert same(one(state(seed=seed), own), two(state(seed=seed), own))
    assert one.gate.report().acceptance.tolist() == two.gate.report().acceptance.tolist()


def test_the_model_of_the_simulation_travels_with_the_checkpoint(tmp_path: Path) -> None:
    """A warm start goes on from it."""
    one, two = transform(seed=1), transform(seed=2)
    one.save(tmp_path / "grounding.pt")
    two.load(tmp_path / "grounding.pt")
    weights = two.simulated.state_dict()
    assert all(torch.equal(v, weights[k]) for k, v in one.simulated.state_dict().items())


@pytest.mark.parametrize("alike", [False, True])
def test_checkpoints_of_another_grounding_are_refused(tmp_path: Path, alike: bool) -> None:
    phase = PhaseTransform(LAYOUTS, 0)
    phase.forward.fitted.fill_(True)
    phase.inverse.fitted.fill_(True)
    # As many classes as there are phases, so that all but the inputs of h would fit.
    timed = transform(timed=TimedConfig(most_s=3 if alike else 5))
    phase.save(tmp_path / "phase.pt")
    timed.save(tmp_path / "timed.pt")
    observations, own = state((0, 1)), np.array([2, 0])
    before = phase(observations, own), timed(observations, own)
    with pytest.raises(CheckpointError, match=r"phase\.pt: .* made with other options"):
        timed.load(tmp_path / "phase.pt")
    with pytest.raises(CheckpointError, match=r"timed\.pt: .* made with other options"):
        phase.load(tmp_path / "timed.pt")
    assert same(before[0], phase(observations, own)) and same(before[1], timed(observations, own))


def test_a_checkpoint_with_another_longest_delay_or_without_a_part_is_refused(
    tmp_path: Path,
) -> None:
    made = transform()
    transform(timed=TimedConfig(most_s=4)).save(tmp_path / "short.pt")
    with pytest.raises(CheckpointError, match=r"short\.pt: .* made with other options"):
        made.load(tmp_path / "short.pt")
    for part in ("simulated", "constants"):
        whole = made.state_dict()
        del whole[part]
        with pytest.raises(CheckpointError, match=f"{part} model .* other parts"):
            made.load_state_dict(whole)
