"""Numbers of the method: every threshold, count of days and tolerance of a diagnosis, in one place.

They hold for all scenarios and data. "By hand" means: chosen by judgement, on cases with planted
effects and on cases without any; there is no formula. "Halved" says what half the value would do.
That follows from the method and was not measured.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields

from ugat_marl.errors import require_kinds, require_least


@dataclass(frozen=True)
class Effort:
    """Numbers of simulated days.

    Halved: half the time, and errors of estimates from these days grow by a factor of 1.4.

    Attributes:
        base: Days of the scenario as it is.
        bank: Days for each strength of each hypothesis.
        fit: Days for each model that is fitted.
        test: Days for the test of the remaining difference.
    """

    base: int = 60
    bank: int = 3
    fit: int = 6
    test: int = 36

    def __post_init__(self) -> None:
        require_kinds(self, "effort")
        require_least(4, **{"effort base": self.base, "effort test": self.test})
        require_least(2, **{"effort fit": self.fit})  # errors of estimates are a spread of days
        require_least(1, **{"effort bank": self.bank})


EFFORTS = ((4, Effort()), (8, Effort(40, 3, 5, 32)))
"""Pairs: largest number of intersections, and effort up to there. A day of a larger network costs
more and says more, since each intersection shows effects on the whole network. So fewer days are
simulated."""
LEAST_EFFORT = Effort(24, 2, 3, 16)
"""Effort for larger networks."""
DAYS_OF_A_STRETCH = 6
"""Least number of days of the scenario as it is, and of a test, for each stretch of the day.

A test compares halves of its days, and each stretch has a mean of its own. Halved: with one day of
a stretch in each half no noise can be estimated, and hardly anything is told."""


@dataclass(frozen=True)
class DayThresholds:
    """Numbers that decide the features of a day; a change makes cached days useless."""

    # --- features: what is counted ------------------------------------------------------------

    bin_s: float = 300.0
    """Length of a bin in which vehicles are counted, s. By hand: a surge of a quarter of an hour
    fills three bins. Halved: windows are located more exactly, counts are noisier."""
    queue_break_s: float = 5.0
    """Gap that ends the discharge of a queue, s. By hand. Halved: slow drivers end the queue, and
    only quick discharge is counted."""
    first_gap_s: float = 12.0
    """Latest crossing of the first queued vehicle after green begins, s. By hand. Halved: greens
    with a long lost time are not counted as greens with a queue."""
    moving_mps: float = 6.0
    """Speed from which a vehicle belongs to a moving platoon, m/s. By hand. Halved: vehicles that
    creep in a queue count as platoons."""
    after_red_s: float = 7.0
    """Time after red begins in which crossings are counted, s. By hand. Halved: late red-runners
    are missed."""
    usual_gap_s: float = 2.0
    """Gap of queued vehicles from which the spread of gaps is measured, s: the usual saturation
    headway. Halved: the spread says no more than the mean gap."""
    short_gap_s: float = 1.7
    """Gap below which a gap of queued vehicles is short, s. By hand. Halved: hardly any gap is
    short."""
    long_gap_s: float = 2.6
    """Gap above which a gap of queued vehicles is long, s. By hand. Halved: most gaps are long."""
    late_red_s: float = 2.0
    """Time after red begins in which a crossing is late and not a crossing on red, s. By hand: the
    usual all-red time. Halved: late drivers count as red-runners."""
    last_crossing_s: float = 3.0
    """Time after red begins in which the delay of the last crossings is averaged, s. By hand.
    Halved: delays of late drivers are cut off."""
    measurable_mps: float = 5.0
    """Speed from which the length of a vehicle is computed from its time on the detector, m/s. By
    hand. Halved: vehicles that brake seem too long."""
    long_vehicle_m: float = 8.0
    """Length above which a vehicle is long, m: longer than cars and vans. Halved: all are long."""
    moving_over_s: float = 1.2
    """Time on the detector below which a vehicle without a measured speed moves in a platoon, s. By
    hand. Halved: trucks do not belong to platoons."""
    platoon_gap_s: float = 6.0
    """Largest gap in a moving platoon, s. By hand. Halved: drivers with long headways are not
    seen."""
    short_platoon_gap_s: float = 1.6
    """Gap below which a gap in a platoon is short, s. By hand. Halved: hardly any gap is short."""
    middle_platoon_gap_s: float = 2.2
    """Gap below which a gap in a platoon is short or middle, s. By hand. Halved: as above."""
    free_gap_s: float = 5.0
    """Gap above which a vehicle drives freely, s. By hand. Halved: followers count as free."""
    settled_green_s: float = 5.0
    """Time after green begins from which a vehicle may be free, s. By hand. Halved: vehicles that
    braked for the red count as free."""
    fast_share: float = 1.05
    """Multiple of the speed limit above which a free vehicle is fast. By hand. Halved: all are
    fast."""
    free_over_s: float = 3.0
    """Longest time of a free vehicle on the detector, s. By hand: longer ones stand. Halved: slow
    trucks are left out."""
    before_green_s: float = 3.0
    """Time before green begins in which vehicles no longer approach a red, s. By hand: they see
    that it ends. Halved: some of them count."""
    lone_gap_s: float = 4.0
    """Gap above which a vehicle that approaches a red brakes by itself, s. By hand. Halved: it may
    brake for the vehicle ahead."""
    slow_mps: float = 5.0
    """Speed below which a vehicle that approaches a red is slow, m/s. By hand. Halved: few are."""
    red_over_s: float = 4.0
    """Longest time on the detector of a vehicle that approaches a red, s. By hand: longer ones
    stand. Halved: drivers who brake early are left out."""
    cut_occupation_s: float = 30.0
    """Longest occupation from the start of a period by a vehicle whose arrival was not seen, s. By
    hand: longer ones are faults. Halved: queues that stood there already are left out."""
    standing_s: float = 1.9
    """Occupied time within one second of the start of green from which a queue stands on the
    detector, s (of 2 s). By hand. Halved: moving vehicles count as queues."""
    whole: float = 0.99
    """Share of a bin or of a period that must have been counted. By hand: only rounding may be
    missing. Halved: half-empty bins count as full ones."""

    # --- replay: simulated days ---------------------------------------------------------------

    warm_up_s: float = 600.0
    """Simulated time before a period that begins later than the scenario, s. By hand: a few cycles.
    Halved: long trips have not reached the traffic lights when counting begins."""
    fuller: float = 4.0
    """Standard errors by which a street's first bin of time holds more than that of simulated days
    that begin empty. By hand. Halved: one period in forty is noted without need."""
    held_up: float = 0.55
    """Share of the speed limit below which a vehicle at the advance detector counts as queued. By
    hand. Halved: arrivals of queued vehicles are late by their time in the queue."""
    free: float = 0.85
    """Share of the speed limit above which such a vehicle counts as free. Between `held_up` and
    this it counts as queued if it closely follows a queued vehicle. By hand. Halved: no effect,
    since the value is below `held_up`."""
    close_s: float = 3.5
    """Largest gap of a vehicle that follows closely, s. By hand. Halved: the end of a queue counts
    as free."""
    length_m: float = 5.0
    """Assumed length of a vehicle whose speed is computed from its time on the detector, m: a car
    of SUMO. Halved: such vehicles seem up to half as fast."""
    missed_window_s: float = 600.0
    """Window in which vehicles missed by advance detectors are spread evenly, s. By hand. Halved:
    more exact in time, noisier."""
    missing: float = 10.0
    """Vehicles that stop detectors must count more than advance detectors before the difference
    counts as missed. By hand. Halved: chance counts as missed vehicles."""
    missing_share: float = 0.1
    """Share of the vehicles at the advance detectors that is added to `missing`. By hand. Halved:
    as for `missing`."""
    fastest: float = 1.3
    """Multiple of the speed limit that no vehicle exceeds between two detectors. By hand. Halved:
    vehicles are matched to others that arrived before them."""

    # --- journeys: travel times and queues that no fit uses -----------------------------------

    slack_s: float = 8.0
    """Time by which a vehicle that crosses the stop line freely may have been slower than at
    `free` times the speed limit since the advance detector, s. By hand. Halved: vehicles that met
    the end of a queue have no travel time."""

    def of_a_day(self) -> tuple[tuple[str, object], ...]:
        """Return the names and values of these numbers alone, for the key of cached days."""
        return tuple((item.name, getattr(self, item.name)) for item in fields(DayThresholds))


OF_SIGHTINGS = (
    "touching_s", "no_gap_s", "longest_alone_s", "crawling_mps", "least_braking_mps",
    "least_travel_s", "longest_travel_s", "steady_share", "twin_s",
)  # fmt: skip
"""Numbers that decide what is kept of single vehicles, beside those of a day."""


@dataclass(frozen=True)
class Thresholds(DayThresholds):
    """Numbers of the method, in the order of the stages."""

    # --- engine: ordinary days ----------------------------------------------------------------

    locked_up: float = 5.0
    """Distance of a day's count from the median beyond which the day is not ordinary, in robust
    standard deviations. By hand. Halved: one ordinary day in a hundred is left out, and noise is
    underestimated."""
    rare: float = 0.1
    """Largest share of such days that is left out of a model. By hand: five measured days probably
    have none. Halved: a model that locks up now and then keeps these days and their noise."""

    # --- study: variation from day to day -----------------------------------------------------

    usual_variation: float = 0.07
    """Scale of the variation of demand from day to day where there is one, as a share. Streets have
    5 to 10 %. Halved: few days with a strong variation seem less noisy than they are."""
    grain_of_variation: float = 0.02
    """Grain of the estimated variation. By hand: data with equal estimates share simulated days,
    and a variation below 1 % is none. Halved: hardly any days are shared."""

    # --- statistics: noise --------------------------------------------------------------------

    least_observations: float = 3.0
    """Observations per period below which a mean is not used. By hand. Halved: means of one or two
    vehicles are compared, with variances from as few."""
    least_measured: float = 1.0
    """Observations per measured period below which a mean is not compared. Halved: means of a
    vehicle in every second period are compared."""
    least_counted: float = 0.5
    """Share of the measured periods that have to have counted a bin of time. By hand. Halved: bins
    are compared that one period in four has.
    """
    least_count: float = 0.5
    """Vehicles per bin of time below which the bin is not compared. By hand. Halved: bins with a
    vehicle on every fourth day are compared."""
    thinning: tuple[float, float] = (0.25, 4.0)
    """Least and largest factor of a variance for unusual numbers of observations. By hand. Halved:
    means of few observations seem too exact."""
    proportional_share: float = 0.5
    """Weight of a variance in proportion to the mean in the variance of a count in a bin of time;
    the rest is the estimate of that bin. By hand. Halved: these variances are noisier."""
    least_count_variance: float = 0.05
    """Least variance of a count in a bin of time. By hand. Halved: bins that hardly vary weigh up
    to twice as much."""
    steepest_control: float = 1.5
    """Largest slope of a model's days on the same days of the scenario as it is. By hand. Halved:
    common chance is removed only in part."""
    least_own_share: float = 0.1
    """Least variance of a model's mean that common chance leaves, as a share of its variance. By
    hand. Halved: means of few days seem more exact by up to a factor of 1.4."""
    least_shrinkage: float = 0.02
    """Least weight of the identity in a shrunk correlation. By hand: keeps it invertible. Halved:
    no visible change."""
    grain: float = 0.3
    """Least standard deviation of a sum over a period, in units of the feature. By hand: SUMO moves
    in steps. Halved: statistics that hardly vary have up to four times the weight."""
    least_events: float = 1.0
    """Least standard deviation of the number of rare events in a period: counts are whole numbers.
    Halved: a single event that no simulated day had is four times as unusual."""
    certain: float = 6.0
    """Squared standardised difference that is no longer chance (2.4 deviations). By hand. Halved:
    more differences by chance enter derivatives."""
    soft_lane: float = 5.0
    """Standardised difference beyond which differences of single lanes count less: a queue either
    reaches a place or does not. By hand. Halved: local effects are found later, heavy tails matter
    less."""
    soft_time: float = 4.0
    """The same for counts in bins of time. By hand. Halved: as for `soft_lane`."""
    few_days: float = 6.0
    """Number of days with which a model's own variance has the same weight as that of the scenario
    as it is. By hand. Halved: models of six days have noisier variances."""
    doubt_days: int = 24
    """Days simulated with the model's own arrivals, beside the measured ones. By hand. Halved:
    errors of the measured arrivals are known 1.4 times less exactly."""
    arrivals_error_share: float = 0.6
    """Standard deviation of the error by measured arrivals, as a share of the change from the
    model's own arrivals to the measured ones. Set on cases without effects, with two seeds that no
    blind test uses. Halved: too many such cases are contradicted."""

    # --- measurement: the detectors as they are -----------------------------------------------

    free_occupancy: float = 0.15
    """Occupancy up to which an interval is free, so that it tells how long vehicles and zone are
    together. By hand: no queue reaches the detector. Halved: fewer intervals."""
    most_longer_m: float = 3.0
    """Difference of that length from the model beyond which it is put on detectors and not on
    vehicles, m. By hand: with a third of trucks vehicles are 3 m longer. Halved: a sixth of trucks
    is taken for long zones."""
    most_unlike_m: float = 1.5
    """The same for a difference from the other kinds of detectors, m: half of a usual loop. Halved:
    fields that reach beyond the edges of a loop count."""
    measurement_days: int = 8
    """Simulated days with which the reports of single vehicles are compared. By hand: thousands of
    vehicles. Halved: errors of detectors are known 1.4 times less exactly."""
    least_sightings: int = 15
    """Vehicles below which a group of detectors is not judged by itself. By hand. Halved: medians
    of a few vehicles are compared."""
    least_pairs: int = 5
    """The same for vehicles seen at two detectors, with their speeds. By hand: each tells the
    distance to a meter or two. Halved: two vehicles move a detector."""
    touching_s: float = 0.02
    """Time between two passages below which the detector did not go off between them, s: above the
    rounding of logs to 10 ms. Halved: no change for logs in ms."""
    no_gap_s: float = 0.005
    """Time between two passages below which the second began as the first ended, s: half of 10 ms.
    Halved: no change for logs in ms."""
    longest_alone_s: float = 8.0
    """Longest time of a moving vehicle over a zone, s. By hand: long zones and long extensions.
    Halved: extensions of 4 s and more are not seen."""
    crawling_mps: float = 1.5
    """Speed from which a queued vehicle moves over the stop detector without a stop, m/s. By hand.
    Halved: vehicles that stand on the detector count as moving."""
    least_braking_mps: float = 3.0
    """Speed from which a vehicle that brakes for a red still moves over the zone, m/s. By hand.
    Halved: vehicles that come to rest on the detector count."""
    least_travel_s: float = 0.5
    """Least time of a vehicle between advance and stop detector, s. By hand. Halved: no change."""
    longest_travel_s: float = 12.0
    """Longest such time, s. By hand: 100 m at 30 km/h. Halved: advance detectors far upstream are
    not judged."""
    most_astray_m: float = 3.0
    """Distance of detectors on simulated days from the stated one, beyond which pairs are not of
    one vehicle each, m. By hand: it is within 1 m elsewhere. Halved: a tenth of approaches is not
    judged where vehicles are few."""
    steady_share: float = 0.15
    """Change of a speed between the two detectors, as a share of the limit, beyond which a vehicle
    did not drive steadily. By hand. Halved: fewer vehicles, each more exact."""
    twin_s: float = 0.15
    """Difference of two passages on adjacent lanes below which they are twins, s. By hand. Halved:
    detectors with unlike response times do not show splash."""
    inexact: float = 0.01
    """Share by which kinematics of simulated and real vehicles may differ. By hand. Halved: errors
    of detectors by small differences of driving are named."""
    bent: float = 0.3
    """The same for vehicles that accelerate, as a share of their difference from steady ones. By
    hand: drivers may accelerate a third harder or less hard. Halved: slow drivers look like speeds
    measured elsewhere."""
    bent_alone: float = 0.3
    """The same for one kind of passage, compared with the others. By hand: slow drivers are not
    equally slow at every place of a queue. Halved: as above."""
    bent_here: float = 0.3
    """The same for the vehicles of one approach, compared with those of the others. By hand: the
    same drivers pass all approaches, but with other speeds and turns. Halved: an approach with
    other limits looks like an error."""
    unlike: float = 0.015
    """The same for queues and vehicles that brake, added to both. By hand. Halved: as above."""
    like_speeds: float = 0.25
    """Share by which median speeds over a detector may differ from the simulated ones. Beyond it
    the vehicles move there as on no simulated day and are not compared. By hand: rain and snow slow
    queues by less, and a road with half the limit by more. Halved: fewer passages in snow."""
    hard_mps2: float = 2.6
    """Acceleration of a vehicle over a detector whose speeds are others than simulated, m/s^2,
    times the share by which they differ. It is SUMO's usual acceleration. Halved: the end of a
    slower road looks like an extension."""
    sure_of_a_point: float = 9.0
    """Difference in cost from which speeds are not taken for those of the rear. By hand: three
    deviations. Halved: slow drivers look like speeds measured elsewhere."""
    narrower_place: float = 4.0
    """Cost by which a place must be better than a larger one that holds it. By hand: two
    deviations. Halved: one kind of detectors is named for all of them by chance."""
    told_apart: float = 4.0
    """Difference in cost from which a longer zone and an extension are told apart. By hand: two
    deviations. Halved: one of them is said alone where chance decides."""
    price_of_an_error: float = 8.0
    """Price of an error of a group of detectors, in squared deviations. By hand. Halved: approaches
    are judged apart from each other by chance."""
    least_touching: float = 5.0
    """Expected number of passages without a gap from which their lack tells that close vehicles are
    reported as one. By hand: none of five is seen by chance in one case of 150. Halved: in one of
    12."""
    merged_share: float = 0.3
    """Share of the expected passages without a gap below which close vehicles are reported as one.
    By hand. Halved: more such reports count as split."""
    speed_doubt: float = 0.15
    """Standard deviation of the speed of lone vehicles if speeds are not measured, as a share. By
    hand: limits are driven at 85 to 115 %. Halved: slow drivers look like long extensions."""
    queue_doubt: float = 0.5
    """The same for vehicles in a queue, or behind a stop line. By hand: slow drivers need half as
    much time again. Halved: as above."""
    pace_doubt: float = 0.04
    """Share by which a distance may differ if speeds come from times over zones. By hand. Halved:
    drivers who brake early look like detectors elsewhere."""
    usual_extension_s: float = 1.0
    """Prior standard deviation of an extension, s. NTCIP 1202 allows 0 to 25.5 s, and most are
    within 2 s. Halved: extensions of 3 s are drawn towards 0 where data are few."""
    usual_zone_m: float = 3.0
    """Prior standard deviation of the length of a zone, m: half of a usual loop of 6 ft by 20 ft,
    FHWA Traffic Detector Handbook (2006). Halved: long zones are drawn towards what is stated."""
    usual_offset_m: float = 15.0
    """Prior standard deviation of the position of an advance detector, m. By hand: setbacks are
    read off plans, and sometimes given to another point. Halved: large errors are drawn to 0."""
    twin_doubt: float = 0.3
    """Share by which twins of vehicles side by side may differ. By hand: other drivers form other
    platoons. Halved: platoons look like splash."""
    coincidence_doubt: float = 0.02
    """Share of vehicles that other drivers may let start beside another one at the same moment. By
    hand: 0 to 0.03 on simulated days with the usual drivers. Halved: platoons look like splash."""
    splash_doubt: float = 0.1
    """Share by which the share of splash may be wrong. By hand: in dense traffic fewer passages are
    alone. Halved: intervals of large shares are too narrow."""
    count_doubt: float = 0.01
    """Share by which counts of two kinds of detectors on the same lanes may differ, beside splash.
    By hand: loops miss a vehicle in a hundred. Halved: such a miss is taken for splash."""
    agreeing_deviations: float = 3.0
    """Standard errors up to which counts and their witness speak for one share of splash. By hand:
    seldom above by chance. Halved: counts are set aside where they would tell more."""
    shown_deviations: float = 2.0
    """Standard errors above which a witness shows a splash, of which counts may tell more. By
    hand: counts alone cannot tell it from missed vehicles. Halved: these become splash."""
    usual_splash: float = 0.2
    """Prior standard deviation of the share of passages with a twin. By hand: a loop that reports
    every fourth vehicle beside it is soon mended. Halved: large shares are drawn to 0."""
    named_deviations: float = 4.0
    """Standard errors beyond which an error of detectors is named. By hand: many groups are judged.
    Halved: one group in twenty is blamed by chance."""
    least_extension_s: float = 0.15
    """Extension below which it does not matter, s: above the response time of loop detectors.
    Halved: response times are named."""
    least_zone_m: float = 0.7
    """Error of a zone's length below which it does not matter, m. By hand: the field of a loop
    reaches beyond its edge by as much. Halved: such fields are named."""
    least_offset_m: float = 1.0
    """Error of a position below which it does not matter, m. By hand: setbacks are read off plans.
    Halved: errors are named that hardly change any statistic."""
    least_splash: float = 0.02
    """Share of vehicles reported by the next lane too from which it matters. By hand. Halved:
    chance is named more often."""
    coarsest_clock_s: float = 0.2
    """Grain of the stamps of detections above which errors of detectors are not examined, s. By
    hand: vehicles are over a zone for less than half a second. Halved: logs in fifths of seconds
    are not examined."""
    pulse_share: float = 0.9
    """Share of passages with nearly the same time from which a detector reports pulses. By hand.
    Halved: dense traffic at one speed looks like pulses."""

    # --- locate and propose -------------------------------------------------------------------

    heavy_tail: float = 6.0
    """Standardised difference up to which its tail is nearly normal. By hand, from simulated data
    sets. Halved: strong local differences are discovered less often."""
    least_bins: int = 3
    """Least number of bins of time that are scanned for a stretch. By hand. Halved: a single bin
    may be a stretch."""
    largest_z: float = 15.0
    """Standardised difference at which single places and bins are cut off. By hand: one bin must
    not decide alone. Halved: strong and very strong differences look alike."""

    dwell_s: float = 40.0
    """Standing time of a parked vehicle in a hypothesis, s. By hand. Halved: the fitted rate of
    parking doubles."""
    most_lanes: int = 24
    """Largest number of incoming lanes for which parking is tried on each. By hand, to save time.
    Halved: on networks with more lanes only suspicious lanes are tried."""
    shifts_s: tuple[float, ...] = (-900.0, -600.0, -300.0, -150.0, 150.0, 300.0, 600.0, 900.0)
    """Shifts of demand in time that are tried, s. By hand. Halved: fits of shifts of ten minutes
    and more start too far from the solution."""
    suspect_timing: float = 16.0
    """Squared standardised size beyond which a shift of demand is proposed (4 deviations, for eight
    shifts). By hand. Halved: more simulations, the same result."""
    strengths_of_a_shift: tuple[float, float] = (0.5, 2.0)
    """Least and largest strength at which a shift of demand fits the counts; 1 is exact. By hand.
    Halved: shifts twice as long as needed are proposed."""
    least_shift_s: float = 45.0
    """Shift of demand below which it does not matter, s. By hand. Halved: shifts by chance are
    named."""
    mostly: float = 0.7
    """Share of an edge's vehicles beyond which its counts belong to one origin. By hand. Halved:
    origins are mixed up."""
    alone: float = 0.1
    """Share of the variance of a count that no other edge has: vehicles still on their way, errors
    of the detector. By hand. Halved: two edges of one stream count almost as one."""
    suspect_change: float = 9.0
    """Squared standardised change beyond which an origin or a turn is examined (3 deviations). By
    hand. Halved: more simulations, the same result."""
    places_of_a_kind: int = 2
    """Largest number of origins, turns, edges, traffic lights or exchanged pairs of detectors that
    are proposed at a time. By hand, to save time. Halved: of two changed origins, one waits for the
    next round."""
    demand_factors: tuple[float, float] = (0.3, 3.0)
    """Least and largest factor of an origin's demand that is tried first. By hand. Halved: stronger
    changes start too far from the solution."""
    least_demand: float = 0.03
    """Change of a demand's factor below which it does not matter. By hand. Halved: chance of the
    counts is named more often."""
    visible_turn: float = 4.0
    """Least squared standardised change by all vehicles taking one turn. By hand. Halved: turns
    that counts hardly show are examined."""
    least_turn: float = 0.02
    """Least share of vehicles that would have to take another turn. By hand. Halved: more turns are
    examined."""
    most_turning: float = 0.9
    """Largest such share that is tried first. By hand. Halved: fits of strong changes start too far
    from the solution."""
    least_turning: float = 0.03
    """Share of vehicles with another turn below which it does not matter. By hand. Halved: as for
    `least_demand`."""
    surges: int = 2
    """Largest number of surges that are proposed at a time. By hand, to save time. Halved: of two
    surges, one waits for the next round."""
    closures: int = 4
    """Largest number of closed lanes that are proposed at a time. By hand, to save time. Halved:
    the lane beside a closed one may hide it."""
    mixed_closures: int = 3
    """Closures of a lane with the begin of one kind of count and the end of another: a queue comes
    late to one detector and leaves another late. By hand, to save time. Halved: a closure may get a
    window that no step leads away from."""
    surge_factors: tuple[float, float] = (0.1, 4.0)
    """Least and largest factor of a surge that is tried first. By hand. Halved: as for
    `demand_factors`."""
    least_surge: float = 0.1
    """Change of a surge's factor below which it does not matter. By hand. Halved: surges by chance
    are named."""
    usual_speed_ratio: float = 0.8
    """Speed on an edge that is tried first if the data show none, as a multiple of the simulated
    one. By hand. Halved: fits start too far from the solution."""
    least_speed_ratio: float = 0.03
    """Difference from 1 from which a measured multiple is used instead. By hand. Halved: multiples
    that may be chance are simulated."""
    speed_ratios: tuple[float, float] = (0.2, 2.0)
    """Least and largest multiple that is tried first. By hand. Halved: speeds above the simulated
    one are not tried."""
    least_speed_change: float = 0.02
    """Change of such a multiple below which it does not matter. By hand. Halved: chance is named
    more often."""
    first_late_green_s: float = 2.0
    """Lost time of a traffic light that is tried first, s. By hand. Halved: it changes the
    statistics less beyond chance."""
    least_late_green_s: float = 0.3
    """Lost time below which it does not matter, s. By hand. Halved: chance is named more often."""
    least_clock_s: float = 0.2
    """Error of a signal's clock below which it does not matter, s. By hand. Halved: as above."""
    drifting_clocks: int = 1
    """Largest number of clocks that are proposed as drifting at a time. By hand, to save time.
    Halved: none is."""
    least_drift: float = 0.5
    """Drift of a clock below which it does not matter, s per hour. By hand. Halved: as above."""
    first_parking: float = 20.0
    """Parked vehicles per hour and lane that are tried first. By hand. Halved: they change the
    statistics less beyond chance."""
    least_parking: float = 3.0
    """Parked vehicles per hour below which parking does not matter. By hand. Halved: parking by
    chance is named."""
    faults_of_a_kind: int = 3
    """Largest number of detectors that are proposed for one kind of fault. By hand, to save time.
    Halved: further faults wait for the next round."""
    short_count: float = 2.5
    """Standardised lack of vehicles beyond which a detector may count too few. By hand. Halved:
    quiet lanes are proposed, and rejected by simulation."""
    missed_shares: tuple[float, float] = (0.03, 0.9)
    """Least and largest share of missed vehicles that is tried first. By hand. Halved: detectors
    that miss most start too far from the solution."""
    least_undercount: float = 0.02
    """Share of missed vehicles below which it does not matter. By hand. Halved: chance is named
    more often."""
    swap_suspect: float = 4.0
    """Difference of a count, in errors of counts by chance, beyond which two detectors may be
    exchanged. By hand. Halved: more pairs are compared."""
    swap_left: float = 0.3
    """Largest share of the squared differences that an exchange may leave. By hand. Halved: noisy
    counts hide an exchange."""
    swap_errors: float = 3.0
    """Least difference of the two expected counts, in such errors of both. By hand. Halved:
    detectors with similar counts are proposed."""
    scan_s: float = 60.0
    """Step of the scan for windows, s. By hand; the fit then uses smaller steps. Halved: slower,
    equally exact."""
    shortest_stretch_s: float = 240.0
    """Shortest window that is proposed, s. By hand: two cycles. Halved: platoons of one cycle are
    proposed as surges."""
    longest_stretch: float = 0.7
    """Longest window, as a share of the period; the rest must show the usual level. By hand.
    Halved: effects on most of a period are proposed for part of it."""
    unusual_stretch: float = 4.0
    """Least standardised size of a window that is proposed; thousands of stretches are compared. By
    hand. Halved: windows by chance are simulated."""
    silent: float = 15.0
    """Missing vehicles beyond which silence of a detector may be a fault. By hand. Halved: quiet
    lanes are proposed, and rejected by simulation."""
    stuck_s: float = 240.0
    """Least time of uninterrupted occupation for a detector that may be stuck, s. By hand: longer
    than a red. Halved: long reds are proposed."""
    between: tuple[float, ...] = (0.33, 0.67)
    """Shares of the way between two simulated strengths at which directions are interpolated. By
    hand: thirds. Halved: strengths just below the larger one are predicted worse."""
    most_in_triples: int = 40
    """Largest number of directions that are combined in threes. By hand, to save time: their number
    enters with its third power. Halved: rarer triples are missed."""
    strength_ridge: float = 1e-6
    """Ridge of the normal equations for strengths, relative to their trace. By hand: only against
    singular equations. Halved: no visible change."""
    farthest: float = 1.6
    """Largest strength along a direction, as a multiple of the simulated strength. By hand. Halved:
    the simulated strength itself cannot be reached."""
    least_strength: float = 0.08
    """Strength below which an effect does not help, as a multiple of the simulated strength. By
    hand. Halved: weak false effects join strong true ones more often."""
    candidates: tuple[int, int, int] = (3, 2, 2)
    """Largest numbers of sets of one, two and three effects that are simulated in a round. By hand,
    to save time. Halved: the right set is missed if several are similar."""
    larger_share: float = 0.95
    """Share of the expected cost of a smaller set that a larger set may have at most. By hand.
    Halved: larger sets are simulated only for large gains."""
    larger_gain: float = 20.0
    """Least expected gain of a larger set besides that share. By hand, above `price`. Halved: more
    sets are simulated for small differences."""
    near_share: float = 1.3
    """Multiple of the least expected cost up to which sets of the same size are simulated. By hand:
    predictions are not more exact. Halved: only the best set is simulated."""
    near_cost: float = 50.0
    """Expected cost that is added to that multiple. By hand. Halved: fewer sets are simulated where
    little is left."""
    farther: float = 0.4
    """Share of its distance from nominal by which an effect of the model is moved away from it, for
    a direction. By hand. Halved: directions hold more chance."""
    foresight: float = 0.05
    """Share of a difference that counts as error of the prediction along directions. By hand.
    Halved: directions are trusted where effects are not linear."""

    # --- fit ----------------------------------------------------------------------------------

    price: float = 14.0
    """Distance by which an effect must improve a model to be named. By hand; a statistic of one
    degree of freedom exceeds it by chance in 2 of 10 000 cases. Halved: small false effects join
    true ones."""
    interpolation: float = 0.02
    """Share of a measured difference that counts as noise during a fit: the simulation rounds to
    its steps, the street does not. By hand. Halved: large differences bias the values."""
    steps: int = 3
    """Steps of a candidate's fit, unless its cost still falls by more than `falling`. By hand:
    enough to compare candidates. Halved: values far from the first simulation are not reached."""
    falling: float = 0.1
    """Share of the cost above which a last step is followed by another one. By hand: such a fit is
    not at its end. Halved: fits of sets that explain little take longer."""
    steps_of_the_best: int = 6
    """Further steps of the best set of a round, or more likewise. By hand: a step costs six days,
    and what a fit leaves behind is searched in a whole round. Halved: in worlds with three effects
    some of them are left to a further round, which finds imitations."""
    steps_without: int = 2
    """The same if one effect is left out of a fitted set. By hand: the others are near already.
    Halved: more superfluous effects stay."""
    shorter_step: float = 0.4
    """Share of a step that is tried if the whole step makes the fit worse. By hand. Halved: slower
    where derivatives are noisy."""
    longest_move: float = 4.0
    """Longest move of a value near nominal in one step, in units of its least effect that matters.
    By hand. Halved: weak effects need more steps."""
    nearby: float = 0.2
    """Move of a value for a derivative, as a share of its distance from nominal. By hand. Halved:
    derivatives hold more chance."""
    far: float = 0.9
    """Largest such share, used if shorter moves do no more than chance. By hand. Halved: weak
    effects have no derivative."""
    plain_move: float = 10.0
    """Change that such a move should make, in standard deviations of the statistics. By hand.
    Halved: derivatives have errors of a fifth instead of a tenth."""
    largest_move: float = 60.0
    """Largest change that such a move should make, in the same unit. By hand: an acceleration of
    0.5 that moves to 0.9 empties the queues. Halved: derivatives of strong effects hold more
    chance."""
    ridge: float = 1e-3
    """Ridge of a Gauss-Newton step relative to its normal equations. By hand: only against singular
    equations. Halved: no visible change."""
    least_gain: float = 1.0
    """Gain in cost after which another step follows. By hand: less is noise of the simulated days.
    Halved: more steps, almost the same values."""
    settling_days: int = 16
    """Days for the last step of a fit. By hand. Halved: named values come from few days."""
    settled_within: float = 0.2
    """Largest error of a value without a last step, in standard errors. By hand. Halved: more last
    steps."""
    window_steps_s: tuple[float, ...] = (120.0, 60.0, 30.0)
    """Steps for start and end of a window, s. By hand. Halved: windows are known to a quarter of a
    minute, but the search stops at a wrong place more often."""
    window_days: int = 4
    """Days for each such step. By hand, to save time. Halved: chance moves windows."""
    shortest_window_s: float = 60.0
    """Shortest window after such steps, s. By hand. Halved: no change in practice."""
    half_interval: float = 1.96
    """Half width of a 95 % interval, in standard errors: the normal quantile of 0.975. Halved:
    intervals hold two of three values, and weak effects are dropped less often."""
    straightness_moves: tuple[float, ...] = (-5.0, -2.0, 2.0, 5.0)
    """Moves of a value that test if its estimate is linear, in standard errors. By hand. Halved:
    steps by whole vehicles are not found."""
    blunt: float = 0.2
    """Least share of such a move that the estimate must follow; below it, the moves count as error
    of the value. By hand. Halved: intervals of values without an effect are too short."""

    # --- test of the remaining difference -----------------------------------------------------

    null_draws: int = 40
    """Data sets drawn from each half of a model's days. By hand. Halved: the distribution of chance
    is known 1.4 times less exactly."""
    drawn_once: float = 0.25
    """Data sets of at most this share of these days are drawn without repetition, larger ones with.
    Measured on data of the model itself: 30 of 30 days without repetition, and the test at 5 %
    rejected 56 %; 3 of 30, none. 1: large data sets are held unusual that are not."""
    least_log_spread: float = 0.02
    """Least standard deviation of the logarithm of a tested statistic. By hand: 80 draws may be
    equal by chance. Halved: tiny differences count as unusual."""
    added_distance: float = 1.0
    """Number that is added to a tested statistic before its logarithm is taken. By hand: statistics
    near 0 must not decide. Halved: distributions of small statistics are less nearly normal."""
    floor_deviations: float = 2.326
    """Standard deviations of the logarithm up to the noise floor: the normal quantile of 0.99.
    Halved: 12 of 100 data sets of the model itself lie above the floor."""
    one_day: float = 0.25
    """Chance above which data without one of their days are not unusual. By hand: a difference must
    not depend on a single day. Halved: single odd days excuse more models."""
    least_apart: float = 0.3
    """Least share of a direction that a fit must leave for its test. By hand. Halved: directions
    that the fit has nearly removed are tested, and mostly chance is left in them."""

    # --- select -------------------------------------------------------------------------------

    rounds: int = 4
    """Largest number of rounds of the search. By hand. Halved: more than two effects are found only
    if they are proposed together."""
    candidates_fitted: int = 3
    """Candidates of a round that are fitted. By hand, to save time. Halved: the right candidate is
    missed if the first steps mislead."""
    kinds_of_places: int = 5
    """Kinds of effects at places for which the best effect is simulated. By hand, to save time.
    Halved: rarer kinds wait for another round."""
    exchanged: int = 2
    """Exchanges of each effect of the model for another one that are fitted in a round. By hand:
    most effects have one or two that imitate them. Halved: an imitation stays more often."""
    imitation_share: float = 0.05
    """Share of the squared change by an effect that another one may be predicted to leave in its
    place, beside what is usual. By hand: a fifth of the change itself. Halved: a signal clock stays
    in the place of a start-up delay beside slow drivers."""
    nearest: int = 3
    """Simulated strengths that are tried unchanged. By hand. Halved: effects that act in steps are
    missed where directions mislead."""
    nearer: float = 0.8
    """Share of the gap that such a strength may leave. By hand. Halved: only strong ones are
    tried."""
    tolerance: float = 0.02
    """Share of the first difference in a statistic that a model may leave: values and simulation
    steps are not more exact. By hand. Halved: strong effects are explained only in part."""
    look_elsewhere: float = 0.25
    """Share of the gap that effects on the whole network must leave before places are examined. By
    hand. Halved: more simulations."""
    small_distance: float = 2.0
    """Distance per statistic of the network below which the pools show nothing, so that places are
    examined. By hand. Halved: places are examined less often."""
    candidate_gain_share: float = 0.6
    """Share of the best candidate's gain that another candidate must reach to be fitted. By hand:
    its gain is that before its fit, the other's that after it. Halved: more candidates are
    fitted."""
    rival_share: float = 2.0
    """Multiple of the best candidate's cost up to which other candidates are fitted to the end as
    well. By hand: `steps` may leave half of the cost, and effects that imitate each other change
    places in the rest. Halved: the one that is fitted faster is taken."""
    large_distance: float = 20.0
    """Distance per statistic beyond which several effects at once are likely from the start. By
    hand. Halved: cautious drivers are tried more often."""
    small_p_factor: float = 100.0
    """Factor below the level of the tests from which a small p value alone justifies a test of a
    model that gains less than its price. By hand. Halved: more such models are tested."""
    negligible: float = 150.0
    """Largest extra cost of a smaller set of effects that is tested instead of a larger one. By
    hand: the test decides, this only saves time. Halved: superfluous effects stay more often."""

    beyond_doubt: float = 15.0
    """Standard errors from its usual values beyond which no set without an effect is tried: the
    data would fit worse by the square, which is more than `negligible`. No interval holds a value
    with which they do. By hand. Halved: a set that is nearly as good, and smaller, is missed."""

    # --- verdict ------------------------------------------------------------------------------

    indistinct: float = 25.0
    """Difference in cost below which models fit equally well: a likelihood ratio of e^12 separates
    them. By hand. Halved: rivals are named less often."""
    rivals_tested: int = 2
    """Largest number of rivals that are tested. By hand, to save time. Halved: a third explanation
    is named less often."""
    fit_level: float = 0.01
    """Chance on the fitted periods below which they contradict a model; the test on the held-out
    periods is stricter. By hand. Halved: almost the same verdicts."""
    part: float = 0.5
    """Least share of the gap that a partial explanation must remove. By hand: the larger half.
    Halved: effects are named that explain a quarter."""
    deciding_z: float = 5.0
    """Standardised difference between two models that would decide, for the number of further
    periods to measure. By hand. Halved: a quarter of these periods is asked for."""
    confirmed: float = 10.0
    """Distance plus penalty for noise by which effects must improve the held-out periods. By hand,
    below `price`. Halved: chance confirms more often."""

    # --- patterns in what is left -------------------------------------------------------------

    pattern_bin_s: float = 300.0
    """Bins of time of the cells, s. By hand; patterns may fill several. Halved: windows are found
    more exactly, and slower."""
    most_pattern_bins: int = 24
    """Most of these bins: windows of time are all pairs of them, so that a day of 300 s would fill
    the memory. By hand. Halved: periods of more than an hour have coarser windows."""
    pattern_days: int = 24
    """Simulated days with which single vehicles are compared. By hand. Halved: the chance of a
    pattern is known 1.4 times less exactly."""
    pattern_draws: int = 20
    """Data sets drawn from each half of these days. By hand. Halved: as above."""
    price_of_a_limit: float = 10.0
    """Squared deviations that each limit of a pattern must explain: by place, kind, position, age,
    time or length. By hand. Halved: patterns are narrower than what they show."""
    least_simulated: float = 5.0
    """Simulated vehicles below which a cell is not compared. By hand. Halved: means of a few
    vehicles are compared."""
    least_relative_spread: float = 0.02
    """Least standard deviation of single vehicles in a cell, as a share of the mean. By hand.
    Halved: cells that hardly vary weigh up to four times as much."""
    least_share: float = 0.03
    """Share below which a pattern does not matter. By hand. Halved: differences are told that no
    plan would change for."""
    most_patterns: int = 3
    """Largest number of patterns that are told. By hand: a page has room for more than a reader has
    patience. Halved: one."""

    # --- detection limits -----------------------------------------------------------------------

    limit_power: float = 0.8
    """Share of data sets that must contradict a model without an effect, so that the data would
    show it. The usual power of a study (Cohen 1988). Halved: limits lie nearer to the usual value,
    and most streets with such an effect pass unseen."""
    limit_sets: int = 20
    """Data sets drawn for that share. Halved: it is known to 13 instead of 9 %."""
    limit_days: int = 10
    """Least number of days from which they are drawn; else twice that of the fitted periods. By
    hand. Halved: sets have more days in common, and the share is known less exactly."""
    limit_halvings: int = 3
    """Times by which the way from the usual to the farthest value is halved. By hand: a limit is
    known to an eighth of this way. Halved: to a quarter, in two thirds of the time."""

    # --- check of traffic before the scenario is corrected ------------------------------------

    check_draws: int = 200
    """Data sets drawn for the error of the gain in held-out travel times and queues. Halved: this
    error is known to 7 instead of 5 %."""
    check_deviations: float = 1.645
    """Standard errors by which that gain must be above 0: the normal quantile of 0.95, so one in
    twenty corrections without use passes. Halved: one in five."""
    most_traffic_error: float = 1.0
    """Largest sum of relative errors of travel times and queues that a correction may leave. By
    hand: beyond it detections of model and street are not of the same vehicles. Halved: corrections
    that take off most of a large error are refused."""
    least_journeys: float = 20.0
    """Vehicles below which the data hold no travel times of an approach, or none at all. By hand.
    Halved: means of ten vehicles are told."""
    least_gaps: float = 10.0
    """Gaps of queued vehicles below which an approach has no capacity. By hand. Halved: capacities
    of single queues are told."""

    # --- signal log and usual criteria --------------------------------------------------------

    least_clearances: int = 20
    """Least number of clearances from which a time is read off the log. By hand. Halved: short logs
    are trusted."""
    usual_share: float = 0.8
    """Share of the clearances that must agree. By hand. Halved: for a traffic light with two times,
    one of them is read off."""
    least_timing_s: float = 0.05
    """Difference of a time in the log from the scenario's that counts, s: logs have tenths of a
    second. Halved: no change."""
    least_days: int = 3
    """Least number of days for FHWA's criteria (FHWA-HOP-18-036). Halved: two days, which show too
    little variation."""
    interval_s: float = 900.0
    """Interval of FHWA's criteria, s (FHWA-HOP-18-036, chapter 5). Halved: counts are noisier and
    fail the criteria."""

    def days_of_a_limit(self, periods: int) -> int:
        """Return the days from which data sets of so many periods are drawn for a limit."""
        return max(self.limit_days, 2 * periods)

    def of_sightings(self) -> str:
        """Return a digest of the numbers in `OF_SIGHTINGS`, for the key of cached days."""
        text = repr([getattr(self, name) for name in OF_SIGHTINGS])
        return hashlib.sha256(text.encode()).hexdigest()[:12]
