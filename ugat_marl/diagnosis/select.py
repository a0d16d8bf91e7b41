"""Selection of the effects: propose, simulate, fit, and stop when only chance is left."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ugat_marl.diagnosis.engine import OutOfTime
from ugat_marl.diagnosis.features import FEATURES, Tally
from ugat_marl.diagnosis.fit import WIDE, Fitter, cost_of, uncertainty
from ugat_marl.diagnosis.hypotheses import (
    CAUTION,
    Hypothesis,
    Members,
    a_few,
    both_ways,
    cautious_drivers,
    effects_of,
    keys_of,
    merged,
    title_of,
)
from ugat_marl.diagnosis.places import PlaceFinder
from ugat_marl.diagnosis.propose import (
    Direction,
    between,
    exchanges,
    promising,
    propose,
    squared_gap,
)
from ugat_marl.diagnosis.prune import Pruner, doubtful
from ugat_marl.diagnosis.records import Fitted, Located, Selected, Tested
from ugat_marl.diagnosis.residual import Directions, Null
from ugat_marl.diagnosis.statistics import Array, Whitener, sum_of
from ugat_marl.diagnosis.thresholds import Effort
from ugat_marl.effects import Effect
from ugat_marl.errors import OptionError, ScenarioError, SimulatorError
from ugat_marl.progress import Reporter
from ugat_marl.scenarios import Period

MOVES_OF_A_VALUE = 4
"""Approximate number of moves of a free value in the test of its model, for the progress bar."""

ALIKE = 8
"""Models of least cost that are compared with the best one on as many days."""


class Selector:
    """Search for the effects that explain the difference of data and scenario.

    Args:
        fitter: Simulator and fitter of models.
        place_finder: Finder of places and windows.
        library: Hypotheses about the whole network.
        periods: The fitted periods.
        effort: Numbers of simulated days.
        alpha: Level of the tests.
        null: Function that makes the test of a model from its days.
        reporter: Display of progress.

    Attributes:
        examined: Names of effects that were simulated, or for which no place was suspicious.
    """

    def __init__(
        self,
        fitter: Fitter,
        place_finder: PlaceFinder,
        library: Sequence[Hypothesis],
        periods: Sequence[Period],
        effort: Effort,
        alpha: float,
        null: Callable[[Sequence[Tally], Sequence[Tally], Directions, tuple[Effect, ...]], Null],
        reporter: Reporter,
    ) -> None:
        self._fitter = fitter
        self._thresholds = fitter.thresholds
        self._place_finder = place_finder
        self._library = tuple(library)
        self._periods = tuple(periods)
        self._effort = effort
        self._alpha = alpha
        self._null = null
        self._reporter = reporter
        self._first = fitter.base.distance(fitter.data)
        self._seen: dict[str, Fitted] = {}
        self._costs: dict[tuple[Members, int], float] = {}
        self._of_library: tuple[Direction, ...] = ()
        self._places: tuple[Direction, ...] = ()
        self._of_round: dict[int, list[Direction]] = {}
        self.examined: set[str] = set()

    def tested_along_effects(self, base: Tested) -> Tested:
        """Test the scenario as it is along the directions of single effects.

        Raises:
            OutOfTime: The budget does not suffice for their simulation.
        """
        self._places = tuple(
            self._directions(base.model, self._place_finder.everywhere(), 0, "places")
        )
        self._library_directions(base.model, 0)
        return replace(base, residual=self.null_of(base).test(self._fitter.data))

    def null_of(self, tested: Tested) -> Null:
        """Return the distribution of chance by which a model was tested along single effects."""
        if not tested.model.members:
            return self._null_of(tested.model, tested.model.tallies)
        return self._null_of(tested.model, self._days(tested.model), tested.extra)

    def _null_of(
        self, model: Fitted, days: Sequence[Tally], extra: Mapping[str, Array] | None = None
    ) -> Null:
        fitted = tuple(change for change, _ in self._fitter.changes(model))
        directions = Directions((*self._of_library, *self._places), extra, fitted)
        return self._null(days, self._fitter.data, directions, model.effects)

    def select(
        self,
        located: Located,
        known: Members = (),
        ends: Callable[[Tested], bool] | None = None,
    ) -> Selected:
        """Search from the scenario as it is, or from effects that another search has found.

        Args:
            located: The scenario as it is.
            known: Effects to begin with.
            ends: Function of a better model that does not explain the data; True ends the search.
        """
        base = best = located.base
        complete = True
        try:
            if known:
                self.kept(self._fitter.simulate(known))  # in case that the budget ends here
                self._library_directions(base.model, 0)  # along which models are tested
                best = self._fitted(base, [known], 0, "effects so far") or base
            first = 0 if best is base else 1  # round 0 looks at the scenario as it is
            for number in range(first, self._thresholds.rounds):
                if best.residual.p > self._alpha:
                    break
                improved = self._round(best, number)
                if improved is None:
                    break
                best = improved
                if ends is not None and best.residual.p <= self._alpha and ends(best):
                    return self._selected(best, located, complete=False)
            best = Pruner(self._fitter, self, self._alpha, self._reporter).pruned(best, base)
            if best.model.members and best.residual.p <= self._alpha:
                with contextlib.suppress(OutOfTime):  # the search itself has ended
                    best = self._explained_at_last(best)
        except OutOfTime:
            complete = False
            cheapest = min(self._seen.values(), key=cost_of, default=best.model)
            if cheapest.cost < best.model.cost:
                best = self._untested(self._that_matter(cheapest, base.model), base)
            elif doubtful(best, self._thresholds.half_interval):
                best = self._without_doubtful(best, base)
        return self._selected(best, located, complete=complete)

    def _selected(self, best: Tested, located: Located, *, complete: bool) -> Selected:
        rivals = tuple(sorted(self._seen.values(), key=cost_of))
        keys = keys_of(best.model.members)
        # The same effects with a further one are no other explanation.
        others = [x for x in rivals if (x.members if not keys else not keys_of(x.members) >= keys)]
        worse_by = None
        if others:
            with contextlib.suppress(OutOfTime):  # the best model was not simulated on those days
                worse_by = min(self.worse_by(rival, best.model) for rival in others[:ALIKE])
        return Selected(best, rivals, complete, located.examined | self.examined, worse_by)

    def worse_by(self, rival: Fitted, best: Fitted) -> float:
        """Return the cost of a model above that of the best one on as many days.

        More days lower the cost of a model, and few models are simulated on many.
        """
        key = best.members, len(rival.days)
        if key not in self._costs:  # many rivals have equally many days
            same = len(best.days) == key[1]
            self._costs[key] = best.cost if same else self._fitter.simulate(*key).cost
        return rival.cost - self._costs[key]

    @property
    def held(self) -> frozenset[int]:
        """Indices of the statistics of the network that the data hold."""
        return frozenset(np.flatnonzero(sum_of(self._fitter.data).sums[..., 1].any(1)).tolist())

    def test(self, model: Fitted) -> Tested:
        """Simulate more days of a model and test the remaining difference.

        The errors of its values are those of statistics that are linear in them, see `exact`.
        """
        fitter = self._fitter
        moves = len(model.values) * MOVES_OF_A_VALUE * fitter.days
        days = self._thresholds.settling_days + self._effort.test + moves
        with (
            self._reporter.task("is what is left chance", days) as advance,
            fitter.engine.watched(advance, days),
        ):
            return self._tested(model)

    def _tested(self, model: Fitted) -> Tested:
        fitter = self._fitter
        model = self.kept(fitter.settled(model, uncertainty(fitter, model)[0]))
        days = self._days(model)
        errors, extra = uncertainty(fitter, model, days)
        for name, difference in self._first.difference.items():
            extra[name] = extra[name] + (self._thresholds.tolerance * difference) ** 2
        residual = self._null_of(model, days, extra).test(fitter.data, extra)
        return Tested(model, residual, errors, extra)

    def exact(self, tested: Tested) -> Tested:
        """Add the error of statistics that are not linear in the values, by further days.

        It does not change the test, so only models that may be named need it.
        """
        fitter, model = self._fitter, tested.model
        days = len(model.values) * len(self._thresholds.straightness_moves) * fitter.days
        if not days:
            return tested
        with (
            self._reporter.task("how certain the values are", days) as advance,
            fitter.engine.watched(advance, days),
        ):
            errors, _ = uncertainty(fitter, model, self._days(model), steps=True)
        return replace(tested, errors=errors)

    def _days(self, model: Fitted) -> tuple[Tally, ...]:
        return self._fitter.engine.test_days(model.effects, self._effort.test)

    def _untested(self, model: Fitted, base: Tested) -> Tested:
        """Return a model for whose own test there was no time; its errors are not known.

        It has the test of the scenario as it is.
        """
        return Tested(model, base.residual, np.full(len(model.values), np.nan), {})

    def _without_doubtful(self, best: Tested, base: Tested) -> Tested:
        """Return the best model that was simulated with none but the certain effects of another.

        It is the scenario as it is if that costs no more, or if no such model was simulated.
        """
        parts = self._parts(best.model, doubtful(best, self._thresholds.half_interval))
        nearest = min((base.model, *parts), key=cost_of)
        return base if nearest is base.model else self._untested(nearest, base)

    def _that_matter(self, model: Fitted, base: Fitted) -> Fitted:
        """Return the best model that was simulated with none but the effects that matter.

        It is the given model if all of its effects matter, or none was simulated, and the scenario
        as it is if no effect matters, or if that costs no more.
        """
        weak = [index for index, (h, values) in enumerate(model.members) if not h.matters(values)]
        if len(weak) == len(model.members):
            return base
        parts = self._parts(model, weak) if weak else ()
        return min((base, *(parts or [model])), key=cost_of)

    def _parts(self, model: Fitted, left_out: Sequence[int]) -> list[Fitted]:
        """Return the models that were simulated with none but the other members of a model."""
        kept = {h.key for index, (h, _) in enumerate(model.members) if index not in left_out}
        return [
            part for part in self._seen.values() if part.members and keys_of(part.members) <= kept
        ]

    def _round(self, start: Tested, number: int) -> Tested | None:
        """Add, change or remove effects; return None if no change is worth its price."""
        directions = between(
            self._library_directions(start.model, number), self._thresholds.between
        )
        whitener = self._whitener(start.model, WIDE)
        gap = whitener.gap
        chance = float(len(whitener.measured))  # expected squared length if only noise is left
        enough = chance + self._thresholds.look_elsewhere * max(gap - chance, 0.0)
        proposals = propose(directions, whitener, self._thresholds)
        chosen = [proposal.members for proposal in promising(proposals, self._thresholds)]
        # If the distance is small, the difference is in single places.
        little = gap < self._thresholds.small_distance * chance
        # Sums of intervals leave few statistics of the network. Effects on the whole network
        # imitate those at places there, so places are always examined too.
        summed = len(self._fitter.data[0].sums) > len(FEATURES)
        near = little or summed or not proposals or proposals[0].expected > enough
        if near:
            chosen = [*chosen[:2], *self._at_places(start.model, directions, number)]
        if number == 0:
            chosen += self._nearest()
            chosen += (
                cautious_drivers(self._library)
                if gap > self._thresholds.large_distance * chance
                else []
            )
        else:
            chosen += self._nearer(start.model, number)
            exchanged = exchanges(start.model.members, directions, whitener, self._thresholds)
            chosen += [one.members for one in exchanged]
        best = self._fitted(start, chosen, number, "candidates")
        if best is None and not near:  # simulations did not confirm the prediction of the library
            chosen = self._at_places(start.model, directions, number)
            best = self._fitted(start, chosen, number, "places")
        return best

    def _fitted(
        self, start: Tested, chosen: Sequence[Members], number: int, what: str
    ) -> Tested | None:
        """Return the best set of effects on top of a model; None if none is worth its price."""
        title = f"round {number + 1}: {what}"
        before = self._cost_before(start.model)
        tried = self._simulated(start.model, list(dict.fromkeys(chosen)), title)
        fitted = self._refined(tried, start.model, before, self._of_round.get(number, ()))
        if not fitted:
            return None
        steps, close = self._thresholds.steps_of_the_best, list[Fitted]()
        with self._reporter.task("closer fits", len(fitted)) as advance:
            for model in fitted:
                close.append(self.kept(self._fitter.refine(model, steps, closely=True)))
                advance(note=title_of(model.members))
        best = min(close, key=cost_of)
        gain = before - best.cost
        if gain > self._thresholds.price:
            return self.test(best)
        # An effect may be clear along its own direction although the total distance hardly changes.
        if (
            start.residual.p < self._alpha / self._thresholds.small_p_factor
            and gain > -self._thresholds.price
        ):
            tested = self.test(best)
            return tested if tested.residual.p > self._alpha else None
        return None

    def _cost_before(self, model: Fitted) -> float:
        """Return the cost of a model from as many days as candidates on top of it have.

        A tested model has more days, by which the same model costs less. Where queues are long, an
        effect that is there would seem to make it worse.
        """
        return self._fitter.simulate(model.members).cost if model.members else model.cost

    def _explained_at_last(self, best: Tested) -> Tested:
        """Return a model that explains the data by effects that matter and are certain.

        It is fitted from two starting points that a search by single steps may miss. If neither
        leads to such a model, the given one is returned.
        """
        for start in (self._with_clear_effect, self._as_cautious_drivers):
            if (model := start(best)) is None:
                continue
            steps = self._thresholds.steps_of_the_best
            tested = self.test(self.kept(self._fitter.refine(model, steps, closely=True)))
            if tested.residual.p > self._alpha:
                tested = self.exact(tested)
                members = tested.model.members
                matter = all(hypothesis.matters(values) for hypothesis, values in members)
                if matter and not doubtful(tested, self._thresholds.half_interval):
                    return tested
        return best

    def _with_clear_effect(self, best: Tested) -> Fitted | None:
        """Return a model with the effect that is clear along its own direction as it was simulated.

        Linear prediction places effects that act in steps where they do nothing, and chance among
        all statistics hides what those of the whole network show. So the strengths that were
        simulated are compared by the latter.
        """
        directions = self._directions(best.model, self._library, self._thresholds.rounds)
        present = keys_of(best.model.members)
        proposals = propose(directions, self._whitener(best.model, WIDE), self._thresholds)
        clear = [hypothesis for ((hypothesis, _), *more) in (x.members for x in proposals)
                 if not more and hypothesis.key not in present]  # fmt: skip
        strengths = [((x.hypothesis, x.level),) for x in directions
                     if x.hypothesis in clear[: self._thresholds.nearest]]  # fmt: skip
        tried = self._simulated(best.model, strengths, "clear effects")
        return min(tried, key=self._gap_of_network, default=None)

    def _as_cautious_drivers(self, best: Tested) -> Fitted | None:
        """Return a model in which drivers are cautious in every way, if they are in some way.

        Beside one property alone, a clock or a closure imitates the others.
        """
        found = tuple(member for member in best.model.members if member[0].name in CAUTION)
        mild, *_ = cautious_drivers(self._library) or [()]
        if not 0 < len(found) < len(mild):
            return None
        return self._fitter.simulate(merged(mild, found))

    def _gap_of_network(self, model: Fitted) -> float:
        """Return the squared distance of the statistics of the whole network."""
        return self._whitener(model, WIDE).gap

    def _nearest(self) -> list[Members]:
        """Return the simulated single effects of the library that come nearest to the data.

        Effects may act in steps, when whole vehicles cross the start of green or a detector. Linear
        prediction between strengths misses them.
        """
        strengths = [
            ((hypothesis, level),) for hypothesis in self._library for level in hypothesis.levels
        ]
        near: list[tuple[float, int]] = []
        base, periods = self._fitter.base, len(self._fitter.data)
        gap = squared_gap(self._first, base, periods)
        for index, members in enumerate(strengths):
            with contextlib.suppress(SimulatorError, OptionError, ScenarioError):
                model = self._fitter.simulate(members, self._effort.bank)
                if squared_gap(model.distance, base, periods) < self._thresholds.nearer * gap:
                    near.append((model.cost, index))
        return [strengths[index] for _, index in sorted(near)[: self._thresholds.nearest]]

    def _nearer(self, model: Fitted, number: int) -> list[Members]:
        """Return the strengths simulated on top of a model that cost less than it, best first.

        As in `_nearest`, linear prediction misses effects that act in steps. An emergency
        deceleration changes nothing until it comes near the usual one.
        """
        days = self._effort.bank
        before = self._fitter.simulate(model.members, days).cost
        near: list[tuple[float, int]] = []
        added = [((one.hypothesis, one.level),) for one in self._of_round.get(number, ())]
        for index, members in enumerate(added):
            with contextlib.suppress(SimulatorError, OptionError, ScenarioError):
                cost = self._fitter.simulate(merged(model.members, members), days).cost
                if cost < before:
                    near.append((cost, index))
        return [added[index] for _, index in sorted(near)[: self._thresholds.nearest]]

    def _at_places(
        self, model: Fitted, directions: Sequence[Direction], number: int
    ) -> list[Members]:
        """Propose effects at places and in windows; lanes and bins of time are compared as well."""
        present = {hypothesis.key for hypothesis in self._library}
        proposed = self._place_finder.hypotheses(model.reference, model.distance, self._periods)
        local = [hypothesis for hypothesis in proposed if hypothesis.key not in present]
        known = [] if number else list(self._places)  # simulated on the scenario as it is
        places = {direction.hypothesis.key for direction in known}
        added = self._directions(model, [h for h in local if h.key not in places], number, "places")
        added += known
        proposals = propose([*directions, *added], self._whitener(model, None), self._thresholds)
        places |= {hypothesis.key for hypothesis in local}
        self.examined |= self._place_finder.allowed
        alone = [proposal for proposal in proposals if len(proposal.members) == 1]
        best: dict[str, Members] = {}
        for proposal in alone:
            hypothesis = proposal.members[0][0]
            if hypothesis.key in places:
                best.setdefault(hypothesis.name, proposal.members)
        here = list(best.values())[: self._thresholds.kinds_of_places]
        # The strength estimated from counts may be nearer than the strength along a direction.
        here += [((h, h.levels[0]),) for ((h, _),) in here if h.levels[0]]
        return [*(proposal.members for proposal in promising(proposals, self._thresholds)), *here]

    def _whitener(self, model: Fitted, blocks: tuple[str, ...] | None) -> Whitener:
        data, base = self._fitter.data, self._fitter.base
        return Whitener(model.reference, data, self._thresholds.foresight, base, blocks)

    def _library_directions(self, model: Fitted, number: int) -> tuple[Direction, ...]:
        """Return directions of the library on top of a model; those of the first round are kept."""
        if number:
            return tuple(self._directions(model, self._library, number))
        self._of_library = self._of_library or tuple(self._directions(model, self._library, 0))
        return self._of_library

    def _directions(
        self, model: Fitted, hypotheses: Sequence[Hypothesis], number: int, what: str = "library"
    ) -> list[Direction]:
        """Simulate hypotheses on top of a model, and return the changes of the statistics."""
        present = {hypothesis.key: values for hypothesis, values in model.members}
        jobs: list[tuple[Hypothesis, tuple[float, ...], tuple[float, ...] | None]] = []
        for hypothesis in dict.fromkeys(hypotheses):
            if hypothesis.key not in present:
                levels = hypothesis.levels if number == 0 else a_few(hypothesis, model.members)
                jobs += [(hypothesis, level, hypothesis.nominal) for level in levels]
        if what == "library":
            for hypothesis, values in model.members:
                jobs += both_ways(hypothesis, values, self._thresholds.farther)
        days = self._effort.bank
        directions: list[Direction] = []
        numbers = list(model.days)[:days]
        models = [merged(model.members, ((h, level),)) for h, level, _ in jobs]
        with self._reporter.task(f"round {number + 1}: {what}", len(jobs)) as advance:
            prepared = [(effects_of(members), numbers) for members in models]
            self._fitter.engine.prepare(prepared, advance)
        self.examined |= {hypothesis.name for hypothesis, _, _ in jobs}
        for (hypothesis, level, origin), members in zip(jobs, models, strict=True):
            try:
                difference, variance = self._fitter.difference(model, members, days)
            except (SimulatorError, OptionError, ScenarioError) as error:
                # the effect is impossible there, for example because the lane is too short to park
                if what == "library":
                    self._reporter.say(f"note: {hypothesis.name} left out: {error}")
                continue
            directions.append(Direction(hypothesis, level, difference, variance, origin))
        self._of_round.setdefault(number, []).extend(directions)
        return directions

    def _simulated(self, model: Fitted, chosen: Sequence[Members], title: str) -> list[Fitted]:
        """Simulate sets of effects on top of a model."""
        models_tried: list[Fitted] = []
        with self._reporter.task(title, len(chosen)) as advance:
            for new in chosen:
                members = merged(model.members, new)
                if members:
                    try:
                        models_tried.append(self.kept(self._fitter.simulate(members)))
                    except (SimulatorError, OptionError, ScenarioError) as error:
                        self._reporter.say(f"note: {title_of(members)} left out: {error}")
                advance(note=title_of(members))
        return models_tried

    def _refined(
        self,
        models: Sequence[Fitted],
        before: Fitted,
        cost_before: float,
        directions: Sequence[Direction],
    ) -> list[Fitted]:
        """Fit the most promising models, the best single effect, and all exchanges.

        An exchange may cost more than the model before until its values are fitted.

        Args:
            models: Simulated models.
            before: The model before.
            cost_before: Its cost, from as many days as candidates have.
            directions: Changes by single effects on top of the model before.

        Returns:
            The best of them, and those that more steps of their fits may put before it.
        """
        ranked, count = sorted(models, key=cost_of), self._thresholds.candidates_fitted
        simple = next((model for model in ranked[count:] if len(model.members) == 1), None)
        ranked = ranked[:count] + [
            model for model in ranked[count:] if model is simple or _is_exchange(model, before)
        ]
        fitted: list[Fitted] = []
        share, rivals = self._thresholds.candidate_gain_share, self._thresholds.rival_share
        least = cost_before
        with self._reporter.task("fitting", len(ranked)) as advance:
            for model in ranked:
                enough = cost_before - model.cost > share * (cost_before - least)
                if not fitted or enough or _is_exchange(model, before):
                    fitted.append(self.kept(self._fitter.fitted(model, directions)))
                    least = min(fitted, key=cost_of).cost
                advance(note=title_of(model.members))
        most = min(rivals * least, cost_before - share * (cost_before - least))
        fitted.sort(key=cost_of)
        return fitted[:1] + [one for one in fitted[1:] if one.cost <= most]

    def kept(self, model: Fitted) -> Fitted:
        """Keep a model for the list of rivals if it is the best one of its effects; return it."""
        key = str(sorted(str(hypothesis.key) for hypothesis, _ in model.members))
        if key not in self._seen or model.cost < self._seen[key].cost:
            self._seen[key] = model
        return model


def _is_exchange(model: Fitted, before: Fitted) -> bool:
    """Return True if a model has an effect that another one lacks, and as many as it at most."""
    new, old = keys_of(model.members), keys_of(before.members)
    return len(new) <= len(old) and not new <= old
