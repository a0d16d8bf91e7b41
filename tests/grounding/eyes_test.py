"""Faults of detectors that were planted in counts of a queue written by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.errors import OptionError
from ugat_marl.grounding.eyes import (
    Eyes,
    EyesConfig,
    _dead,
    _fall_in_green,
    _lost,
    _noise,
    _since_green,
    _zone,
    fit_eyes,
)
from ugat_marl.grounding.summaries import LaneRows, LaneView

LANES = 4
PHASES = 2
LAYOUTS = {"a_0": AgentLayout(LANES, PHASES)}
GREEN = np.array([[True, False], [True, False], [False, True], [False, True]])
FULL = np.full(LANES, 40.0)
VIEW = LaneView(
    tuple(f"lane_{k}" for k in range(LANES)), (GREEN,), (FULL,), (0,), FULL, FULL, ((),) * LANES
)

Fault = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""Counts of an episode, ``(decisions, lanes)``, as faulty detectors report them."""


def counted(
    decisions: int,
    generator: np.random.Generator,
    starts: tuple[float, ...] = (4.0, 4.0, 4.0),
    rate: float = 1.7,
) -> tuple[np.ndarray, np.ndarray]:
    """Return counts ``(decisions + 1, lanes)`` and the phases that ran in between.

    `starts` is what a lane serves in each decision of its green, `rate` what comes in a decision.
    """
    counts = np.zeros((decisions + 1, LANES))
    phases = (np.arange(decisions) // 3) % PHASES
    for t, phase in enumerate(phases):
        served = np.where(GREEN[:, phase], starts[t % len(starts)], 0.0)
        arrivals = generator.poisson(rate, LANES)
        counts[t + 1] = np.minimum(np.maximum(counts[t] - served, 0.0) + arrivals, 30.0)
    return counts, phases


def log_of(
    fault: Fault | None = None,
    episodes: int = 4,
    seed: int = 0,
    starts: tuple[float, ...] = (4.0, 4.0, 4.0),
    rate: float = 1.7,
) -> TransitionLog:
    generator = np.random.default_rng(seed)
    recorder = TransitionRecorder(Provenance("by hand", "", "street", (), 10.0, "count", LAYOUTS))
    for episode in range(episodes):
        counts, phases = counted(300, generator, starts, rate)
        shown = counts if fault is None else fault(counts, generator)
        before = 0
        for t, phase in enumerate(phases):
            seen = np.array([*shown[t] / 40.0, *np.eye(PHASES)[before]])
            then = np.array([*shown[t + 1] / 40.0, *np.eye(PHASES)[phase]])
            did = {"a_0": int(phase)}
            recorder.record(episode, t, {"a_0": seen}, did, did, {"a_0": 0.0}, {"a_0": then})
            before = phase
    return recorder.log()


PERFECT = log_of(seed=99)


def found(fault: Fault | None) -> Eyes:
    return fit_eyes(log_of(fault), PERFECT, VIEW)


def test_perfect_detectors_have_no_fault() -> None:
    eyes = found(None)
    assert not eyes.changes
    assert "no fault" in eyes.describe()
    assert eyes.parts(0, VIEW.lanes, 10.0) == []


def test_a_dead_lane_is_found_and_no_other() -> None:
    def dead(counts: np.ndarray, _: np.random.Generator) -> np.ndarray:
        return counts * np.array([1.0, 0.0, 1.0, 1.0])

    eyes = found(dead)
    assert eyes.dead[1] > 0.7
    assert np.delete(eyes.dead, 1).max() < 0.2
    parts = eyes.parts(1, VIEW.lanes, 10.0)
    assert [part.name for part in parts] == ["dead lanes"]


def test_a_short_zone_is_found_by_what_is_never_counted() -> None:
    def short(counts: np.ndarray, _: np.random.Generator) -> np.ndarray:
        return np.minimum(counts, 3.0)

    eyes = found(short)
    low_m, high_m = eyes.zone_m
    assert low_m < 3 * 7.5 < high_m < 40.0
    assert eyes.lag == 0


def test_what_is_not_certain_is_drawn_in_every_episode() -> None:
    eyes = replace(found(None), zone_m=(20.0, 60.0))
    one, again, other = (eyes.parts(seed, VIEW.lanes, 10.0) for seed in (1, 1, 2))
    assert one == again != other


def test_a_zone_is_found_where_most_lanes_are_shorter() -> None:
    """Places cut out of a city have one long lane among several of a vehicle's length."""
    lengths = np.array([30.0, 1.0, 1.0, 1.0])

    def city(counts: np.ndarray, _: np.random.Generator) -> np.ndarray:
        return np.minimum(counts, lengths)

    def short(counts: np.ndarray, _: np.random.Generator) -> np.ndarray:
        return np.minimum(counts, np.minimum(lengths, 3.0))

    perfect = log_of(city, episodes=1, seed=99)
    low_m, high_m = fit_eyes(log_of(short, episodes=1), perfect, VIEW).zone_m
    assert low_m < 3 * 7.5 < high_m < 40.0
    assert fit_eyes(log_of(city, episodes=1), perfect, VIEW).zone_m == (0.0, 0.0)


@pytest.mark.parametrize("traffic", [1.0, 0.6])
def test_a_busy_lane_among_quiet_ones_is_no_zone(traffic: float) -> None:
    """The largest counts of all lanes are far below those of the busy one, on the street too."""
    generator = np.random.default_rng(7)
    decisions = 720
    number, none = np.arange(decisions), np.zeros(decisions, np.bool_)

    def lanes(share: float) -> list[LaneRows]:
        quiet = [generator.poisson(share, decisions) for _ in range(199)]
        busy = generator.integers(0, int(12 * share) + 1, decisions)
        return [
            LaneRows(0 * number, number, x.astype(float), *[0.0 * number] * 3, none, none, none)
            for x in (*quiet, busy)
        ]

    assert _zone(lanes(traffic), lanes(1.0), 0.0, EyesConfig()) == (0.0, 0.0)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.5])
def test_a_quiet_street_has_no_zone(share: float) -> None:
    def quiet(counts: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        return generator.binomial(counts.astype(int), share).astype(float)

    eyes = fit_eyes(log_of(quiet, episodes=16), log_of(episodes=16, seed=99), VIEW)
    assert eyes.zone_m == (0.0, 0.0)


@pytest.mark.parametrize("rate", [0.003, 0.02, 0.06])
@pytest.mark.parametrize("usual", [0.02, 1.7])
def test_a_long_quiet_log_has_no_fault(rate: float, usual: float) -> None:
    """At night hardly anybody comes, whatever the simulation's own demand is."""
    eyes = fit_eyes(log_of(episodes=60, rate=rate), log_of(seed=99, rate=usual), VIEW)
    assert not eyes.changes, eyes.describe()


def test_a_dead_lane_is_found_in_quiet_traffic() -> None:
    def dead(counts: np.ndarray, _: np.random.Generator) -> np.ndarray:
        return counts * np.array([1.0, 0.0, 1.0, 1.0])

    eyes = fit_eyes(log_of(dead, rate=0.4), PERFECT, VIEW)
    assert eyes.dead[1] > 0.7
    assert np.delete(eyes.dead, 1).max() < 0.2


def test_noise_is_found_with_its_size() -> None:
    def relative(counts: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        return counts * np.maximum(1 + 0.1 * generator.standard_normal(counts.shape), 0)

    def absolute(counts: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        return np.maximum(counts + 3.0 * generator.standard_normal(counts.shape), 0)

    eyes = found(relative)
    assert eyes.relative == pytest.approx(0.1, abs=0.05)
    assert eyes.absolute <= 1.0
    assert found(absolute).absolute == pytest.approx(3.0, abs=1.0)


@pytest.mark.filterwarnings("error")
def test_a_street_without_red_has_no_noise_to_tell() -> None:
    counts = np.random.default_rng(1).uniform(0.0, 9.0, 40)
    numbers, never = np.arange(40), np.zeros(40, np.bool_)
    green, dark = (
        LaneRows(
            0 * numbers, numbers, counts, counts, counts, 10.0 * numbers * lit,
            np.full(40, lit), never, never,
        )
        for lit in (True, False)
    )  # fmt: skip
    green = replace(green, age_s=np.full(40, 10.0))
    assert _noise([green], [dark], EyesConfig()) == (0.0, 0.0)


def two_episodes(green: Sequence[int], falls: Sequence[float]) -> LaneRows:
    """Return the rows of a lane with long queues; the second episode is as long as the first."""
    count = len(falls)
    episode, step = np.divmod(np.arange(count), count // 2)
    has, never = np.array(green, dtype=bool), np.zeros(count, dtype=bool)
    before = np.full(count, 9.0)
    left, age_s = np.zeros(count), 10.0 * has
    return LaneRows(episode, step, before, before - falls, left, age_s, has, never, never)


def test_no_episode_goes_on_in_the_next_one() -> None:
    """The queue at the end of one is another one than that at the beginning of the next."""
    config = EyesConfig(least_served=1, least_stays=1)
    after_green = two_episodes([1, 1, 0, 0], [4.0, 4.0, 9.0, 0.0])
    assert _fall_in_green([after_green], 1, config) == 4.0
    since = _since_green(two_episodes([0, 1, 0, 0, 0, 1], [0.0] * 6))
    assert since.tolist() == [-1, 0, 1, -1, -1, 0]
    stays_at_the_end = two_episodes([1] * 6, [2.0, 2.0, 0.0, 6.0, 2.0, 2.0])
    assert _lost([stays_at_the_end], config) == 0.0
    within = two_episodes([1] * 6, [2.0, 0.0, 6.0, 2.0, 2.0, 2.0])
    assert _lost([within], config) > 0.0


@pytest.mark.parametrize("lag", [1, 3])
def test_late_counts_are_found_with_their_lag(lag: int) -> None:
    def late(counts: np.ndarray, _: np.random.Generator) -> np.ndarray:
        return np.concatenate([np.zeros((lag, LANES)), counts[:-lag]])

    eyes = found(late)
    assert eyes.lag == lag
    (part,) = eyes.parts(0, VIEW.lanes, 10.0)
    assert str(part) == f"observation_delay={10 * lag}"


def test_queues_that_start_late_are_not_late_counts() -> None:
    """Slow drivers: nobody leaves in the first decision of a green, but none in red either."""
    late_starts = log_of(starts=(0.0, 6.0, 6.0))
    assert fit_eyes(late_starts, PERFECT, VIEW).lag == 0


def test_lost_readings_are_told_from_queues_that_stand() -> None:
    def lost(counts: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        shown = counts.copy()
        for t in range(1, len(shown)):
            gone = generator.random(LANES) < 0.2
            shown[t] = np.where(gone, shown[t - 1], shown[t])
        return shown

    assert found(lost).lost == pytest.approx(0.2, abs=0.1)

    # A lane that shares the road behind it counts halves, which is no noise that would hide this.
    shares = np.array([1.0, 1.0, 1.0, 0.5])
    street = log_of(lambda counts, generator: lost(counts * shares, generator))
    quiet = log_of(lambda counts, _: counts * shares, seed=99, rate=0.05)
    assert fit_eyes(street, quiet, VIEW).lost == pytest.approx(0.2, abs=0.1)


def test_coarse_counts_are_found_by_their_step() -> None:
    def coarse(counts: np.ndarray, _: np.random.Generator) -> np.ndarray:
        return np.round(counts / 5) * 5

    assert found(coarse).step == 5.0


@pytest.mark.parametrize("name", ["least_served", "least_stays"])
def test_nothing_is_estimated_from_no_decisions(name: str) -> None:
    with pytest.raises(OptionError, match=rf"eyes {name} is 0; allowed: >= 1"):
        EyesConfig(**{name: 0})


def test_eyes_survive_their_checkpoint() -> None:
    eyes = Eyes(np.array([0.0, 0.5]), (15.0, 26.0), 1.0, 0.1, 2, 0.3, 5.0)
    again = Eyes.from_state(eyes.state_dict())
    assert again.state_dict() == eyes.state_dict()


def rows_of(counts: np.ndarray, left: float = math.nan) -> LaneRows:
    """Return one episode of a lane in red, which `left` vehicles leave in each decision."""
    step, blank = np.arange(len(counts)), np.zeros(len(counts))
    never, leaving = np.zeros(len(counts), dtype=bool), np.full(len(counts), left)
    return LaneRows(np.zeros_like(step), step, counts, counts, leaving, blank, never, never, never)


@pytest.mark.parametrize(("left", "dead"), [(math.nan, 1.0), (0.1, 1.0), (0.003, 0.0)])
def test_a_lane_that_counts_the_queue_of_others_is_not_dead(left: float, dead: float) -> None:
    """A lane of a metre, that hardly anybody leaves, shows those who wait upstream."""
    busy, silent = np.full(400, 3.0), np.zeros(400)
    config = EyesConfig(pull=0.01)
    assert _dead([rows_of(silent)], [rows_of(busy, left)], config) == pytest.approx(dead, abs=0.05)


@pytest.mark.parametrize("pull", [0.25, 2.0])
def test_a_lane_that_nobody_can_judge_is_dead_as_often_as_the_others(pull: float) -> None:
    config = EyesConfig(pull=pull)
    busy, silent = np.full(400, 3.0), np.zeros(400)
    rows = [rows_of(busy), rows_of(silent), rows_of(silent[:0])]
    dead = _dead(rows, [rows_of(busy), rows_of(busy), rows_of(busy[:0])], config)
    assert dead[2] == pytest.approx(0.5)
