"""Tallies of simulated days: computed in parallel, cached on disk, within a budget."""

from __future__ import annotations

import contextlib
import copy
import functools
import hashlib
import io
import itertools
import lzma
import math
import threading
import time
import tokenize
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import installed_version
from ugat_marl.diagnosis.arrivals import DemandBalance, corrected
from ugat_marl.diagnosis.features import (
    COUNT_FEATURES,
    FEATURES,
    DetectorLayout,
    Greens,
    Tally,
    tally,
)
from ugat_marl.diagnosis.intervals import with_intervals
from ugat_marl.diagnosis.replay import Day, Replay
from ugat_marl.diagnosis.sightings import Sightings
from ugat_marl.diagnosis.supplementary_data import SupplementaryData
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.unmeasured import Unmeasured
from ugat_marl.effects import Effect
from ugat_marl.errors import OptionError, ScenarioError, SimulatorError, UgatMarlError
from ugat_marl.files import MALFORMED, user_cache, write_whole
from ugat_marl.parallel import Workers, parts_at_a_time
from ugat_marl.scenarios import Period, Scenario
from ugat_marl.seeding import derive_seed

# --- days on which traffic stood still ------------------------------------------------------------


@dataclass(frozen=True)
class OrdinaryDays:
    """Ordinary days of the scenario as it is.

    Attributes:
        set_aside: Numbers of its days on which traffic came to a standstill.
        day_to_day: Robust standard deviation of the vehicles counted on the other days.
    """

    set_aside: frozenset[int] = frozenset()
    day_to_day: float = 0.0

    @classmethod
    def of(cls, tallies: Sequence[Tally], thresholds: Thresholds) -> OrdinaryDays:
        """Separate ordinary days from days of standstill.

        Args:
            tallies: Days of the scenario as it is, by number from 0 on.
            thresholds: Numbers of the method.
        """
        aside = frozenset(locked_up(tallies, thresholds))
        return cls(aside, day_to_day([day for n, day in enumerate(tallies) if n not in aside]))


def day_to_day(tallies: Sequence[Tally]) -> float:
    """Return the robust standard deviation of the vehicles counted per day."""
    return 1.4826 * float(np.median(np.abs(_counts(tallies)))) + 1e-9


def locked_up(tallies: Sequence[Tally], thresholds: Thresholds, usual: float = 0.0) -> list[int]:
    """Find the few days of a model on which traffic came to a standstill.

    A single such day inflates the noise of all statistics. If such days are common, they belong to
    the model, and none is returned.

    Args:
        tallies: Days of one model.
        thresholds: Numbers of the method.
        usual: Lower bound of `day_to_day`, since few days estimate it badly.

    Returns:
        Indices into `tallies`.
    """
    spread = max(day_to_day(tallies), usual)
    unusual = np.flatnonzero(np.abs(_counts(tallies)) > thresholds.locked_up * spread)
    return unusual.tolist() if len(unusual) <= max(1.0, thresholds.rare * len(tallies)) else []


def _counts(tallies: Sequence[Tally]) -> NDArray[np.float64]:
    """Return the vehicles counted on each day, minus the median of days with the same window."""
    counts = np.array([day.bins[: len(COUNT_FEATURES)].sum() for day in tallies])
    for window in {day.window for day in tallies}:
        own = np.array([day.window == window for day in tallies])
        counts[own] -= np.median(counts[own])
    return counts


# --- simulated days -------------------------------------------------------------------------------

VERSION = 14
"""Version of features and replays; tallies cached under another version are not used."""

_READING = threading.Lock()
"""Held while arrays are read: numpy parses their heads with `ast`, and in Python 3.11 two threads
that do so at once may raise a SystemError (gh-106905)."""

_DAMAGED = (
    OSError,
    EOFError,
    MemoryError,
    RuntimeError,
    SyntaxError,
    lzma.LZMAError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    *MALFORMED,
)
"""Exceptions that zipfile and numpy raise for a damaged file.

Heads of arrays are parsed before their checksums are known. They may be no Python, or claim too
much memory."""

_SUPPLEMENTARY = "between "
"""Start of the names of `Tally.supplementary` in the cache."""

_KEPT_DAYS = 40
"""Largest number of simulated days of models that are kept in memory with their passages.

All days of the scenario as it is are kept, since faults of detectors are tried on them. An hour of
an intersection takes about 0.2 MB: 2000 vehicles over three detectors, 32 bytes a passage."""

Job = TypeVar("Job")
Done = TypeVar("Done")


EndedBudget = Literal["budget_h", "budget_s"]
"""Setting of a budget that has ended."""


class OutOfTime(UgatMarlError):
    """The budget is spent; the diagnosis ends with the results so far."""


class Budget:
    """Work that a diagnosis may do: simulated hours, and wall time if that is limited too.

    Days from the cache are no work. The hours are those of the measured periods; the warm-up before
    them does not count.

    Args:
        hours: Simulated hours after which new simulations are refused.
        deadline: ``time.monotonic()`` after which they are refused; None for no limit.

    Attributes:
        spent_h: Simulated hours so far.
        ended: Setting of the budget that ended first; None while there is some left.
    """

    def __init__(self, hours: float = math.inf, deadline: float | None = None) -> None:
        self._hours = hours
        self._deadline = deadline
        self._lock = threading.Lock()
        self.spent_h = 0.0
        self.ended: EndedBudget | None = None

    def spend(self, period: Period) -> None:
        """Spend the hours of a period.

        Raises:
            OutOfTime: The budget is spent.
        """
        with self._lock:
            late = self._deadline is not None and time.monotonic() > self._deadline
            if late or self.spent_h >= self._hours:
                self.ended = self.ended or ("budget_s" if late else "budget_h")
                raise OutOfTime("the budget is spent")
            self.spent_h += period.length_s / 3600.0


@dataclass(frozen=True, eq=False)
class Replicate:
    """Features of a simulated day.

    Attributes:
        tally: Features of the day, with counts corrected to the demand if `due` is known.
        travel_time_s: Mean travel time, s.
        counted: Features before this correction; None without a correction.
        due: Vehicles asked for and given; None without a correction.
    """

    tally: Tally
    travel_time_s: float
    counted: Tally | None = None
    due: DemandBalance | None = None


def spread(count: int) -> list[int]:
    """Return the numbers below `count` in an order whose first ones are far apart.

    Each step is the golden section of the whole, as nearly as all numbers are met. Hours of a
    morning would have another mean than those of a day, and so would the effects fitted to them.
    """
    step = round(count * (math.sqrt(5) - 1) / 2)
    while math.gcd(step, count) > 1:
        step += 1
    return [number * step % count for number in range(count)]


class Engine:
    """Simulator of days of models; it reduces days to tallies and caches them.

    Args:
        scenario: The scenario without effects.
        layout: Lanes and detectors.
        replay: Simulator of one day with SUMO.
        periods: Measured periods; `place_of` says under whose signals a day runs.
        seed: Root seed of the days.
        thresholds: Numbers of the method.
        budget: Work that may be done. It is an attribute, too.
        unmeasured: What simulated days do without.
        cache: Folder of the cached tallies; None for no cache on disk.
        workers: Simulations at a time, None for one per core; or an executor that simulates days.
        base_days: Number of days of the scenario as it is that decide which days are ordinary; 0 if
            all days are.
        interval_s: Length of the intervals of measured counts, s; None if single vehicles are
            compared.
        supplementary: Measured turning counts, travel times and states of lanes; None without any.
    """

    def __init__(
        self,
        scenario: Scenario,
        layout: DetectorLayout,
        replay: Replay,
        periods: Sequence[Period],
        seed: int,
        thresholds: Thresholds,
        *,
        budget: Budget,
        unmeasured: Unmeasured,
        cache: Path | None = None,
        workers: Workers = None,
        base_days: int = 0,
        interval_s: float | None = None,
        supplementary: SupplementaryData | None = None,
    ) -> None:
        self._base_days = base_days
        self._interval_s = interval_s
        self._supplementary = supplementary
        self.layout = layout
        self.periods = tuple(periods)
        stretches: dict[tuple[float, float], list[int]] = {}
        for place, period in enumerate(periods):
            stretches.setdefault(period.window, []).append(place)
        in_order = [stretches[window] for window in sorted(stretches)]
        self._stretches = [in_order[place] for place in spread(len(in_order))]
        self.budget = budget
        self._replay = replay
        self._seed = seed
        self._thresholds = thresholds
        self._cache = cache
        self._workers = workers
        # Lights of a simulated day change with its steps, those of the street at any time.
        self._greens = [layout.greens(replay.shown(period)) for period in periods]
        self._days_as_it_is: OrderedDict[str, Future[Day]] = OrderedDict()
        self._days_of_models: OrderedDict[str, Future[Day]] = OrderedDict()
        self._of_days = threading.Lock()
        self._known: dict[str, Replicate] = {}
        self._unmeasured = unmeasured
        versions = installed_version("eclipse-sumo"), installed_version("numpy")
        head = (
            VERSION,
            FEATURES,
            scenario.hash,
            layout.detectors,
            versions,
            seed,
            thresholds.of_a_day(),
        )
        head += self._unmeasured.key
        head += (replay.day_to_day,) if replay.day_to_day else ()
        head += ("intervals/2", interval_s) if interval_s else ()
        head += (supplementary,) if supplementary else ()
        self._root = hashlib.sha256(repr(head).encode()).hexdigest()
        turns = () if supplementary is None else supplementary.turns
        edges = {edge for _, edge, _ in layout.places}
        self._balanced = sorted(edges | set(map(" ".join, turns)))
        self._signals = [_signals_hash(period, replay.answering) for period in periods]
        self._known_by: Callable[[], None] | None = None
        self._detection: tuple[Effect, ...] = ()

    def place_of(self, number: int) -> int:
        """Return the place of the period under whose signals a day runs.

        Days go round the stretches of the day, and within a stretch round its periods, so that few
        days are enough for some of each stretch. Where there are more stretches than days, those
        that come are from all over the day, see `spread`.
        """
        own = self._stretches[number % len(self._stretches)]
        return own[number // len(self._stretches) % len(own)]

    def detecting(self, errors: Sequence[Effect]) -> Engine:
        """Return a simulator of the same days, seen by detectors with errors of measurement.

        Args:
            errors: Errors of measurement, which then belong to every model, and those of `self` no
                more.
        """
        other = copy.copy(self)
        other.__dict__.pop("ordinary_days", None)
        other._detection = tuple(errors)
        other._replay = self._replay.detecting(errors)
        return other

    def sightings(
        self, effects: Sequence[Effect], numbers: Sequence[int], advance: Callable[[], None]
    ) -> list[Sightings]:
        """Return what single vehicles did at the detectors on days of a model.

        Args:
            effects: Effects of the model.
            numbers: Numbers of the days.
            advance: Function to call after each day.

        Raises:
            OutOfTime: The budget is spent and a day is not in the cache.
        """

        def reduce(period: Period, greens: Sequence[Greens]) -> dict[str, Any]:
            return Sightings.of(self.layout, period, greens, self._thresholds).arrays()

        name = f"vehicles4-{self._thresholds.of_sightings()}"
        days = self.reduced(effects, numbers, name, reduce, advance)
        return [Sightings.from_arrays(arrays) for arrays in days]

    def reduced(
        self,
        effects: Sequence[Effect],
        numbers: Sequence[int],
        name: str,
        reduce: Callable[[Period, Sequence[Greens]], dict[str, Any]],
        advance: Callable[[], None],
    ) -> list[dict[str, Any]]:
        """Return what a function makes of single vehicles on days of a model; it is cached.

        Args:
            effects: Effects of the model.
            numbers: Numbers of the days.
            name: Name of the function's result, for the cache.
            reduce: Function of a period and the greens of every lane; it returns arrays by name.
            advance: Function to call after each day.

        Raises:
            OutOfTime: The budget is spent and a day is not in the cache.
        """
        every = (*self._detection, *effects)

        def one(number: int) -> dict[str, Any]:
            key = f"{self._key(every, number)}-{name}"
            arrays = self._stored(key)
            if arrays is None:
                period = self._unmeasured.kept_from(self._day(every, number).period)
                arrays = reduce(period, self._greens[self.place_of(number)])
                self._store(key, arrays)
                if not effects:  # while the day is at hand; else it is simulated again
                    self._one(every, number)
            advance()
            return arrays

        (days,) = self._together(one, [numbers])
        return days

    @property
    def known_base_days(self) -> int:
        """Number of the first `base_days` of the scenario as it is that are there."""
        keys = (self._key(self._detection, number) for number in range(self._base_days))
        return sum(key in self._known for key in keys)

    @contextlib.contextmanager
    def watched(self, advance: Callable[[], None], most: int) -> Iterator[None]:
        """Report new days, for work that needs an unknown number of days.

        Args:
            advance: Function to call after each new day.
            most: Largest number of calls.
        """
        calls = iter(range(most))

        def known() -> None:
            if next(calls, None) is not None:
                advance()

        self._known_by = known
        try:
            yield
        finally:
            self._known_by = None

    @functools.cached_property
    def ordinary_days(self) -> OrdinaryDays:
        """Ordinary days of the scenario as it is; the first access simulates unknown days.

        Raises:
            OutOfTime: The budget does not suffice for these days.
        """
        days = self.replicates([], range(self._base_days))
        if not days:
            return OrdinaryDays()
        return OrdinaryDays.of([day.tally for day in days], self._thresholds)

    def first(self, count: int) -> list[int]:
        """Return the numbers of the first days that are ordinary under the scenario as it is."""
        numbers = (n for n in itertools.count() if n not in self.ordinary_days.set_aside)
        return list(itertools.islice(numbers, count))

    def test_days(self, effects: Sequence[Effect], count: int) -> tuple[Tally, ...]:
        """Return the first ordinary days of a model, at most `count` of them."""
        return tuple(day.tally for day in self.ordinary(effects, self.first(count)).values())

    def ordinary(
        self,
        effects: Sequence[Effect],
        numbers: Sequence[int],
        advance: Callable[[], None] | None = None,
    ) -> dict[int, Replicate]:
        """Return simulated days of a model by number, without the few days of standstill.

        Args:
            effects: Effects of the model.
            numbers: Numbers of the days.
            advance: Function to call after each day.
        """
        days = self.replicates(effects, numbers, advance)
        aside = locked_up(
            [day.tally for day in days], self._thresholds, self.ordinary_days.day_to_day
        )
        known = enumerate(zip(numbers, days, strict=True))
        return {number: day for place, (number, day) in known if place not in aside}

    def replicates(
        self,
        effects: Sequence[Effect],
        numbers: Sequence[int],
        advance: Callable[[], None] | None = None,
    ) -> list[Replicate]:
        """Return simulated days of a model, in the order of `numbers`.

        Args:
            effects: Effects of the model.
            numbers: Numbers of the days.
            advance: Function to call after each day.

        Raises:
            OutOfTime: The budget is spent and a day is not in the cache.
            SimulatorError: SUMO refused the model.
        """

        def one(number: int) -> Replicate:
            day = self._one((*self._detection, *effects), number)
            if advance is not None:
                advance()
            return day

        (days,) = self._together(one, [numbers])
        return days

    def prepare(
        self,
        models: Sequence[tuple[Sequence[Effect], Sequence[int]]],
        advance: Callable[[], None] | None = None,
    ) -> None:
        """Simulate days of many models at once, so that no core waits for the end of a model.

        Errors of a model are ignored here; `replicates` raises them.

        Args:
            models: Effects and numbers of days of each model.
            advance: Function to call after each model.

        Raises:
            OutOfTime: The budget is spent.
        """

        def one(day: tuple[Sequence[Effect], int]) -> None:
            with contextlib.suppress(SimulatorError, OptionError, ScenarioError):
                self._one((*self._detection, *day[0]), day[1])

        days = [[(effects, number) for number in numbers] for effects, numbers in models]
        self._together(one, days, advance)

    def _together(
        self,
        work: Callable[[Job], Done],
        groups: Sequence[Sequence[Job]],
        advance: Callable[[], None] | None = None,
    ) -> list[list[Done]]:
        """Do groups of jobs on all workers; the first failure cancels jobs that have not begun.

        Args:
            work: Function that does one job.
            groups: Jobs in groups.
            advance: Function to call after each group.
        """
        with ThreadPoolExecutor(parts_at_a_time(self._workers)) as pool:
            futures = [[pool.submit(work, job) for job in group] for group in groups]
            done: list[list[Done]] = []
            try:
                for group in futures:
                    done.append([future.result() for future in group])
                    if advance is not None:
                        advance()
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        return done

    def _one(self, effects: tuple[Effect, ...], number: int) -> Replicate:
        key = self._key(effects, number)
        new = key not in self._known
        day = self._known.get(key) or self._remembered(key, number)
        if day is None:
            day = self._asked_for(effects, number) or self._counted(effects, number)
            self._remember(key, day)
        self._known[key] = day
        if (tell := self._known_by) is not None and new:
            tell()
        return day

    def _counted(self, effects: tuple[Effect, ...], number: int) -> Replicate:
        """Simulate a day and count it."""
        day = self._day(effects, number)
        period = self._unmeasured.kept_from(day.period)
        counted = tally(self.layout, period, self._greens[self.place_of(number)], self._thresholds)
        if self._interval_s is not None:
            counted = with_intervals(counted, self.layout, period, self._interval_s)
        counted = self._unmeasured.summed_in(counted)
        if self._supplementary is not None:
            measured = self.periods[self.place_of(number)]
            supplementary = self._supplementary.simulated(
                measured, day.point_to_point, day.lane_states
            )
            counted = replace(counted, supplementary=supplementary)
        # The cache holds float32, so round here: the result must not depend on the cache.
        counted = replace(counted, bins=counted.bins.astype(np.float32).astype(np.float64))
        return self._with_due(counted, day.travel_time_s, day.due)

    def _asked_for(self, effects: tuple[Effect, ...], number: int) -> Replicate | None:
        """Return the day without effects on departures, corrected to the demand with them.

        Returns:
            None if these effects change the simulation, or if there are none.
        """
        others = tuple(effect for effect in effects if not effect.on_departures)
        if not self._replay.answering or len(others) == len(effects):
            return None
        physics = [effect for effect in effects if not effect.on_detectors]
        period = self.periods[self.place_of(number)]
        seed = derive_seed(self._seed, "replicate", number)
        asked = self._replay.asked(physics, period, seed)
        given = None if asked is None else self._one(others, number)
        if asked is None or given is None or given.counted is None or given.due is None:
            return None
        return self._with_due(
            given.counted, given.travel_time_s, DemandBalance(asked, given.due.given)
        )

    def _with_due(
        self, counted: Tally, travel_time_s: float, due: DemandBalance | None
    ) -> Replicate:
        if due is None:
            return Replicate(counted, travel_time_s)
        measured = self._supplementary
        period = counted.period
        spans = {} if measured is None or period is None else measured.spans_of_turns(period)
        return Replicate(corrected(counted, self.layout, due, spans), travel_time_s, counted, due)

    def _day(self, effects: tuple[Effect, ...], number: int) -> Day:
        """Return a day as the detectors saw it; faults of detectors need no new simulation."""
        faults = tuple(effect for effect in effects if _after_simulation(effect))
        physics = tuple(effect for effect in effects if not _after_simulation(effect))
        key, period = self._key(physics, number), self.periods[self.place_of(number)]
        if self._replay.answering:  # an error of detectors changes the arrivals that are answered
            key += repr(tuple(map(str, self._detection)))
        as_it_is = not physics and number < self._base_days
        days = self._days_as_it_is if as_it_is else self._days_of_models
        with self._of_days:
            day = days.get(key)
            new = day is None
            if day is None:
                self.budget.spend(period)
                day = days[key] = Future[Day]()
                self._drop_days()
            else:
                days.move_to_end(key)
        if new:  # other threads that need the day wait for this one
            try:
                seed = derive_seed(self._seed, "replicate", number)
                day.set_result(self._simulated(physics, period, seed))
            except BaseException as error:
                with self._of_days:
                    days.pop(key, None)
                day.set_exception(error)
                raise
        seen = day.result()
        if not faults:
            return seen
        return replace(seen, period=self._replay.observed(faults, seen.period))

    def _drop_days(self) -> None:
        """Forget the days of models that were not used for longest, if they are too many.

        Threads may wait for a day that is being simulated, so that stays.
        """
        done = [key for key, day in self._days_of_models.items() if day.done()]
        for key in done[: max(len(self._days_of_models) - _KEPT_DAYS, 0)]:
            del self._days_of_models[key]

    def _simulated(self, effects: tuple[Effect, ...], period: Period, seed: int) -> Day:
        if not isinstance(self._workers, Executor):
            return self._replay.simulate(effects, period, seed)
        # This thread waits for the executor; the tally that follows is cheap enough for a thread.
        return self._workers.submit(self._replay.simulate, effects, period, seed).result()

    def _key(self, effects: Sequence[Effect], number: int) -> str:
        place = self.place_of(number)
        of_period = (self._signals[place],)
        if self._supplementary is not None:  # its spans are those of the period
            of_period += (self.periods[place].id,)
        text = repr((self._root, tuple(map(str, effects)), number, *of_period))
        return hashlib.sha256(text.encode()).hexdigest()

    def _remembered(self, key: str, number: int) -> Replicate | None:
        stored = self._stored(key)
        if stored is None:
            return None
        try:
            period = self.periods[self.place_of(number)]
            counted = Tally(
                stored["sums"].astype(np.float64),
                stored["bins"].astype(np.float64),
                journeys=stored["journeys"],
                supplementary={
                    name.removeprefix(_SUPPLEMENTARY): sums
                    for name, sums in stored.items()
                    if name.startswith(_SUPPLEMENTARY)
                },
                window=period.window,
                period=period.id,
            )
            due = None
            if "asked" in stored:
                asked, given = (
                    dict(zip(self._balanced, stored[name], strict=True))
                    for name in ("asked", "given")
                )
                due = DemandBalance(asked, given)
            return self._with_due(counted, float(stored["travel_time_s"]), due)
        except (ValueError, KeyError):
            return None  # damaged: simulated again

    def _remember(self, key: str, day: Replicate) -> None:
        counted = day.counted or day.tally
        arrays: dict[str, Any] = {
            "sums": counted.sums,
            "bins": counted.bins.astype(np.float32),
            "travel_time_s": np.float64(day.travel_time_s),
            "journeys": counted.journeys,
            **{f"{_SUPPLEMENTARY}{name}": sums for name, sums in counted.supplementary.items()},
        }
        if day.due is not None:
            for name, of_edge in (("asked", day.due.asked), ("given", day.due.given)):
                arrays[name] = np.stack([of_edge[edge] for edge in self._balanced])
        self._store(key, arrays)

    def _stored(self, key: str) -> dict[str, Any] | None:
        """Return the arrays under a key of the cache; None if absent or damaged."""
        if self._cache is None:
            return None
        file = self._cache / key[:2] / f"{key}.npz"
        try:
            with _READING, np.load(file, allow_pickle=False) as stored:
                return {name: stored[name] for name in stored.files}
        except _DAMAGED:
            return None

    def _store(self, key: str, arrays: Mapping[str, Any]) -> None:
        if self._cache is not None:
            content = io.BytesIO()
            np.savez_compressed(content, **arrays)
            write_whole(self._cache / key[:2] / f"{key}.npz", content.getvalue())


def _after_simulation(effect: Effect) -> bool:
    """Return True if the effect can be applied to a day that was simulated without it."""
    return effect.on_detectors and not effect.on_installation


def default_cache() -> Path:
    """Return the user's cache folder for tallies."""
    return user_cache("replicates")


def _signals_hash(period: Period, answering: bool) -> str:
    """Return a digest of the measured data that a simulated day depends on.

    Args:
        period: The measured period.
        answering: True if the day gets the measured arrivals.
    """
    content = (period.begin_s, period.end_s, sorted(period.signals.items()))
    digest = hashlib.sha256(repr(content).encode())
    if answering:
        digest.update(b"arrivals/5")
    for name, seen in sorted(period.passages.items()) if answering else ():
        times = (name, seen.on_s.tolist(), seen.off_s.tolist(), seen.speed_mps.tolist())
        digest.update(repr(times).encode())
    return digest.hexdigest()
