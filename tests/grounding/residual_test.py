"""f and h on top of a fitted world: trusted where it is wrong, idle where it is right."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats

from tests.grounding.planted_street_test import LANES, LAYOUTS, PHASES, STARTS, ByHand
from tests.grounding.street_test import LATE, QUICK, SCENARIO
from tests.grounding.timed_test import LAYOUTS as QUEUES
from tests.grounding.timed_test import MOST_S, SHAPES
from tests.grounding.timed_test import QUICK as FIT
from tests.grounding.timed_test import street as queues
from tests.interrupts import KillAt
from tests.runs import FITTED, SMALL, numbers, play_nothing, weights
from ugat_marl.data import TransitionLog
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments import transfer
from ugat_marl.grounding import (
    FitConfig,
    Fitter,
    GateConfig,
    GroundedEnv,
    InverseConfig,
    Residual,
    ResidualConfig,
    StreetConfig,
    TimedConfig,
    TrustConfig,
    UgatConfig,
)
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.reports import p_of_mean
from ugat_marl.grounding.residual import ResidualReport
from ugat_marl.grounding.street_training import RESIDUAL
from ugat_marl.grounding.trust import Trust, _tested, compare
from ugat_marl.grounding.uncertainty import mixed_concentration
from ugat_marl.grounding.view import Moment

PHASE = UgatConfig(
    grounding="street",
    street=StreetConfig(residual=ResidualConfig(kind="phase", members=2)),
    forward=ForwardConfig(hidden=(48,)),
    inverse=InverseConfig(hidden=(48,), embedding=16),
    fit=FitConfig(epochs=25, learning_rate=3e-3),
)
TIMED = UgatConfig(
    grounding="street",
    street=StreetConfig(residual=ResidualConfig(kind="timed", members=2, history=1)),
    **SHAPES,
    fit=FIT,
    timed=TimedConfig(most_s=MOST_S),
)


def world(seed: int) -> TransitionLog:
    """A fitted world in which commands act at once."""
    logs = [ByHand(0).collect(None, iteration, seed) for iteration in (1, 2)]
    return TransitionLog.concatenate(logs)


def planted(late: int, seed: int = 0) -> tuple[Residual, ResidualReport]:
    """A residual of a street that obeys `late` decisions later than the fitted world."""
    residual = PHASE.residual(LAYOUTS, seed)
    assert residual is not None
    street = ByHand(late).collect(None, 0, seed)
    return residual, residual.fit(street, world(seed + 50), Fitter(PHASE.fit, seed))


def test_a_left_out_lateness_is_seen_and_changes_actions() -> None:
    residual, report = planted(late=1)
    assert report.trust.better.tolist() == [True]
    assert report.acting == ("a_0",) and residual.acts
    assert "at 1 of 1 intersections; trusted at 1 (a_0)" in report.describe()
    now = torch.tensor([[[STARTS] * LANES + [1.0, 0.0, 0.0]]])
    for under_way in range(PHASES):
        moment = Moment(now, torch.tensor([[0]]), torch.tensor([[under_way]]))
        grounded = residual.transform(now, np.array([2 - under_way]), None, [moment] * 3)
        # The street runs the phase under way, whatever is asked for; the world has to run it now.
        assert grounded.executed.tolist() == [under_way]


@pytest.fixture(scope="module")
def same_world() -> tuple[Residual, ResidualReport]:
    """A residual of a street that the fitted world explains."""
    return planted(late=0)


@pytest.mark.slow
def test_the_same_world_is_left_alone(same_world: tuple[Residual, ResidualReport]) -> None:
    residual, report = same_world
    assert report.trust.better.tolist() == [False]
    assert not residual.acts
    assert "no action is grounded" in report.describe()
    env = object()
    assert residual.around(env) is env  # type: ignore[arg-type]


def test_f_learns_from_earlier_policies_but_is_compared_on_the_latest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where another policy leads, f is better than its twin even if the worlds are the same."""
    residual = replace(PHASE, fit=replace(PHASE.fit, epochs=2)).residual(LAYOUTS, 0)
    assert residual is not None
    earlier, latest = (ByHand(0).collect(None, iteration, 0) for iteration in (0, 1))
    learnt: list[int] = []
    compared: list[TransitionLog] = []
    fit = residual.transform.fit

    def counting(real: TransitionLog, *others: Any, **options: Any) -> Any:
        learnt.append(len(real))
        return fit(real, *others, **options)

    def none(transform: Any, real: TransitionLog, *_others: Any) -> Trust:
        compared.append(real)
        return Trust.nowhere(transform.stack.agents)

    monkeypatch.setattr(residual.transform, "fit", counting)
    monkeypatch.setattr("ugat_marl.grounding.residual.compare", none)
    residual.fit(latest, world(50), Fitter(FitConfig(epochs=2), 0), earlier=[earlier])
    assert learnt == [len(earlier) + len(latest)]
    assert compared == [latest]


@pytest.mark.parametrize("better", [[True, True], [False, True]])
def test_actions_are_grounded_where_f_is_better_and_h_is_proven(
    better: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = replace(TIMED, gate=GateConfig(start="fitted"), least_accuracy=0.1)
    residual = config.residual(QUEUES, 0)
    assert residual is not None
    fitted = SimpleNamespace(
        trusted=lambda least: np.array([True, False]) & (least == 0.1),
        expected_u=np.array([0.3, 0.2]),
    )
    trust = replace(Trust.nowhere(tuple(QUEUES)), better=np.array(better))
    monkeypatch.setattr(residual.transform, "fit", lambda *_, **__: fitted)
    monkeypatch.setattr("ugat_marl.grounding.residual.compare", lambda *_: trust)
    log = queues({"a_0": 0.0, "b_0": 0.0}, seed=3, episodes=1)
    report = residual.fit(log, log, Fitter(FIT, 0))
    first, _ = tuple(QUEUES)
    assert report.acting == ((first,) if better[0] else ())
    assert residual.transform.gate.alpha.tolist() == [0.3, 0.2]


@pytest.fixture(scope="module")
def late_greens() -> tuple[Residual, ResidualReport]:
    """A street whose first intersection has late greens that no part of the world has."""
    residual = TIMED.residual(QUEUES, 0)
    assert residual is not None
    street = queues({"a_0": 2.0, "b_0": 0.0}, seed=2)
    plain = queues({"a_0": 0.0, "b_0": 0.0}, seed=3, episodes=8)
    delayed = queues(MOST_S, seed=1, episodes=8)
    return residual, residual.fit(street, plain, Fitter(TIMED.fit, 0), delayed)


def test_late_greens_are_seen_where_they_are(
    late_greens: tuple[Residual, ResidualReport],
) -> None:
    residual, report = late_greens
    assert report.trust.better.tolist() == [True, False]
    assert report.trust.error[0] < 0.7 * report.trust.world_error[0]
    delays_s = residual.transform.models["constants"].delay_s  # without h, too
    assert isinstance(delays_s, torch.Tensor)
    assert delays_s[0].mean() == pytest.approx(2.0, abs=0.4)
    assert not delays_s[1].any()


def test_a_residual_at_rest_leaves_every_green_alone(
    late_greens: tuple[Residual, ResidualReport], tmp_path: Path
) -> None:
    residual, _ = late_greens
    residual.save(tmp_path / "residual.pt")
    other = TIMED.residual(QUEUES, 1)
    assert other is not None
    other.load(tmp_path / "residual.pt")
    assert other.transform.gate.trusted.tolist() == residual.transform.gate.trusted.tolist()
    other.rest()
    stack = other.transform.stack
    now = stack.observations({a: np.ones(v.size, np.float32) for a, v in QUEUES.items()})
    for asked in ([0, 0], [1, 1], [2, 0]):
        grounded = other.transform(now, np.array(asked))
        assert not grounded.delay_s.any() and grounded.executed.tolist() == asked


def test_constant_delays_act_where_no_h_is_trusted(
    late_greens: tuple[Residual, ResidualReport], tmp_path: Path
) -> None:
    residual, report = late_greens
    assert report.acting == ("a_0",)
    residual.save(tmp_path / "residual.pt")
    other = TIMED.residual(QUEUES, 1)
    assert other is not None
    other.load(tmp_path / "residual.pt")
    other.transform.gate.trust(np.zeros(2, bool))
    assert other.transform.acting.tolist() == [True, False] and other.acts
    other.rest()
    assert not other.transform.acting.any() and not other.acts


def test_too_few_decisions_prove_nothing() -> None:
    residual = PHASE.residual(LAYOUTS, 0)
    assert residual is not None
    log = ByHand(1).collect(None, 0, 0)
    few = TransitionLog(log.provenance, log.frame.filter(log.frame["step"] < 40))
    trust = compare(residual.transform, few, log, Fitter(PHASE.fit, 0), TrustConfig())
    assert not trust.better.any() and np.isnan(trust.world_error).all()


def test_f_and_its_rival_learn_from_as_many_decisions(monkeypatch: pytest.MonkeyPatch) -> None:
    """240 decisions of the street, and 300 that the world has beside those of the common start."""
    numbers_of_rows: list[list[float]] = []

    def counted(self: Fitter, model: Any, training_data: Any, rows: Any) -> None:
        numbers_of_rows.append((rows.train + rows.held_out).sum(1).tolist())
        model.fitted.fill_(True)

    monkeypatch.setattr(Fitter, "fit_changes", counted)
    residual = PHASE.residual(LAYOUTS, 0)
    assert residual is not None
    log = ByHand(1).collect(None, 0, 0)
    few = TransitionLog(log.provenance, log.frame.filter(log.frame["step"] < 60))
    compare(residual.transform, few, log, Fitter(PHASE.fit, 0), TrustConfig())
    _, *fits = numbers_of_rows
    assert fits[0::2] == fits[1::2]


def test_p_values_take_groups_for_independent_not_their_rows() -> None:
    generator = np.random.default_rng(0)
    group = np.repeat(np.arange(8), 30)
    shared = np.repeat(generator.normal(0.3, 1.0, 8), 30)
    eight = shared[::30]
    spread = eight.std(ddof=1) / np.sqrt(8)
    assert p_of_mean(shared, group) == pytest.approx(float(stats.t.sf(eight.mean() / spread, 7)))
    assert p_of_mean(np.zeros(240), group) == 1.0
    assert p_of_mean(np.ones(240), group) == 0.0
    assert p_of_mean(np.ones(240), np.zeros(240, dtype=np.int64)) == 1.0, "one group proves nothing"


def test_f_is_trusted_by_chance_no_more_often_than_the_level_says() -> None:
    """Errors of f and its rival are drawn alike; the margin makes it rarer still."""
    generator = np.random.default_rng(1)
    group = np.repeat(np.arange(20), 30)
    p = [p_of_mean(generator.normal(0, 1, 600), group) for _ in range(400)]
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=0.03)


def comparison(own: NDArray[np.float64], twin: NDArray[np.float64], **settings: float) -> Trust:
    """The comparison of errors ``(agents, 240)`` of f and the fitted world: 8 blocks, 5 folds."""
    agents = tuple("abcdefgh"[: len(own)])
    rows = torch.arange(240).expand(len(own), 240)
    street: Any = SimpleNamespace(weight=torch.ones(len(own), 240), block=rows // 30)
    found = torch.tensor(np.stack([own, twin]))
    return _tested(agents, found, street, rows // 48, TrustConfig(**settings))


def test_f_has_to_be_better_by_the_margin() -> None:
    twin = 1.0 + 0.01 * np.random.default_rng(0).standard_normal((1, 240))
    assert not comparison(0.97 * twin, twin, margin=0.05).better.any()
    assert comparison(0.90 * twin, twin, margin=0.05).better.all()


def test_of_blocks_and_folds_the_more_careful_test_counts() -> None:
    """Blocks of a fold are alike here: the test by blocks takes them for more than they are."""
    twin, fold = np.ones((1, 240)), np.arange(240) // 48
    own = 0.95 * twin - np.array([0.5, 0.4, -0.3, 0.6, -0.2])[fold]
    surplus = (0.95 * twin - own)[0]
    by_blocks, by_folds = p_of_mean(surplus, np.arange(240) // 30), p_of_mean(surplus, fold)
    assert by_blocks < 0.9 * by_folds
    assert comparison(own, twin, margin=0.05).p[0] == pytest.approx(by_folds, rel=1e-5)


def test_the_level_is_shared_by_the_intersections() -> None:
    own = 0.93 + 0.06 * np.repeat([[1.0, -1.0] * 4], 30, axis=1)
    twin = np.ones_like(own)
    level = 1.5 * float(comparison(own, twin).p[0])
    assert 0.0 < level < 0.5
    assert comparison(own, twin, level=level).better.all()
    both = comparison(np.repeat(own, 2, axis=0), np.repeat(twin, 2, axis=0), level=level)
    assert not both.better.any()


# --- u of h after f


def test_equal_predictions_keep_the_u_of_h() -> None:
    probability, total = torch.tensor([0.7, 0.2, 0.1]), torch.tensor(30.0)
    mean, after = mixed_concentration(probability.expand(4, 3), total.expand(4))
    assert torch.allclose(mean, probability) and after == pytest.approx(30.0, rel=1e-5)


def test_contradicting_predictions_leave_no_evidence() -> None:
    certain = torch.eye(2)
    _, total = mixed_concentration(certain, torch.tensor([1e6, 1e6]))
    assert total == pytest.approx(0.0, abs=1e-5)


def test_u_is_high_where_two_f_disagree_though_h_is_sure(
    same_world: tuple[Residual, ResidualReport],
) -> None:
    """h is certain of every prediction of f alone; the two networks of f name two outcomes."""
    transform = copy.deepcopy(same_world[0].transform)
    now = torch.tensor([[[STARTS] * LANES + [1.0, 0.0, 0.0]]])
    asked, moments = np.array([1]), []
    sure = transform(now, asked, None, moments)
    assert sure.u[0] < 0.4
    with torch.no_grad():  # the second network of f now predicts what another phase would do
        last = list(transform.forward.network.parameters())[-1]
        scale = transform.forward.scale.flatten()
        change = torch.tensor([-0.2, 0.3, 0.0, 1.0, -1.0, 0.0]) / scale
        last[1, 0] += change
    torn = transform(now, asked, None, moments)
    assert torn.u[0] > 2 * sure.u[0] and torn.u[0] > 0.7
    alone = replace(PHASE, gate=GateConfig(uncertainty_of="h"))
    assert alone.residual(LAYOUTS, 0).transform.draws == 1  # type: ignore[union-attr]
    assert transform.draws == 2


# --- with SUMO


def test_without_a_residual_there_is_none() -> None:
    assert UgatConfig(grounding="street").residual(LAYOUTS, 0) is None
    assert replace(PHASE, grounding="phase").residual(LAYOUTS, 0) is None
    with pytest.raises(UnknownNameError, match="phse"):
        ResidualConfig(kind="phse")  # type: ignore[arg-type]
    for name in ("worlds", "members", "history"):
        with pytest.raises(OptionError, match=f"residual {name} = 0: must be at least"):
            ResidualConfig(**{name: 0})  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="folds"):
        TrustConfig(folds=1)


def test_only_a_grounded_phase_needs_a_history() -> None:
    """With one, a lost time was found between the simulation and itself."""
    other = replace(TIMED, street=StreetConfig(residual=ResidualConfig(kind="timed")))
    for config, history in ((PHASE, 4), (other, 1)):
        residual = config.residual(LAYOUTS, 0)
        assert residual is not None
        assert residual.transform.inputs.history == history
        assert residual.transform.forward.config.include_phase == (history > 1)


def test_an_environment_is_grounded_only_where_f_is_trusted() -> None:
    env = parallel_env(SCENARIO, duration_s=100.0)
    residual = PHASE.residual(env.recorded_layouts, 0)
    assert residual is not None
    residual.transform.forward.fitted.fill_(True)
    residual.transform.inverse.fitted.fill_(True)
    try:
        assert isinstance(residual.around(env), GroundedEnv)
        residual.rest()
        assert residual.around(env) is env
    finally:
        env.close()


def trusted_everywhere(*args: Any) -> Trust:
    trust = compare(*args)
    return replace(trust, better=np.ones_like(trust.better))


@pytest.mark.slow
def test_where_commands_are_late_no_action_is_grounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play_nothing(monkeypatch)
    residual = ResidualConfig(kind="phase")
    street = replace(QUICK, parts=("channel",), residual=residual)
    ugat = replace(FITTED, street=street, iterations=1, fit=SMALL.ugat.fit, least_accuracy=None)
    config = replace(SMALL, real=LATE, duration_s=600, ugat=ugat)
    transfer(config, tmp_path, workers=1)
    logged = numbers(tmp_path)
    assert logged[1, "street/commands"] >= 2
    assert logged[1, "residual/acting"] == 0.0
    assert (1, "residual/gate/decisions") not in logged


@pytest.mark.slow
def test_an_interrupted_training_ends_as_an_unbroken_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play_nothing(monkeypatch)
    monkeypatch.setattr("ugat_marl.grounding.trust.BLOCK", 3)
    residual = ResidualConfig(kind="timed", worlds=4, members=2, trust=TrustConfig(folds=2))
    street = replace(QUICK, parts=("eyes",), residual=residual)
    fit = replace(SMALL.ugat.fit, epochs=3)
    ugat = replace(FITTED, street=street, iterations=2, fit=fit, least_accuracy=None)
    config = replace(SMALL, real="V4", ugat=ugat)
    monkeypatch.setattr("ugat_marl.grounding.residual.compare", trusted_everywhere)
    transfer(config, tmp_path / "whole", workers=1)
    for task in ("fitting the residual, iteration 1", "fitted street, iteration 2"):
        with pytest.raises(KeyboardInterrupt):
            transfer(config, tmp_path / "broken", resume=True, reporter=KillAt(task), workers=1)
    assert list((tmp_path / "broken").glob(f"**/{RESIDUAL}"))
    transfer(config, tmp_path / "broken", resume=True, workers=1)
    for name in ("direct-transfer", "fitted-street"):
        one, other = (weights(tmp_path / run, name) for run in ("whole", "broken"))
        assert np.array_equal(one, other), name
    logged = numbers(tmp_path / "whole")
    assert logged == numbers(tmp_path / "broken")
    assert logged[2, "residual/acting"] == 1.0
    assert logged[2, "residual/gate/decisions"] > 0
