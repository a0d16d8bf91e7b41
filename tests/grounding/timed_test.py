"""Timed grounding on streets made up here, where it is known how late every green begins."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import polars as pl
import pytest
import torch

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.errors import LogError
from ugat_marl.grounding import (
    FitConfig,
    Fitter,
    InverseConfig,
    TimedConfig,
    TimedTransform,
    stack_log,
)
from ugat_marl.grounding.controls import shuffled
from ugat_marl.grounding.delays import LEAST_ROWS, LostTime
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.timed import TimedReport

LAYOUTS = {"a_0": AgentLayout(6, 3), "b_0": AgentLayout(4, 2, 2)}
SHAPES = {
    "forward": ForwardConfig(hidden=(32, 32)),
    "inverse": InverseConfig(hidden=(32, 32), embedding=16),
}
QUICK = FitConfig(epochs=30, learning_rate=3e-3)
BRIEF = FitConfig(epochs=8, learning_rate=3e-3)
MOST_S = 4
CLEARANCE_S, INTERVAL_S, HEADWAY_S = 3, 10, 2.0


def served(queue: np.ndarray, starts_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Who has left of a queue, averaged over the seconds of the interval, and at its end.

    A vehicle crosses every two seconds, give or take; one that has crossed by second t counts in
    11 - t of ten looks.
    """
    places = np.arange(1, 6)
    leaves = starts_s[..., None] + HEADWAY_S * places + rng.normal(0, 0.3, (*queue.shape, 5))
    seconds = np.ceil(leaves)
    counts = (seconds <= INTERVAL_S) & (places <= queue[..., None])
    share = np.where(counts, (INTERVAL_S + 1 - seconds) / INTERVAL_S, 0.0)
    return np.stack([share.sum(-1), counts.sum(-1)])


def street(
    delay_s: Mapping[str, float] | int,
    seed: int,
    episodes: int = 4,
    steps: int = 150,
    crossings: bool = True,
    shares: tuple[float, ...] = (),
) -> TransitionLog:
    """Queues of up to five vehicles per lane; phase k serves the lanes k, k + K, ....

    Args:
        delay_s: Agent to how late each of its greens begins, or the longest of the delays that are
            drawn, and recorded, as a simulation does.
        seed: Of all chance.
        episodes: Episodes.
        steps: Decisions of each, every one in a state of its own.
        crossings: Whether it is measured when vehicles cross.
        shares: How often the first agent asks for each phase; the same for all if empty.
    """
    rng = np.random.default_rng(seed)
    rows = episodes * steps
    before, after, left, asked, held = {}, {}, {}, {}, {}
    for agent, layout in LAYOUTS.items():
        own = shares if shares and agent == "a_0" else (1 / layout.phases,) * layout.phases
        shown, asked[agent] = (rng.choice(layout.phases, rows, p=own) for _ in range(2))
        begins = shown != asked[agent]
        if isinstance(delay_s, int):
            delay = rng.integers(delay_s + 1, size=rows) * (rng.random(rows) < 0.75)
            held[agent] = (delay * begins).astype(float)
        else:
            delay, held[agent] = np.full(rows, delay_s[agent]), np.zeros(rows)
        starts = np.where(begins, CLEARANCE_S + delay, 0.0)
        queue = rng.integers(6, size=(rows, layout.features))
        is_green = np.arange(layout.features) % layout.phases == asked[agent][:, None]
        early, gone = served(queue, np.where(is_green, starts[:, None], np.inf), rng)
        come = rng.integers(2, size=queue.shape)
        context = np.zeros((rows, layout.context))
        lights = np.eye(layout.phases)
        before[agent] = np.hstack([queue / 40, lights[shown], context])
        after[agent] = np.hstack([(queue - gone + come) / 40, lights[asked[agent]], context])
        left[agent] = (queue - early) / 40
    provenance = Provenance("street", "", "sim", (), INTERVAL_S, "count", LAYOUTS)
    recorder = TransitionRecorder(provenance)
    for row in range(rows):
        seen, then, went, did, late = (
            {agent: values[agent][row] for agent in LAYOUTS}
            for values in (before, after, left, asked, held)
        )
        nothing = dict.fromkeys(LAYOUTS, 0.0)
        place = row // steps, row % steps
        recorder.record(*place, seen, did, did, nothing, then, late, went if crossings else None)
    return recorder.log()


SIMULATED = street(MOST_S, seed=1, episodes=8)
PLANTED = {"a_0": 2.0, "b_0": 0.0}


def fitted(
    real: TransitionLog,
    simulated: TransitionLog = SIMULATED,
    config: FitConfig = QUICK,
    seed: int = 0,
) -> tuple[TimedTransform, TimedReport]:
    made = TimedTransform(LAYOUTS, seed, **SHAPES, timed=TimedConfig(most_s=MOST_S))
    return made, made.fit(real, simulated, Fitter(config, seed))


@pytest.fixture(scope="module")
def planted() -> tuple[TimedTransform, TimedReport]:
    """One intersection loses two seconds of every green, the other nothing."""
    return fitted(street(PLANTED, seed=2))


def test_a_planted_delay_is_found_at_each_intersection(planted) -> None:
    made, report = planted
    lost = report.lost
    assert lost.best_s.tolist() == pytest.approx([2.0, 0.0], abs=0.5)
    assert (lost.low_s <= lost.best_s).all() and (lost.best_s <= lost.high_s).all()
    assert (lost.low_s >= 0).all() and (lost.high_s <= MOST_S).all()
    assert lost.low_s[0] > 1.0 and lost.high_s[1] < 1.0  # each knows it is not the other
    for i, layout in enumerate(LAYOUTS.values()):
        own = lost.phase_s[i, : layout.phases].tolist()
        assert own == pytest.approx([lost.best_s[i]] * layout.phases, abs=0.7)
    assert torch.equal(made.constants.delay_s, lost.phase_s)
    assert made.fitted and not report.warnings


def test_only_rows_in_which_a_green_begins_count(planted) -> None:
    _, report = planted
    real = street(PLANTED, seed=2)
    for agent, layout, count in zip(
        LAYOUTS, LAYOUTS.values(), report.lost.switches.tolist(), strict=True
    ):
        rows = real.transitions(agent)
        lights = rows.observation[:, layout.features : layout.features + layout.phases]
        assert count == (lights.argmax(1) != rows.executed).sum()


def test_a_street_like_the_simulation_loses_nothing() -> None:
    transform, report = fitted(street({"a_0": 0.0, "b_0": 0.0}, seed=3))
    assert (report.lost.best_s <= 0.3).all()
    assert (report.lost.low_s == 0.0).all()
    assert not report.lost.shown.any() and not report.trusted().any()
    assert not transform.constants.delay_s.any()  # nor what single phases have by chance


@pytest.mark.parametrize(
    ("low_s", "best_s", "shown"),
    [(0.0, 0.0, False), (0.0, 0.4, False), (0.0, 0.5, True), (0.1, 0.3, True), (0.0, 2.0, True)],
)
def test_what_chance_explains_is_no_lost_time(planted, low_s, best_s, shown) -> None:
    known = planted[1].lost
    lost = dataclasses.replace(known, low_s=np.full(2, low_s), best_s=np.full(2, best_s))
    assert lost.shown.tolist() == [shown, shown]


def test_a_delay_between_whole_seconds_is_found() -> None:
    _, report = fitted(street({"a_0": 1.5, "b_0": 2.5}, seed=4))
    assert report.lost.best_s.tolist() == pytest.approx([1.5, 2.5], abs=0.5)


def test_a_delay_longer_than_any_tried_is_pointed_out() -> None:
    _, report = fitted(street({"a_0": 6.0, "b_0": 0.0}, seed=5))
    assert report.lost.best_s[0] > MOST_S - 0.5
    assert (
        "the best delay is the longest tried (4 s; raise timed most_s) at 1 of 2 (a_0)"
        in report.warnings
    )


def test_a_street_with_too_few_greens_to_tell_is_pointed_out() -> None:
    simulated = street(MOST_S, seed=6, episodes=2, steps=20)
    _, report = fitted(street(PLANTED, seed=5), simulated, BRIEF)
    assert (report.lost.low_s == 0.0).all() and (report.lost.high_s == MOST_S).all()
    assert (
        "too few greens begin to tell how late they are (0 to 4 s would all fit; give more "
        "roll-outs or longer episodes) at 2 of 2 (a_0, b_0)"
    ) in report.warnings


@pytest.mark.parametrize("without", ["real", "simulated"])
def test_logs_of_which_one_lacks_crossings_are_compared_by_what_follows(without: str) -> None:
    """Or a mean over the interval would be compared with what is left at its end."""
    both = {
        "real": {True: street(PLANTED, seed=6), False: street(PLANTED, seed=6, crossings=False)},
        "simulated": {c: street(MOST_S, seed=7, crossings=c) for c in (True, False)},
    }
    mixed = fitted(*(logs[name != without] for name, logs in both.items()), BRIEF)[1]
    neither = fitted(*(logs[False] for logs in both.values()), BRIEF)[1]
    assert mixed.as_dict() == neither.as_dict()
    crossings = fitted(*(logs[True] for logs in both.values()), BRIEF)[1]
    assert crossings.as_dict() != neither.as_dict()


def test_h_reads_the_delay_off_the_changes(planted) -> None:
    h = planted[1].inverse
    assert h.guess_s == pytest.approx(np.mean([2, 1, 0, 1, 2]))
    assert (h.error_s < 0.7 * h.guess_s).all()
    # Of single transitions it reads as much as chance leaves in them.
    assert (h.error_on_transitions_s >= h.error_s - 0.05).all()
    assert np.isfinite(h.error_on_transitions_s).all()
    u = h.calibration
    assert u.mean_u_off_data > u.mean_u + 0.2 and u.auroc_off_data > 0.7
    assert u.auroc > 0.6 and u.risk_by_coverage[0] < u.risk_by_coverage[-1]  # it tells errors
    assert 0.0 <= u.ece < 0.35
    assert planted[1].trusted().tolist() == [True, False]  # the second has nothing to refine
    assert planted[1].trusted(least_accuracy=0.99).tolist() == [False, False]


def test_h_that_reads_nothing_off_the_changes_is_not_trusted() -> None:
    """By luck it is a little nearer to the delays than the middle of the range is."""
    timed = TimedConfig(most_s=MOST_S, target_noise=100.0)
    real = street({"a_0": 2.0, "b_0": 2.0}, seed=2)
    nearer = trusted = 0
    for seed in range(4):
        made = TimedTransform(LAYOUTS, seed, **SHAPES, timed=timed)
        report = made.fit(real, street(MOST_S, seed=20 + seed), Fitter(BRIEF, seed))
        assert report.forward.learnt.all() and report.simulated.learnt.all()
        nearer += int((report.inverse.error_s < report.inverse.guess_s).sum())
        trusted += int(report.trusted().sum())
    assert nearer > 2 and trusted <= 1


def test_h_answers_with_the_delay_of_the_street(planted) -> None:
    """In the mean over the states of a street that h has never seen."""
    made, _ = planted
    data = stack_log(street(PLANTED, seed=8, episodes=1), made.stack)
    switched = made.stack.current_phase(data.observation) != data.executed
    with torch.no_grad():
        found, u = made.delays(data.observation, data.observation, data.executed)
    mean = [float(found[i][switched[i]].mean()) for i in range(2)]
    assert mean == pytest.approx([2.0, 0.0], abs=0.5)
    assert ((u > 0) & (u <= 1)).all()


def test_the_u_to_expect_is_that_of_what_f_predicts_where_greens_begin(planted) -> None:
    made, report = planted
    data = stack_log(street(PLANTED, seed=2), made.stack)
    switched = made.stack.current_phase(data.observation) != data.executed
    with torch.no_grad():
        _, u = made.delays(data.observation, data.observation, data.executed)
    mean = [float(u[i][switched[i]].mean()) for i in range(2)]
    assert report.expected_u == pytest.approx(mean, abs=0.02)
    assert mean[0] != pytest.approx(mean[1], abs=0.01)  # each has its own


def test_the_report_is_flat_numbers(planted) -> None:
    numbers = planted[1].as_dict()
    assert all(isinstance(value, float) for value in numbers.values())
    for name in (
        "forward/error",
        "forward/ratio/b_0",
        "simulated/ratio",
        "simulated/held_out_loss",
        "inverse/error_s",
        "inverse/error_on_transitions_s/a_0",
        "inverse/guess_s",
        "calibration/auroc",
        "calibration/ece",
        "calibration/error_by_quantile/0",
        "calibration/mean_u_off_data",
        "calibration/auroc_off_data",
        "lost_time/best_s",
        "lost_time/best_s/a_0",
        "lost_time/low_s/a_0",
        "lost_time/high_s/b_0",
    ):
        assert math.isfinite(numbers[name]), name
    assert numbers["lost_time/best_s"] == pytest.approx(planted[1].lost.best_s.mean())


def test_a_report_says_what_is_doubtful(planted) -> None:
    report = planted[1]
    useless = dataclasses.replace(report.inverse.calibration, auroc_off_data=0.5)
    poor = dataclasses.replace(
        report,
        forward=dataclasses.replace(report.forward, beats_no_change=np.array([False, True])),
        simulated=dataclasses.replace(report.simulated, beats_no_change=np.array([True, False])),
        inverse=dataclasses.replace(report.inverse, calibration=useless),
    )
    assert poor.warnings == (
        "f is not shown to be better than no change at 1 of 2 (a_0)",
        "the model of the simulation is not shown to be better than no change at 1 of 2 (b_0)",
        "u does not rise off the data (AUROC 0.50)",
    )
    assert poor.trusted().tolist() == [False, False]
    blind = dataclasses.replace(report.inverse, error_s=np.array([1.3, math.nan]))
    assert dataclasses.replace(report, inverse=blind).trusted().tolist() == [False, False]


def test_without_uncertainty_the_report_says_that_all_is_taken() -> None:
    config = dataclasses.replace(BRIEF, uncertainty="none")
    made, report = fitted(street(PLANTED, seed=9), config=config)
    assert made.inverse.method.name == "none" and report.inverse.calibration.mean_u == 0.0
    assert "without uncertainty u is 0, and the gate takes every answer of h" in report.warnings


def test_fitting_twice_gives_the_same_models_and_another_seed_others() -> None:
    real = street(PLANTED, seed=10, episodes=2)
    simulated = street(MOST_S, seed=11, episodes=2)
    states = []
    for seed in (1, 1, 2):
        torch.rand(3)  # global randomness must not matter
        made = TimedTransform(LAYOUTS, 0, **SHAPES, timed=TimedConfig(most_s=MOST_S))
        made.fit(real, simulated, Fitter(BRIEF, seed))
        models = made.models.items()
        states.append({f"{n}.{k}": v for n, m in models for k, v in m.state_dict().items()})
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    weights = [name for name in states[0] if name.endswith("weight")]
    assert not any(torch.equal(states[0][name], states[2][name]) for name in weights)


def test_epochs_are_reported_for_each_of_the_three_models() -> None:
    seen: list[tuple[str, int]] = []
    made = TimedTransform(LAYOUTS, 0, **SHAPES, timed=TimedConfig(most_s=MOST_S))
    real = street(PLANTED, seed=10, episodes=2)
    config = FitConfig(epochs=2)
    made.fit(real, SIMULATED, Fitter(config, 0, lambda name, n, _: seen.append((name, n))))
    assert seen == [(name, n) for name in ("simulated", "forward", "inverse") for n in (1, 2)]


def frozen(log: TransitionLog, agent: str) -> TransitionLog:
    """The log without the rows of an agent in which a green begins."""
    layout = LAYOUTS[agent]
    lights = pl.col("observation").list.slice(layout.features, layout.phases)
    switched = (pl.col("agent") == agent) & (lights.list.arg_max() != pl.col("executed"))
    return TransitionLog(log.provenance, log.frame.filter(~switched))


def test_an_intersection_that_never_changes_its_phase_harms_no_other(planted) -> None:
    """All share the head of h, and a checkpoint with a number that is none cannot be written."""
    made, report = fitted(frozen(street(PLANTED, seed=2), "b_0"), frozen(SIMULATED, "b_0"))
    whole = planted[1]
    for model in made.models.values():
        assert all(torch.isfinite(value).all() for value in model.state_dict().values())
    assert math.isfinite(report.inverse.training.held_out_loss)
    assert report.inverse.error_s[0] == pytest.approx(whole.inverse.error_s[0], abs=0.2)
    assert report.lost.best_s[0] == pytest.approx(whole.lost.best_s[0], abs=0.3)
    # Of that one nothing is known, and nothing is claimed.
    assert report.lost.switches[1] == 0 and not made.constants.delay_s[1].any()
    assert (report.lost.low_s[1], report.lost.high_s[1]) == (0.0, MOST_S)
    assert math.isnan(report.inverse.error_s[1])
    assert report.trusted().tolist() == [True, False]


def test_where_no_green_ever_begins_nothing_is_said_of_u() -> None:
    logs = (frozen(frozen(street(PLANTED, seed=2), "a_0"), "b_0"),
            frozen(frozen(SIMULATED, "a_0"), "b_0"))  # fmt: skip
    _, report = fitted(*logs, config=BRIEF)
    assert math.isnan(report.inverse.calibration.mean_u)
    assert math.isnan(report.inverse.calibration.ece)
    assert report.trusted().tolist() == [False, False]


def test_a_phase_seldom_served_on_the_street_takes_its_intersections_delay() -> None:
    real = street(PLANTED, seed=2, shares=(0.5, 0.5, 0.0))
    _, report = fitted(real, config=BRIEF)
    lost: LostTime = report.lost
    rows = real.transitions("a_0")
    assert (rows.executed == 2).sum() < LEAST_ROWS
    assert lost.phase_s[0, 2] == pytest.approx(lost.best_s[0], abs=0.05)


def test_logs_that_cannot_be_composed_are_refused() -> None:
    real = street(PLANTED, seed=2, episodes=2, steps=5)
    other = dataclasses.replace(real.provenance, decision_interval_s=5.0)
    with pytest.raises(LogError, match="real log has decision_interval_s"):
        fitted(TransitionLog(other, real.frame))
    with pytest.raises(LogError, match="record at least two whole episodes"):
        fitted(street(PLANTED, seed=2, episodes=1, steps=1))


def test_streets_of_which_f_knows_nothing_lose_no_time_that_one_could_know_of(planted) -> None:
    """Shuffled rows have a delay that fits best, too; it means nothing."""
    made, report = fitted(shuffled(street(PLANTED, seed=1), seed=0))
    assert not report.forward.learnt.any()
    assert report.lost.best_s.max() > 0.5
    assert not made.constants.delay_s.any()
    assert planted[1].forward.learnt.all()
    assert planted[0].constants.delay_s.max() > 1.5
