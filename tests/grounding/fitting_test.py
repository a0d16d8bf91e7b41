"""Fitting on planted dynamics, where it is known what f and h have to find."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import spearmanr
from sklearn.metrics import roc_auc_score

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.errors import LogError, OptionError
from ugat_marl.grounding import (
    FitConfig,
    Fitter,
    InverseConfig,
    InverseModel,
    PhaseTransform,
    Stack,
    fit_inverse,
    stack_log,
)
from ugat_marl.grounding.fitting import Changes, EpochCallback, OffData, split
from ugat_marl.grounding.forward import ForwardConfig, ForwardModel
from ugat_marl.grounding.phase import PhaseReport, inverse_accuracy
from ugat_marl.grounding.reports import (
    ForwardReport,
    TrainingRecord,
    auroc,
    better_than_chance,
    blocks_of,
    expected_calibration_error,
    forward_report,
    rate_by_quantile,
    risk_by_coverage,
    spearman,
)
from ugat_marl.seeding import torch_generator


def fit_forward(model: ForwardModel, log: TransitionLog, fitter: Fitter) -> ForwardReport:
    data = stack_log(log, model.stack)
    changes = Changes("forward", model.view.of(data), data.next_observation, data.asked)
    return fitter.fit_changes(model, changes, fitter.split(data, model.stack))


LAYOUTS = {"a_0": AgentLayout(6, 3), "b_0": AgentLayout(4, 2, 2)}
STACK = Stack(LAYOUTS)
SMALL = {"hidden": (32, 32)}
QUICK = FitConfig(epochs=15, learning_rate=3e-3)


def planted(
    rate: float,
    episodes: int = 4,
    steps: int = 150,
    seed: int = 0,
    noise: float = 0.05,
    **other: int,
) -> TransitionLog:
    """Phase k empties the lanes k, k + K, ... by `rate`; every lane fills a little by chance.

    ``swap=1`` records, as the policy's action, another phase than the one that was served.
    """
    rng = np.random.default_rng(seed)
    seeds = tuple(range(episodes))
    recorder = TransitionRecorder(Provenance("planted", "", "sim", seeds, 10.0, "count", LAYOUTS))

    def observe(lanes: np.ndarray, phase: int, layout: AgentLayout) -> np.ndarray:
        one_hot = np.eye(layout.phases)[phase]
        return np.concatenate([lanes, one_hot, np.zeros(layout.context)]).astype(np.float32)

    for episode in range(episodes):
        lanes = {a: rng.random(v.features) for a, v in LAYOUTS.items()}
        phase = dict.fromkeys(LAYOUTS, 0)
        for step in range(steps):
            before = {a: observe(lanes[a], phase[a], v) for a, v in LAYOUTS.items()}
            for agent, layout in LAYOUTS.items():
                phase[agent] = int(rng.integers(layout.phases))
                served = np.arange(layout.features) % layout.phases == phase[agent]
                arrivals = rng.random(layout.features) * 2 * noise
                lanes[agent] = np.clip(lanes[agent] - rate * served + arrivals, 0, 1)
            asked = {a: (phase[a] + other.get("swap", 0)) % v.phases for a, v in LAYOUTS.items()}
            after = {a: observe(lanes[a], phase[a], v) for a, v in LAYOUTS.items()}
            recorder.record(episode, step, before, asked, phase, dict.fromkeys(LAYOUTS, 0.0), after)
    return recorder.log()


def models(seed: int = 0) -> tuple[ForwardModel, InverseModel]:
    return (
        ForwardModel(STACK, ForwardConfig(**SMALL), torch_generator(seed, "f")),
        InverseModel(STACK, InverseConfig(**SMALL, embedding=16), torch_generator(seed, "h")),
    )


def fit(
    f: ForwardModel,
    h: InverseModel,
    real: TransitionLog,
    simulated: TransitionLog,
    config: FitConfig,
    seed: int,
    on_epoch: EpochCallback | None = None,
) -> PhaseReport:
    """Fits two models as those of a transform."""
    made = PhaseTransform(LAYOUTS, 0, f.config, h.config)
    made.forward, made.inverse = f, h
    return made.fit(real, simulated, Fitter(config, seed, on_epoch))


@pytest.fixture(scope="module")
def fitted():
    f, h = models()
    real, simulated = planted(0.15, seed=1), planted(0.3, seed=2)
    report = fit(f, h, real, simulated, FitConfig(epochs=40, learning_rate=3e-3), seed=0)
    return f, h, report


@pytest.fixture(scope="module")
def noisy():
    """Chance moves the lanes as much as the phase does, so that h must err sometimes."""
    _, h = models()
    log = planted(0.12, seed=2, noise=0.1)
    return fit_inverse(h, log, Fitter(FitConfig(epochs=30, learning_rate=3e-3), seed=0))


def test_forward_beats_no_change_and_comes_near_the_noise(fitted) -> None:
    _, _, report = fitted
    assert (report.forward.ratio < 0.8).all()
    # Arrivals are uniform on [0, 0.1]: nobody predicts better than their deviation, 0.029.
    assert (report.forward.error > 0.02).all() and (report.forward.error < 0.045).all()
    assert report.forward.training.split == "episodes"


def test_forward_knows_the_real_rate(fitted) -> None:
    f, _, _ = fitted
    observation = torch.zeros(2, 1, STACK.width)
    observation[0, 0, :6], observation[1, 0, :4] = 0.5, 0.5
    observation[0, 0, 6] = observation[1, 0, 4] = 1.0
    with torch.no_grad():
        change = f.predict(observation, torch.tensor([[1], [1]])) - observation[..., :6]
    assert change[0, 0].tolist() == pytest.approx([0.05, -0.1, 0.05] * 2, abs=0.05)
    assert change[1, 0, :4].tolist() == pytest.approx([0.05, -0.1] * 2, abs=0.05)


def test_inverse_recovers_the_planted_action(fitted) -> None:
    _, _, report = fitted
    assert (report.inverse.accuracy > 0.9).all()
    assert report.inverse.chance.tolist() == pytest.approx([1 / 3, 1 / 2])
    assert (report.inverse.majority < 0.65).all()


def test_u_tells_wrong_answers_from_right_ones(noisy) -> None:
    assert (noisy.accuracy > noisy.majority + 0.1).all() and (noisy.accuracy < 0.99).all()
    calibration = noisy.calibration
    assert calibration.auroc > 0.65 and calibration.spearman > 0.1
    assert calibration.error_by_quantile[-1] > calibration.error_by_quantile[0] + 0.1
    assert (noisy.auroc > 0.6).all()


def test_u_is_higher_off_the_data_than_on_it(fitted, noisy) -> None:
    for calibration in (fitted[2].inverse.calibration, noisy.calibration):
        assert calibration.mean_u_off_data > calibration.mean_u + 0.2
        assert calibration.auroc_off_data > 0.7


def test_u_rises_on_unknown_inputs_that_no_training_drew(fitted) -> None:
    _, h, report = fitted
    data = stack_log(planted(0.3, episodes=1, seed=5), STACK)
    with torch.no_grad():
        known = h.predict(data.observation, data.next_observation).u.mean(1)
        # A world in which every lane fills at once: a change no phase of the simulation makes.
        filled = (data.observation + 0.3).clone()
        flooded = h.predict(data.observation, filled).u.mean(1)
    assert (flooded > known + 0.2).all()
    assert not [w for w in report.warnings if "off the data" in w]


def test_report_is_flat_numbers(fitted) -> None:
    numbers = fitted[2].as_dict()
    assert all(isinstance(value, float) for value in numbers.values())
    for name in (
        "forward/error",
        "forward/no_change",
        "forward/ratio/b_0",
        "inverse/accuracy",
        "inverse/accuracy/a_0",
        "inverse/held_out_loss",
        "calibration/mean_u_off_data",
        "calibration/error_by_quantile/4",
        "calibration/risk_by_coverage/4",
        "calibration/ece",
        "agreement",
        "mean_u_on_predictions",
        "accuracy_on_real/a_0",
        "mean_u_on_real",
        "accuracy_on_means",
    ):
        assert math.isfinite(numbers[name]), name


def test_h_reads_means_best_if_it_learnt_from_means() -> None:
    log = planted(0.1, noise=0.3)  # arrivals scatter more than what a phase does
    found = {}
    both: tuple[Literal["observed", "smoothed"], ...] = ("observed", "smoothed")
    for pairs in both:
        f, h = models()
        found[pairs] = fit(f, h, log, log, dataclasses.replace(QUICK, pairs=pairs), seed=0)
    observed, smoothed = (found[pairs].accuracy_on_means.mean() for pairs in both)
    assert smoothed > observed + 0.05
    assert found["observed"].inverse.accuracy.mean() >= found["smoothed"].inverse.accuracy.mean()


def test_accuracy_and_mean_u_are_of_held_out_rows() -> None:
    answer = SimpleNamespace(
        action=torch.tensor([[0, 1, 1, 0]]), u=torch.tensor([[0.1, 0.2, 0.3, 0.8]])
    )
    inverse: Any = SimpleNamespace(
        view=SimpleNamespace(of=lambda data: data), predict=lambda *_: answer
    )
    data: Any = SimpleNamespace(executed=torch.tensor([[0, 1, 0, 1]]))
    held_out = torch.tensor([[1.0, 1.0, 1.0, 0.0]])
    accuracy, mean_u = inverse_accuracy(inverse, data, torch.zeros(1, 4, 2), held_out)
    assert accuracy == pytest.approx([2 / 3])
    assert mean_u == pytest.approx([0.2])


def test_a_poor_fit_says_so() -> None:
    f, h = models()
    hopeless = planted(0.0, episodes=2, steps=60)  # the phase does nothing
    report = fit(f, h, hopeless, hopeless, FitConfig(epochs=2, off_data_weight=0.0), seed=0)
    told = "h is not shown to be better than the most frequent phase at 2 of 2 (a_0, b_0)"
    assert told in report.warnings
    assert report.inverse.accuracy.mean() < 0.7


def test_without_uncertainty_the_report_says_that_all_is_taken() -> None:
    f, h = models()
    log = planted(0.3, episodes=2)
    report = fit(f, h, log, log, dataclasses.replace(QUICK, uncertainty="none"), seed=0)
    (told,) = report.warnings
    assert told == "without uncertainty u is 0, and the gate takes every grounded action"
    assert report.as_dict()["calibration/mean_u"] == 0.0


def test_fitting_twice_gives_the_same_weights_and_another_seed_others() -> None:
    log = planted(0.3, episodes=2, steps=60)
    states = []
    for seed in (1, 1, 2):
        f, h = models(seed=5)
        torch.rand(3)  # global randomness must not matter
        fit(f, h, log, log, QUICK, seed)
        states.append({**f.state_dict(), **{f"h.{k}": v for k, v in h.state_dict().items()}})
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    weights = [name for name in states[0] if name.endswith("weight")]
    assert not any(torch.equal(states[0][name], states[2][name]) for name in weights)


def test_the_number_of_threads_changes_nothing() -> None:
    log = planted(0.3, episodes=2, steps=60)
    before, errors = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            f, _ = models()
            errors.append(fit_forward(f, log, Fitter(QUICK, seed=0)).error.tolist())
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert errors[0] == errors[1]


def test_a_cold_start_forgets_and_a_warm_one_goes_on() -> None:
    log = planted(0.3, episodes=3, steps=100)
    cold, warm = QUICK, dataclasses.replace(QUICK, warm_start=True)
    _, h = models()
    first = fit_inverse(h, log, Fitter(cold, seed=1))
    _, other = models()
    fit_inverse(other, planted(0.1, episodes=2, steps=50), Fitter(cold, seed=9))
    again = fit_inverse(other, log, Fitter(cold, seed=1))
    assert again.training == first.training
    assert again.accuracy.tolist() == first.accuracy.tolist()
    further = fit_inverse(h, log, Fitter(dataclasses.replace(warm, epochs=1), seed=2))
    assert further.training.held_out_loss <= first.training.held_out_loss + 1e-2
    assert further.accuracy.mean() > 0.8


def test_a_warm_start_that_can_only_do_harm_leaves_the_weights_alone() -> None:
    log = planted(0.3, episodes=2, steps=60)
    f, _ = models()
    fit_forward(f, log, Fitter(QUICK, seed=1))
    before = {name: value.clone() for name, value in f.state_dict().items()}
    wild = dataclasses.replace(QUICK, warm_start=True, learning_rate=10.0, epochs=3)
    fit_forward(f, log, Fitter(wild, seed=2))
    assert all(torch.equal(before[name], value) for name, value in f.state_dict().items())


def test_each_agent_keeps_its_own_best_weights() -> None:
    """Training agents together is training each alone, best epoch included."""
    log = planted(0.3, episodes=2, steps=80)
    f, _ = models()
    start = {name: value.clone() for name, value in f.state_dict().items()}
    config = dataclasses.replace(QUICK, warm_start=True)
    f.fitted.fill_(True)  # keeps the weights drawn here
    together = fit_forward(f, log, Fitter(config, seed=1))
    for i, agent in enumerate(LAYOUTS):
        layouts = {agent: LAYOUTS[agent]}
        alone = ForwardModel(Stack(layouts), ForwardConfig(**SMALL), torch_generator(0))
        own = {
            name: start[name][i : i + 1, : v.shape[1], : v.shape[2]]
            if v.dim() == 3
            else start[name]
            for name, v in alone.state_dict().items()
        }
        alone.load_state_dict(own)
        alone.fitted.fill_(True)
        frame = log.frame.filter(log.frame["agent"] == agent)
        small = TransitionLog(dataclasses.replace(log.provenance, layouts=layouts), frame)
        # Patience counts all agents together, so give the lone one the epochs they had.
        epochs = dataclasses.replace(config, epochs=together.training.epochs, patience=999)
        report = fit_forward(alone, small, Fitter(epochs, seed=1))
        assert report.error[0] == pytest.approx(together.error[i], rel=1e-3)


def test_a_fit_does_not_end_before_the_loss_is_that_of_training() -> None:
    log = planted(0.3, episodes=4, steps=90)
    f, h = models()
    config = FitConfig(epochs=60, patience=3, kl_epochs=40, off_data_weight=1.0, learning_rate=3e-3)
    report = fit(f, h, log, log, config, seed=0)
    assert report.inverse.training.epochs > 40
    assert (report.inverse.accuracy > 0.95).all()  # 0.52 where patience ends it in epoch 5


def test_f_learns_what_was_asked_and_h_what_was_served() -> None:
    log = planted(0.3, episodes=3, steps=120, swap=1)
    f, h = models()
    report = fit(f, h, log, log, FitConfig(epochs=25), seed=0)
    assert (report.inverse.accuracy > 0.85).all()  # against the served phase
    observation = torch.full((2, 1, STACK.width), 0.5)
    with torch.no_grad():
        change = f.predict(observation, torch.tensor([[1], [1]])) - observation[..., :6]
    # Asking for phase 1 had phase 0 served, so lanes 0, 3 (and 0, 2) empty.
    assert change[0, 0].argsort()[:2].sort().values.tolist() == [0, 3]
    assert change[1, 0, :4].argsort()[:2].sort().values.tolist() == [0, 2]


def test_split_is_by_episode_and_stable_when_the_log_grows() -> None:
    log = planted(0.3, episodes=6, steps=10)
    parts = split(stack_log(log, STACK), 4, STACK)
    episodes = stack_log(log, STACK).episode
    assert sorted(set(episodes[0][parts.held_out[0].bool()].tolist())) == [1, 5]
    assert not (parts.train * parts.held_out).any()
    assert (parts.train + parts.held_out == 1).all()
    two = split(stack_log(planted(0.3, episodes=2, steps=10), STACK), 4, STACK)
    assert two.held_out[0].tolist() == [0.0] * 10 + [1.0] * 10


def test_an_agent_that_is_missing_in_held_out_episodes_is_split_in_time() -> None:
    data = stack_log(planted(0.3, episodes=3, steps=8), STACK)
    weight = data.weight.clone()
    weight[0, data.episode[0] == 1] = 0.0  # the one that is held out
    parts = split(dataclasses.replace(data, weight=weight), 4, STACK)
    late = (data.step[0] > 5) & (data.episode[0] != 1)
    assert parts.held_out[0].tolist() == late.double().tolist()
    assert parts.held_out[1].tolist() == (data.episode[1] == 1).double().tolist()


@pytest.mark.parametrize("first", [0, 5, 400])  # a measured log counts from its scenario's begin
def test_one_episode_is_split_in_time(first: int) -> None:
    data = stack_log(planted(0.3, episodes=1, steps=20), STACK)
    parts = split(dataclasses.replace(data, step=data.step + first), 4, STACK)
    assert parts.kind == "steps"
    assert parts.train[0].tolist() == [1.0] * 15 + [0.0] * 5


def test_too_little_data_and_foreign_data_are_refused() -> None:
    f, h = models()
    with pytest.raises(LogError, match="a_0 has .* record at least two whole episodes"):
        fit_forward(f, planted(0.3, episodes=1, steps=1), Fitter(QUICK, seed=0))
    foreign = InverseModel(Stack({"a_0": AgentLayout(6, 3)}), InverseConfig(), torch_generator(0))
    with pytest.raises(LogError, match="does not fit the models"):
        fit_inverse(foreign, planted(0.3, episodes=2, steps=5), Fitter(QUICK, seed=0))
    assert not h.fitted


@pytest.mark.parametrize(
    "change",
    [{"observation": "queue"}, {"decision_interval_s": 5.0}],
)
def test_logs_that_cannot_be_composed_are_refused(change: dict) -> None:
    f, h = models()
    log = planted(0.3, episodes=2, steps=5)
    other = TransitionLog(dataclasses.replace(log.provenance, **change), log.frame)
    with pytest.raises(LogError, match=f"real log has {next(iter(change))}"):
        fit(f, h, other, log, QUICK, seed=0)


def test_the_gap_is_visible_in_actions(fitted) -> None:
    """Served at half the rate, h still names the lane, and is less sure than at home."""
    report = fitted[2]
    assert (report.accuracy_on_real > 0.8).all()
    assert report.mean_u_on_real.mean() > report.inverse.mean_u.mean() + 0.05


@pytest.mark.parametrize("rows", [60, 90])
def test_the_best_of_many_epochs_that_learnt_nothing_is_not_trusted(rows: int) -> None:
    """Every epoch answers with another constant, and the one that fits held-out rows best is kept.

    Rows are scattered around 1 by 1, so that the mean beats no change.
    """
    agents, epochs, rng = 24, 20, np.random.default_rng(0)
    stack = Stack({f"a_{k}": AgentLayout(4, 2) for k in range(agents)})
    model = ForwardModel(stack, ForwardConfig(**SMALL), torch_generator(0, "f"))
    happened = torch.from_numpy(rng.normal(1, 1, (agents, rows, 4)))
    answers = torch.from_numpy(rng.normal(1, 0.2, (epochs, agents, 1, 4)))
    best = ((answers - happened) ** 2).mean((2, 3)).argmin(0)
    constant = answers[best, torch.arange(agents)].expand_as(happened)
    mean = torch.from_numpy(rng.normal(1, 0.1, (agents, 1, 4)))  # of the rows trained on

    def report(predicted: torch.Tensor) -> ForwardReport:
        held_out, record = torch.ones(agents, rows), TrainingRecord(1, 0.0, 0.0, "steps")
        return forward_report(model, predicted, happened, happened - mean, held_out, record)

    lucky = report(constant)
    assert (lucky.error < lucky.mean_outcome).sum() > 2 and lucky.beats_no_change.all()
    assert lucky.learnt.sum() <= 1
    assert report(1 + 0.5 * (happened - 1)).learnt.all()


def test_errors_that_hang_together_do_not_pass_for_many_independent_ones() -> None:
    """An f as good as a trivial answer passes at 30 % of the agents if each row counts alone."""
    rows, rho, rng = 360, 0.9, np.random.default_rng(0)
    errors = rng.normal(0, 1, (2, 400, rows))
    for k in range(1, rows):
        errors[..., k] = rho * errors[..., k - 1] + math.sqrt(1 - rho**2) * errors[..., k]
    trivial, own = torch.from_numpy(errors**2)
    held_out = torch.ones(400, rows)
    assert better_than_chance(trivial - own, held_out).mean() < 0.1
    assert better_than_chance(trivial - 0.2 * own, held_out).mean() > 0.8
    held_out[:, 29:] = 0  # less than two blocks
    assert not better_than_chance(trivial + 9, held_out).any()


def test_blocks_are_of_consecutive_held_out_rows() -> None:
    rows = torch.tensor([[0, 1, 1, 0, 1, 1, 1], [1, 0, 0, 0, 0, 0, 0]], dtype=torch.float32)
    assert blocks_of(rows, 2).tolist() == [[-1, 0, 0, -1, 1, 1, 1], [0, *[-1] * 6]]


def test_h_that_cannot_know_the_phase_is_not_trusted() -> None:
    """Nothing depends on the phase here, and by luck h is right more often than one answer."""
    layouts = {f"a_{k}": AgentLayout(2, 4) for k in range(24)}
    rng, zero = np.random.default_rng(0), dict.fromkeys(layouts, 0.0)
    recorder = TransitionRecorder(Provenance("chance", "", "sim", (), 10.0, "count", layouts))
    for row in range(240):
        before, after = (
            {a: np.float32([*rng.random(2), 1, 0, 0, 0]) for a in layouts} for _ in range(2)
        )
        ran = {a: int(rng.integers(4)) for a in layouts}
        recorder.record(row // 120, row % 120, before, ran, ran, zero, after)
    log = recorder.log()
    made = PhaseTransform(layouts, 0, ForwardConfig(**SMALL), InverseConfig(**SMALL))
    report = made.fit(log, log, Fitter(QUICK, seed=0))
    assert (report.inverse.accuracy > report.inverse.majority).sum() > 6
    assert report.inverse.beats_majority.sum() <= 2
    sure = dataclasses.replace(
        report.forward, beats_no_change=np.ones(24, bool), beats_mean_outcome=np.ones(24, bool)
    )
    lucky = dataclasses.replace(report, forward=sure)
    assert lucky.trusted().tolist() == report.inverse.beats_majority.tolist()
    assert any("h is not shown to be better than the most frequent" in w for w in lucky.warnings)


def test_only_models_that_learnt_something_are_trusted(fitted) -> None:
    report = fitted[2]
    assert report.trusted().tolist() == [True, True]
    assert report.trusted(least_accuracy=1.1).tolist() == [False, False]
    beats = np.array([False, True])
    poor = dataclasses.replace(
        report, forward=dataclasses.replace(report.forward, beats_no_change=beats)
    )
    assert poor.trusted().tolist() == [False, True]
    assert any(
        "f is not shown to be better than no change at 1 of 2 (a_0)" in w for w in poor.warnings
    )


def test_epochs_are_reported_as_they_end() -> None:
    seen: list[tuple[str, int, float]] = []
    f, h = models()
    log = planted(0.3, episodes=2, steps=20)
    config = FitConfig(epochs=3)
    fit(f, h, log, log, config, 0, on_epoch=lambda *args: seen.append(args))
    assert [(name, epoch) for name, epoch, _ in seen] == [
        (name, epoch) for name in ("forward", "simulated", "inverse") for epoch in (1, 2, 3)
    ]


@pytest.mark.parametrize(
    "options",
    [
        {"epochs": 0},
        {"batch_size": 0},
        {"patience": 0},
        {"held_out_every": 1},
        {"learning_rate": 0.0},
        {"learning_rate": float("nan")},
        {"kl_weight": -1.0},
        {"off_data_weight": -0.1},
    ],
)
def test_impossible_options_are_refused(options: dict) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        FitConfig(**options)


def test_auroc_and_spearman_by_hand() -> None:
    wrong = np.array([False, False, True, True])
    assert auroc(np.array([0.1, 0.2, 0.3, 0.4]), wrong) == 1.0
    assert auroc(np.array([0.4, 0.3, 0.2, 0.1]), wrong) == 0.0
    assert auroc(np.array([0.1, 0.3, 0.3, 0.4]), wrong) == pytest.approx(3.5 / 4)
    assert math.isnan(auroc(np.array([0.1, 0.2]), np.array([True, True])))
    assert spearman(np.array([1, 2, 3]), np.array([10, 20, 30])) == pytest.approx(1.0)
    assert spearman(np.array([1, 2, 3]), np.array([9, 1, 5])) == pytest.approx(-0.5)
    assert math.isnan(spearman(np.array([1, 2]), np.array([4, 4])))
    u = np.array([0.4, 0.1, 0.3, 0.2])
    assert rate_by_quantile(u, np.array([True, False, False, False]), 2) == (0.0, 0.5)


@given(st.lists(st.tuples(st.integers(0, 9), st.booleans()), max_size=40))
def test_auroc_and_spearman_are_those_of_the_libraries(rows: list[tuple[int, bool]]) -> None:
    u = np.array([number for number, _ in rows]) / 7
    wrong = np.array([flag for _, flag in rows], bool)
    if wrong.any() and not wrong.all():
        assert auroc(u, wrong) == pytest.approx(roc_auc_score(wrong, u))
    else:
        assert math.isnan(auroc(u, wrong))
    if len(set(u)) > 1 and len(set(wrong)) > 1:
        assert spearman(u, wrong) == pytest.approx(spearmanr(u, wrong).statistic)
    else:
        assert math.isnan(spearman(u, wrong))


def test_risk_by_coverage_by_hand() -> None:
    u, wrong = np.array([0.4, 0.1, 0.3, 0.2]), np.array([True, False, True, False])
    assert risk_by_coverage(u, wrong, 4) == (0.0, 0.0, pytest.approx(1 / 3), 0.5)
    assert risk_by_coverage(np.zeros(4), wrong, 2) == (0.5, 0.5)  # whoever comes first
    assert math.isnan(risk_by_coverage(u[:1], wrong[:1], 4)[0])


def test_expected_calibration_error_by_hand() -> None:
    confidence = np.array([0.95, 0.95, 0.95, 0.95, 0.55])
    correct = np.array([True, True, True, False, False])
    expected = 4 / 5 * abs(0.95 - 0.75) + 1 / 5 * 0.55
    assert expected_calibration_error(confidence, correct, 10) == pytest.approx(expected)
    assert expected_calibration_error(np.ones(3), np.ones(3, bool)) == 0.0
    assert expected_calibration_error(np.array([0.0, 1.0]), np.array([True, False])) == 1.0
    assert math.isnan(expected_calibration_error(np.array([]), np.array([], bool)))


@pytest.mark.parametrize(("state_share", "redrawn"), [(0.0, 0.0), (0.25, 0.25), (1.0, 1.0)])
def test_invented_inputs_have_a_drawn_change_and_a_share_of_them_a_drawn_state(
    state_share: float, redrawn: float
) -> None:
    """Observed values are below 1, drawn ones from 5 to 6; the first column is a phase."""
    generator = torch_generator(0, "a test")
    inputs = torch.rand(1, 50, 4, generator=generator)
    kept, change = torch.tensor([[[1, 0, 0, 0]], [[0, 0, 1, 1]]], dtype=torch.bool)[:, None]
    ends = (torch.full((1, 1, 4), end) for end in (5.0, 6.0))
    off = OffData(inputs, torch.arange(50)[None], *ends, kept, change)
    drawn = (off.draw(400, generator, state_share) >= 5.0).float().mean(1)[0]
    assert drawn.tolist() == pytest.approx([0.0, redrawn, 1.0, 1.0], abs=0.07)
