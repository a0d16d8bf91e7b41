"""Numbers of the method: every threshold, count of days and tolerance of a diagnosis, in one place.

None of them belongs to a scenario or to data. "By hand" means: chosen by judgement, with planted
effects and empty cases in view; no formula gives it. The remarks on half the value follow from the
method; they were not measured.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """Numbers of simulated days.

    Half of any of them costs half the time; errors of what is estimated from the days grow by 1.4.

    Attributes:
        base: Days of the scenario as it is.
        bank: Days for each strength of each hypothesis.
        fit: Days for each model that is fitted.
        test: Days for the test of what is left.
    """

    base: int = 60
    bank: int = 3
    fit: int = 6
    test: int = 36


EFFORTS = ((4, Effort()), (8, Effort(40, 3, 5, 32)))
"""Efforts for at most so many intersections. With more of them every day says more, since effects
on the whole network are seen at each, and costs more: fewer are simulated."""
LEAST_EFFORT = Effort(24, 2, 3, 16)
"""Effort for larger networks."""


@dataclass(frozen=True)
class Thresholds:
    """Numbers of the method, by stage."""

    # --- features: what is counted ------------------------------------------------------------

    bin_s: float = 300.0
    """Length of a bin in which vehicles are counted, s. By hand: a surge of a quarter of an hour
    fills three. Halved: windows are seen more sharply, counts are noisier."""
    queue_break_s: float = 5.0
    """Gap that ends the discharge of a queue, s. By hand. Halved: slow drivers break the queue, and
    only quick discharge is seen."""
    first_gap_s: float = 12.0
    """Latest crossing of the first queued vehicle after green begins, s. By hand. Halved: greens
    with a long lost time are not counted as greens with a queue."""
    moving_mps: float = 6.0
    """Speed from which a vehicle belongs to a moving platoon, m/s. By hand. Halved: vehicles that
    creep in a queue count as platoons."""
    after_red_s: float = 7.0
    """Time after red begins in which crossings are counted, s. By hand. Halved: late red-runners
    are missed."""
    whole: float = 0.99
    """Share of a bin, or of a period, that must have been counted. By hand: all but rounding.
    Halved: half-empty bins pass for full ones."""

    # --- replay: simulated days ---------------------------------------------------------------

    warm_up_s: float = 600.0
    """Time simulated before a period that does not begin with the scenario, s. By hand: a few
    cycles. Halved: long trips have not reached the lights when counting begins."""
    held_up: float = 0.55
    """Share of the speed limit below which a vehicle at the advance detector comes out of a queue.
    By hand. Halved: arrivals are late by their time in the queue."""
    free: float = 0.85
    """Share of the limit above which it does not; between the two it does if it follows closely one
    that does. By hand. Halved: it has no effect below `held_up`."""
    close_s: float = 3.5
    """Gap up to which a vehicle follows closely, s. By hand. Halved: the tail of a queue counts as
    free."""
    length_m: float = 5.0
    """Length of a vehicle whose speed has to be told from its time on the detector, m: a car of
    SUMO. Halved: such vehicles seem half as fast."""
    missed_window_s: float = 600.0
    """Window in which vehicles that advance detectors missed are spread, s. By hand. Halved:
    sharper in time, noisier."""
    missing: float = 10.0
    """Vehicles that the stop detectors must have seen beyond the advance ones for the latter to
    have missed them. By hand. Halved: chance passes for missed vehicles."""
    missing_share: float = 0.1
    """The same as a share of the vehicles seen. By hand. Halved: as `missing`."""
    fastest: float = 1.3
    """Multiple of the limit at which nobody drives from one detector to the next. By hand. Halved:
    vehicles are matched to others that came before them."""

    # --- engine: ordinary days ----------------------------------------------------------------

    locked_up: float = 5.0
    """Robust standard deviations by which the counts of a day are those of no ordinary day. By
    hand. Halved: one ordinary day in a hundred is left out, and noise is underestimated."""
    rare: float = 0.1
    """Share of days up to which such days are no part of a model. By hand: five measured days
    rather have none. Halved: a model that locks up now and then keeps these days, and its noise
    with them."""

    # --- statistics: noise --------------------------------------------------------------------

    least_observations: float = 3.0
    """Observations per period below which a mean is not used. By hand. Halved: means of one or two
    vehicles are compared, with variances from as few."""
    grain: float = 0.3
    """Share of a unit in one observation to which a mean is known at best. By hand: SUMO moves in
    steps. Halved: statistics that hardly vary weigh up to four times as much."""
    least_events: float = 1.0
    """Events in a period to which what hardly ever happens is known at best: counts are whole.
    Halved: a single event that no simulated day had is four times as unusual."""
    certain: float = 6.0
    """Squared standardised difference beyond which one is not chance (2.4 deviations). By hand.
    Halved: twice as many differences of chance enter derivatives."""
    soft_lane: float = 5.0
    """Deviations beyond which differences of single lanes count less: queues reach a place or they
    do not. By hand. Halved: local effects are seen later, heavy tails matter less."""
    soft_time: float = 4.0
    """The same for counts in bins of time. By hand. Halved: as `soft_lane`."""
    few_days: float = 6.0
    """Days at which the variance of a model and that of the scenario as it is have equal weight. By
    hand. Halved: models of six days have noisier variances."""
    doubt_days: int = 24
    """Days simulated with other vehicles than those the signals answered. By hand. Halved:
    `left_open` is known 1.4 times less well."""
    left_open: float = 0.6
    """Share of what other arrivals change by which a statistic may still be off with the measured
    ones. Set on empty cases of two seeds that no blind test uses. Halved: too many of them are
    contradicted."""

    # --- locate and propose -------------------------------------------------------------------

    dwell_s: float = 40.0
    """Time for which a parked vehicle stands in a hypothesis, s. By hand. Halved: the rate that is
    fitted doubles."""
    most_lanes: int = 24
    """Incoming lanes up to which parking is tried on each. By hand, for time. Halved: on larger
    crossings only suspicious lanes are tried."""
    shifts_s: tuple[float, ...] = (-900.0, -600.0, -300.0, -150.0, 150.0, 300.0, 600.0, 900.0)
    """Shifts of demand in time that are tried, s. By hand. Halved: shifts of ten minutes and more
    are fitted from too near."""
    suspect_timing: float = 16.0
    """Squared standardised size from which demand may come sooner or later (4 deviations over eight
    shifts). By hand. Halved: more simulations, the same answer."""
    mostly: float = 0.7
    """Share of the vehicles on an edge from which its counts are those of one origin. By hand.
    Halved: origins are mixed up."""
    alone: float = 0.1
    """Share of the noise of a count that it has to itself: vehicles still under way, detectors'
    own. By hand. Halved: two edges of one stream count almost as one."""
    suspect_change: float = 9.0
    """Squared standardised change from which an origin or a turn is examined (3 deviations). By
    hand. Halved: more simulations, the same answer."""
    places_of_a_kind: int = 2
    """Origins and turns that are proposed at a time. By hand, for time. Halved: of two surges at
    once one waits for the next round."""
    scan_s: float = 60.0
    """Step of the scan for windows, s. By hand; the fit goes on to half of it. Halved: slower, as
    exact."""
    shortest_stretch_s: float = 240.0
    """Shortest window that is proposed, s. By hand: two cycles. Halved: platoons of one cycle are
    proposed as surges."""
    longest_stretch: float = 0.7
    """Longest window, as a share of the period; beyond it the rest tells no level. By hand. Halved:
    effects on most of a period are proposed for part of it."""
    unusual_stretch: float = 4.0
    """Deviations from which a window is proposed; it is the largest of thousands. By hand. Halved:
    windows of chance are simulated."""
    silent: float = 15.0
    """Vehicles that must be missing before silence of a detector is a fault. By hand. Halved: quiet
    lanes are proposed, and rejected by simulation."""
    stuck_s: float = 240.0
    """Time on at one stretch from which a detector may be stuck, s. By hand: longer than a red.
    Halved: long reds are proposed."""
    farthest: float = 1.6
    """Multiple of its simulated strength to which a ray is followed. By hand. Halved: it cannot
    even reach the simulated strength."""
    least_strength: float = 0.08
    """Multiple of the simulated strength below which an effect does not help. By hand. Halved: weak
    passengers join strong effects more often."""
    candidates: tuple[int, int, int] = (3, 2, 2)
    """Sets of one, two and three effects that are simulated in a round, at most. By hand, for time.
    Halved: the right set is missed where several look alike."""
    foresight: float = 0.05
    """Share of a difference that a straight ray is not expected to meet. By hand. Halved: rays are
    trusted where effects bend."""

    # --- fit ----------------------------------------------------------------------------------

    price: float = 14.0
    """Distance that an effect must take off to be worth naming. By hand; a statistic of one degree
    of freedom passes it by chance in 2 of 10 000 cases. Halved: small false effects join true
    ones."""
    interpolation: float = 0.02
    """Share of a measured difference that a model is forgiven while it is fitted: simulation steps
    round what the street does not. By hand. Halved: large differences pull values off."""
    nearby: float = 0.2
    """Share of its distance from nominal by which a value is moved for a derivative. By hand.
    Halved: derivatives hold more chance."""
    far: float = 0.9
    """The largest such share, where less does nothing that is more than chance. By hand. Halved:
    weak effects have no derivative."""
    plain_move: float = 10.0
    """Deviations that such a move is meant to make. By hand. Halved: derivatives are known to a
    fifth and not to a tenth."""
    ridge: float = 1e-3
    """Ridge of a Gauss-Newton step relative to its normal equations. By hand: only against singular
    ones. Halved: the same."""
    least_gain: float = 1.0
    """Cost that a step must gain for another to follow. By hand: less is noise of the simulated
    days. Halved: more steps, hardly another value."""
    settling_days: int = 16
    """Days of the last step of a fit. By hand. Halved: values of few days are named."""
    settled_within: float = 0.2
    """Standard errors by which a value may be off without a last step. By hand. Halved: more last
    steps."""
    window_steps_s: tuple[float, ...] = (120.0, 60.0, 30.0)
    """Steps by which the ends of a window are moved, s. By hand. Halved: windows are known to a
    quarter of a minute and stop in the wrong place more often."""
    window_days: int = 4
    """Days behind each such move. By hand, for time. Halved: chance moves windows."""
    shortest_window_s: float = 60.0
    """Shortest window that is left by such moves, s. By hand. Halved: the same in practice."""
    half_interval: float = 1.96
    """Half of a 95 % interval, in standard errors: the normal quantile of 0.975."""
    straightness_moves: tuple[float, ...] = (-5.0, -2.0, 2.0, 5.0)
    """Standard errors by which values are moved to see how straight the way is. By hand. Halved:
    steps of whole vehicles are not seen."""
    blunt: float = 0.2
    """Share of such a move that statistics must follow, or a value is not known better than to it.
    By hand. Halved: intervals of values that do nothing are too short."""

    # --- test of what is left -----------------------------------------------------------------

    null_draws: int = 40
    """Data sets drawn from each half of a model's days. By hand. Halved: the distribution of chance
    is known 1.4 times less well."""
    floor_deviations: float = 2.326
    """Deviations of the logarithm to the noise floor: the normal quantile of 0.99, to three digits.
    Halved: 12 of 100 data sets of the model itself lie above the floor."""
    one_day: float = 0.25
    """Chance above which data without some day are nothing unusual. By hand: a difference must not
    hang on one day. Halved: single odd days excuse more models."""
    least_apart: float = 0.3
    """Share of a direction that a fit must have left for it to be tested. By hand. Halved:
    directions that are nearly used up are tested, on what is mostly chance."""

    # --- select -------------------------------------------------------------------------------

    rounds: int = 4
    """Rounds of the search, and effects found at most. By hand. Halved: more than two effects are
    found only where they are proposed together."""
    candidates_fitted: int = 3
    """Candidates of a round that are fitted. By hand, for time. Halved: the right one is missed
    where the first steps mislead."""
    kinds_of_places: int = 5
    """Kinds of effects at places of which the best is simulated. By hand, for time. Halved: rarer
    kinds wait for another round."""
    nearest: int = 3
    """Simulated strengths that are tried as they are. By hand. Halved: effects that come in steps
    are missed where rays mislead."""
    nearer: float = 0.8
    """Share of the gap that such a strength may leave. By hand. Halved: only strong ones are
    tried."""
    tolerance: float = 0.02
    """Share of the first difference in a statistic that a model may leave: parameters are known,
    and steps resolved, no better. By hand. Halved: strong effects are explained in part only."""
    look_elsewhere: float = 0.25
    """Share of the gap from which effects on the whole network leave so much that places are looked
    at. By hand. Halved: more simulations."""
    little: float = 2.0
    """Distance per statistic of the network below which nothing is to be seen in the pool. By hand.
    Halved: places are looked at less often."""
    hopeful: float = 0.9
    """Share of the best candidate's gain that another must promise to be fitted. By hand. Halved:
    more of them are fitted."""
    huge: float = 20.0
    """Distance per statistic beyond which several effects at once are likely from the start. By
    hand. Halved: the paper's settings are tried more often."""
    plain: float = 100.0
    """Factor by which a difference must be rarer than the level of the tests that its size does not
    show. By hand. Halved: more models that cost more are tested."""
    negligible: float = 150.0
    """Cost up to which a smaller set of effects is tested in the place of a larger one. By hand:
    the test decides, this only saves time. Halved: superfluous effects stay more often."""

    # --- verdict ------------------------------------------------------------------------------

    indistinct: float = 25.0
    """Costs that differ by less fit equally well: a likelihood ratio of e^12 would be needed to
    drop one. By hand. Halved: rivals are named less often."""
    rivals_tested: int = 2
    """Rivals that are tested. By hand, for time. Halved: a third explanation is less often
    named."""
    fit_level: float = 0.01
    """Chance on the fitted periods below which a model is contradicted; the held-out ones decide.
    By hand. Halved: hardly another verdict."""
    part: float = 0.5
    """Share of the gap from which a model explains part of it. By hand: the larger half. Halved:
    names are given that explain a quarter."""
    confirmed: float = 10.0
    """Distance that effects must take off the held-out periods. By hand, below `price`. Halved:
    chance confirms more often."""

    # --- signal log and courtesy --------------------------------------------------------------

    least_clearances: int = 20
    """Clearances that must have been seen to read a time off the log. By hand. Halved: short logs
    are trusted."""
    usual_share: float = 0.8
    """Share of them that must agree. By hand. Halved: a light with two times has one read off."""
    least_days: int = 3
    """Days for FHWA's criteria; fewer have no variation to speak of (FHWA-HOP-18-036)."""
    interval_s: float = 900.0
    """Interval of FHWA's criteria, s (FHWA-HOP-18-036, chapter 5). Halved: noisier counts fail
    them."""


THRESHOLDS = Thresholds()
"""The numbers that all stages use."""
