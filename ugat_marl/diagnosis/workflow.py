"""The diagnosis from data to a corrected scenario.

Stages: check the detectors, locate, propose, fit, select, verify, correct.

Every simulated day is kept in a cache. An interrupted diagnosis continues from there, and another
diagnosis of the same scenario under the same signals needs few simulations.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ugat_marl.data import MeasuredData, installed_versions
from ugat_marl.diagnosis.detection_limits import detection_limits
from ugat_marl.diagnosis.engine import OutOfTime
from ugat_marl.diagnosis.hypotheses import WINDOW, Members, keys_of
from ugat_marl.diagnosis.locate import disagreements, locate_gap
from ugat_marl.diagnosis.patterns import unnamed_effects
from ugat_marl.diagnosis.places import Routes
from ugat_marl.diagnosis.records import (
    CORRECTED,
    FILE,
    SCHEMA,
    Alternative,
    Conclusion,
    Diagnosis,
    Explanation,
    FitEvidence,
    Fitted,
    HeldOut,
    Located,
    LogGrounds,
    NamedEffect,
    PolicyGap,
    SearchGrounds,
    Selected,
    Splits,
    Tables,
    Tested,
    TrafficCheck,
    Verdict,
    Verified,
)
from ugat_marl.diagnosis.select import Selector
from ugat_marl.diagnosis.signal_timing import IN_THE_LOG, timing_effects
from ugat_marl.diagnosis.statistics import of_the_same_stretches
from ugat_marl.diagnosis.study import DiagnosisConfig, Study
from ugat_marl.diagnosis.traffic import traffic_check
from ugat_marl.diagnosis.verdict import (
    capitalised,
    conclude,
    describe_errors,
    describe_pattern,
    effect_record,
    parameter,
    unchallenged,
    unverified,
)
from ugat_marl.diagnosis.verify import judged, tables_of, verify_model
from ugat_marl.effects import Effect, apply_effects
from ugat_marl.errors import OutputError
from ugat_marl.files import put_folder, require_writable
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario

ALTERNATIVES = 12
"""Most other sets of effects that ``diagnosis.json`` lists."""


def diagnose(
    scenario: Scenario,
    measured: MeasuredData,
    directory: str | Path,
    config: DiagnosisConfig | None = None,
    reporter: Reporter | None = None,
) -> Diagnosis:
    """Find where scenario and data disagree, name the missing effects, and add them.

    Args:
        scenario: The scenario to correct.
        measured: The measured data; see `ugat_marl.data.measured.reading.read_measured`.
        directory: Folder for ``diagnosis.json`` and the corrected scenario ``corrected``.
        config: Options such as budget, level of the tests and seed; None for the defaults.
        reporter: Display of progress; None for no display.

    Returns:
        The content of ``diagnosis.json``; docs/reference/diagnosis-file.md explains every key. The
        policy gap of an earlier diagnosis in `directory` is kept if its inputs, versions and
        effects were the same.

    Raises:
        MeasuredDataError: The data hold nothing to compare.
        OutputError: The scenario is the corrected one in `directory`, which would be replaced; the
            folder of that name there holds something else; or `directory` cannot be written to.
    """
    directory = Path(directory)
    _require_replaceable(scenario, directory / CORRECTED)
    require_writable(directory / FILE)
    config = config or DiagnosisConfig()
    reporter = reporter or Silent()
    study = Study.of(scenario, measured, config)
    for finding in study.measured.findings:
        reporter.say(f"note: {finding.text}")
    if config.unnamed and not study.shows_patterns:
        reporter.say(
            "note: no unnamed correction will be tried; it needs detections of single vehicles, of "
            "periods at one time of day"
        )
    read = timing_effects(scenario, study.network, measured, config.thresholds)
    timing = tuple(effect for effect in read if effect.name not in config.leave_out)
    with reporter.whole("diagnosis", study.work()):
        diagnosis, errors, effects = _diagnosed(study, timing, reporter)
    traffic = _corrections(diagnosis, errors, (*timing, *effects))
    corrected = None if traffic is None else apply_effects(scenario, traffic)
    if corrected is not None:
        diagnosis = replace(diagnosis, corrected=CORRECTED)
    written = Diagnosis.from_json(diagnosis.to_json())  # numbers rounded like those of the file
    written = replace(written, policy_gap=_known_gap(directory, written))
    _write(written, corrected, directory, reporter)
    return written


def _require_replaceable(scenario: Scenario, place: Path) -> None:
    """Refuse a folder for the corrected scenario that may not be replaced.

    Args:
        scenario: The scenario that is read.
        place: The folder.

    Raises:
        OutputError: The scenario lies in it, or it is no scenario.
    """
    folder = place.resolve()
    paths = [document.path for document in scenario.documents if document.path is not None]
    if any(folder in path.resolve().parents for path in paths):
        raise OutputError(
            f"{place}: holds the scenario itself, and the corrected one would replace it; give "
            "another directory"
        )
    if place.exists() and not (place / "scenario.toml").is_file():
        raise OutputError(
            f"{place}: is no scenario, and the corrected one would replace it; move it away, or "
            "give another directory"
        )
    if any(inside.is_dir() for inside in place.glob("*")):
        raise OutputError(
            f"{place}: holds folders, and the corrected scenario would replace them; move them "
            "away, or give another directory"
        )


def _write(
    written: Diagnosis, corrected: Scenario | None, directory: Path, reporter: Reporter
) -> None:
    """Write the record and the corrected scenario; those of an earlier diagnosis stay until then.

    Args:
        written: The record.
        corrected: The scenario; None for no correction.
        directory: Folder of both.
        reporter: Told if an earlier scenario goes and none takes its place.
    """
    place = directory / CORRECTED
    made, before = (place.with_name(f".{place.name}.{word}") for word in ("new", "before"))
    for rest in (made, before):  # of a diagnosis that was killed here
        shutil.rmtree(rest, ignore_errors=True)
    if corrected is not None:
        corrected.write(made)
    # If it is killed here, no earlier verdict may stay beside another corrected scenario.
    (directory / FILE).unlink(missing_ok=True)
    if corrected is not None:
        put_folder(made, place, before)
        shutil.rmtree(before, ignore_errors=True)
    elif (place / "scenario.toml").is_file():
        shutil.rmtree(place)
        reporter.say(
            f"note: {place} of an earlier diagnosis is removed, since the scenario is not "
            "corrected by what is found now"
        )
    written.write(directory)


def _diagnosed(
    study: Study, timing: tuple[Effect, ...], reporter: Reporter
) -> tuple[Diagnosis, tuple[Effect, ...], tuple[Effect, ...]]:
    """Run all stages.

    Returns:
        The record, the errors of measurement, and the effects of the corrected scenario besides
        these and those of the signal log.
    """
    try:
        study = study.detectors_as_they_are(reporter)
        base = study.base(reporter)
        study = study.with_empty_start_finding(base, reporter)
        study = study.with_findings_on_travel_times(base, reporter)
    except OutOfTime:
        return _nothing_simulated(study, timing), study.errors_of_detectors, ()
    search = _searched(study, base, reporter)
    diagnosis, effects = _concluded(search, timing, reporter)
    if study.config.limits and diagnosis.verdict in ("no_discrepancy", "explained"):
        diagnosis = _with_limits(search, diagnosis, reporter)
    return diagnosis, search.study.errors_of_detectors, effects


def _with_limits(search: _Search, diagnosis: Diagnosis, reporter: Reporter) -> Diagnosis:
    """Add the detection limits of the effects that a verdict does not name.

    Where the signal log or the detectors alone explain the data, those that the search has found
    are not named, and limits are those of the scenario as it is.
    """
    named, tested = {effect.name for effect in diagnosis.effects}, search.located.base
    if search.selected is not None:
        best = search.selected.best
        tested = best if {h.name for h, _ in best.model.members} <= named else tested
    limits = detection_limits(search.study, search.selector, tested, reporter)
    return replace(diagnosis, limits=limits)


@dataclass(frozen=True, eq=False)
class _Search:
    """A search for effects.

    Attributes:
        study: The study, with the errors of detectors that all of its days have.
        located: The scenario as it is, and where the data contradict it.
        selector: What searched.
        selected: What it found; None if the scenario as it is could have made the data.
    """

    study: Study
    located: Located
    selector: Selector
    selected: Selected | None


def _searched(
    study: Study,
    base: Tested,
    reporter: Reporter,
    known: Members = (),
    *,
    once_more: bool = True,
) -> _Search:
    """Search for effects, and once more if those found show other errors of the detectors.

    Args:
        study: The study.
        base: The scenario as it is.
        reporter: Display of progress.
        known: Effects that an earlier search has found, to begin with.
        once_more: False to take the errors of the detectors as they are.
    """
    selector = study.selector(base, reporter)
    located = locate_gap(study, base, selector)
    if located.base.residual.p > study.config.alpha:
        return _Search(study, located, selector, None)
    others: list[tuple[Study, Tested]] = []

    def shows_others(best: Tested) -> bool:
        """Return True if the effects show other errors, with which the data are nearer."""
        other = study.detectors_beside(best.model.effects, reporter)
        if other is None:
            return False
        its_base = other.base(reporter)
        cost, its_cost = (
            one.fitter(start).simulate(best.model.members).cost
            for one, start in ((study, base), (other, its_base))
        )
        if cost - its_cost > study.config.thresholds.price:
            others.append((other, its_base))
        return bool(others)

    selected = selector.select(located, known, shows_others if once_more else None)
    for other, its_base in others:
        errors = describe_errors(other.detection) if other.detection else "no detector errs"
        reporter.say(f"note: beside the effects so far {errors}; the search begins again")
        members = selected.best.model.members
        return _searched(other, its_base, reporter, members, once_more=False)
    return _Search(study, located, selector, selected)


def _corrections(
    diagnosis: Diagnosis, errors: Sequence[Effect], effects: Sequence[Effect]
) -> list[Effect] | None:
    """Return the effects of the corrected scenario; None if there is no such scenario.

    Errors of this street's detectors are no part of the model of its traffic. The scenario as it is
    counts as corrected if nothing but these is wrong, but not before a search has found that.

    Args:
        diagnosis: The record.
        errors: Errors of measurement.
        effects: Effects that the signal log or a search has found, faults of detectors among them.
    """
    traffic = [effect for effect in effects if not effect.on_detectors]
    if diagnosis.verdict == "unknown" or diagnosis.not_corrected is not None:
        return traffic or None
    told = effects if diagnosis.verdict == "provisional" else (*errors, *effects)
    return traffic if told else None


def _concluded(
    search: _Search, timing: tuple[Effect, ...], reporter: Reporter
) -> tuple[Diagnosis, tuple[Effect, ...]]:
    """Verify what a search found, and conclude.

    Returns:
        The record, and the effects of the corrected scenario besides those of the signal log and
        of the detectors; none if it is not corrected.
    """
    study, located, selected = search.study, search.located, search.selected
    if selected is None:
        verified = verify_model(study, located.base, located.base)
        conclusion = unchallenged(study, located, verified, timing)
        return _record(study, timing, located, None, verified, conclusion), ()

    def told(conclusion: Conclusion) -> Conclusion:
        """Say first what is wrong with the detectors."""
        if not study.detection or conclusion.verdict == "no_discrepancy":
            return conclusion
        errors = capitalised(describe_errors(study.detection))
        return replace(conclusion, sentence=f"{errors}. {conclusion.sentence}")

    try:
        verified = verify_model(study, located.base, selected.best)
        conclusion = told(
            conclude(
                located,
                selected,
                search.selector,
                verified,
                study.config,
                study.layout,
                held_out=bool(study.measured.of("heldout")),
            )
        )
        if conclusion.verdict == "no_discrepancy":
            verified = Verified(verified.before, verified.before, None, 0.0)
            conclusion = _beside_the_log(study, located, verified, conclusion, timing)
        diagnosis = _record(study, timing, located, selected, verified, conclusion)
    except OutOfTime:
        selected = replace(selected, complete=False)
        verified = verify_model(study, located.base, located.base)
        conclusion = told(unverified(selected))
        diagnosis = _record(study, timing, located, selected, verified, conclusion, tested=False)
    diagnosis = _with_patterns(study, diagnosis, located.base, conclusion, reporter)
    try:
        unnamed = _unnamed(study, diagnosis, located.base, conclusion, reporter)
    except OutOfTime:
        unnamed = None
        ended = "The budget ended before the unnamed correction was tried."
        diagnosis = replace(diagnosis, sentence=f"{diagnosis.sentence} {ended}")
    if unnamed is not None:
        return unnamed
    if conclusion.verdict == "unknown" or not conclusion.best.model.members:
        return diagnosis, ()
    check = judged(study, located.base, conclusion.best)
    judged_by = "held-out" if study.measured.of("heldout") else "fitted"
    reason = None if study.config.correct_anyway else _reason_against(conclusion, check, judged_by)
    diagnosis = replace(diagnosis, traffic_check=check, not_corrected=reason)
    return diagnosis, () if reason else conclusion.best.model.effects


def _explained_by(base: Tested, conclusion: Conclusion) -> Tested:
    """Return the selected model if its effects are named, else the scenario as it is."""
    return conclusion.best if conclusion.verdict == "partially_explained" else base


def _unnamed(
    study: Study, diagnosis: Diagnosis, base: Tested, conclusion: Conclusion, reporter: Reporter
) -> tuple[Diagnosis, tuple[Effect, ...]] | None:
    """Try a correction that imitates the patterns in what is left.

    Returns:
        The record and all effects of the corrected scenario; None if it was not asked for, if no
        pattern can be imitated, or if held-out traffic comes no nearer.

    Raises:
        OutOfTime: The budget ended.
    """
    if not study.config.unnamed or not diagnosis.patterns:
        return None
    named = _explained_by(base, conclusion).model.effects
    decision_s = study.scenario.control.decision_interval_s
    origins = Routes.of(study.scenario).origins
    effects = unnamed_effects(diagnosis.patterns, study.layout, origins, decision_s)
    if not effects:
        return None
    wanted = study.engine.first(study.config.thresholds.settling_days)
    numbers = [number for number in wanted if number in base.model.days]
    with reporter.task("unnamed correction", len(numbers)) as advance:
        days = study.engine.ordinary((*named, *effects), numbers, advance)
    both = ([base.model.days[number] for number in days], [day.tally for day in days.values()])
    before, after = (of_the_same_stretches(side, study.heldout) for side in both)
    check = traffic_check(study.heldout, before, after, study.config.thresholds)
    if check is None or not check.better:
        return None
    source = "imitates patterns in what is left, whatever their cause"
    records = tuple(_without_search(effect, source) for effect in effects)
    told = "The corrected scenario has an unnamed correction, which says nothing of the cause."
    sentence = f"{diagnosis.sentence} {told}"
    return replace(diagnosis, sentence=sentence, traffic_check=check, unnamed=records), (
        *named,
        *effects,
    )


def _with_patterns(
    study: Study, diagnosis: Diagnosis, base: Tested, conclusion: Conclusion, reporter: Reporter
) -> Diagnosis:
    """Add patterns in what is left, if the search has ended and does not explain the data."""
    if conclusion.verdict not in ("unknown", "partially_explained"):
        return diagnosis
    try:
        patterns = study.left_over(_explained_by(base, conclusion), reporter)
    except OutOfTime:
        told = "The budget ended before patterns in what is left were looked for."
        return replace(diagnosis, sentence=f"{diagnosis.sentence} {told}")
    if not patterns:
        return diagnosis
    told = f"What is left shows most in this: {describe_pattern(patterns[0])}."
    return replace(diagnosis, patterns=patterns, sentence=f"{diagnosis.sentence} {told}")


def _reason_against(
    conclusion: Conclusion, check: TrafficCheck | None, judged_by: str = "held-out"
) -> str | None:
    """Return why the effects of a conclusion are not put into the scenario; None if they are.

    Args:
        conclusion: The conclusion.
        check: Comparison of traffic before and after.
        judged_by: Kind of the periods of that comparison, "held-out" or "fitted".
    """
    if conclusion.verdict == "partially_explained":
        return (
            "Something besides the effects named may be behind the difference, so the scenario is "
            "not corrected by them."
        )
    if check is None or check.better:
        return None
    if check.undecided:
        does = (
            f"bring {check.measure} nearer to the {judged_by} periods, by no more than chance could"
        )
        way_out = "; more or longer periods can tell"
    else:
        does = f"do not bring {check.measure} near to the {judged_by} periods"
        way_out = ""
    return (
        f"The effects named {does}: the sum of relative errors{check.days_in_words} is "
        f"{100 * check.error_before:.1f} % before and {100 * check.error_after:.1f} % after "
        f"(standard error of the difference: {100 * check.noise:.1f} %). So the scenario is not "
        f"corrected by them{way_out}."
    )


def _beside_the_log(
    study: Study,
    located: Located,
    verified: Verified,
    conclusion: Conclusion,
    timing: tuple[Effect, ...],
) -> Conclusion:
    """Add effects that need no search to a conclusion that names no effects."""
    if not timing and not study.detection:
        return conclusion
    alone = unchallenged(study, located, verified, timing)
    sentence = f"{alone.sentence} {conclusion.sentence}"
    return replace(conclusion, verdict=alone.verdict, sentence=sentence)


# --- the record ---------------------------------------------------------------------------------


def _record(
    study: Study,
    timing: tuple[Effect, ...],
    located: Located,
    selected: Selected | None,
    verified: Verified,
    conclusion: Conclusion,
    *,
    tested: bool = True,
) -> Diagnosis:
    """Make the record from the results of all stages.

    It has neither tables nor chances of a model that was not `tested`, since the budget ended.
    """
    base, best = located.base, conclusion.best
    complete = located.complete if selected is None else selected.complete
    examined = located.examined if selected is None else selected.examined
    sides = tables_of(study, base, best) if tested else Tables()
    named = (
        ()
        if selected is None or conclusion.verdict == "unknown"
        else _named(best, selected, study.config.thresholds.half_interval)
    )
    searched = _unsearched(
        study, timing, conclusion.verdict, conclusion.sentence, None if complete else examined
    )
    heldout, evidence = HeldOut.of(verified), FitEvidence(base.residual.p, best.residual.p)
    if best.model.members and not tested:
        heldout = replace(heldout, after=None, p_after=None)
        evidence = replace(evidence, p_fit_after=None)
    return replace(
        searched,
        effects=(*named, *searched.effects),
        where=located.disagreements,
        left=disagreements(study, best) if best.model.members else (),
        alternatives=() if selected is None else _alternatives(conclusion, selected),
        best=_explanation(best.model) if best.model.members else None,
        heldout=heldout,
        evidence=evidence,
        statistics=sides.statistics,
        lanes=sides.lanes,
        criteria=sides.criteria,
        travel_time=sides.travel_time,
        approaches=sides.approaches,
        next_measurement=conclusion.next_measurement,
    )


def _nothing_simulated(study: Study, timing: tuple[Effect, ...]) -> Diagnosis:
    """Make the record for a budget that ended before the scenario as it is was simulated."""
    known, wanted = study.engine.known_base_days, study.effort.base
    there = (
        f"{known} of {wanted} simulated days of the scenario as it is are there"
        if known < wanted
        else "simulated days with other vehicles, by which they are judged, are missing"
    )
    sentence = (
        f"The budget ended before anything could be compared: {there}. Run the same command again "
        "to go on, or give a larger budget."
    )
    return _unsearched(study, timing, "provisional", sentence, ())


def _unsearched(
    study: Study,
    timing: tuple[Effect, ...],
    verdict: Verdict,
    sentence: str,
    examined: Collection[str] | None,
) -> Diagnosis:
    """Make a record of everything that needs no simulation.

    Args:
        study: The inputs of the diagnosis.
        timing: Effects that are read off the signal log.
        verdict: The verdict.
        sentence: The verdict as a sentence.
        examined: Names of effects examined before the budget ended; None if it did not end.
    """
    measured = study.measured
    # Effects of the signal log need no search, so they are never untried.
    left = () if examined is None else study.allowed.difference(examined, IN_THE_LOG)
    return Diagnosis(
        schema=SCHEMA,
        scenario=study.scenario.id,
        seed=study.config.seed,
        alpha=study.config.alpha,
        budget_h=study.config.budget_h,
        budget_s=study.config.budget_s,
        left_out=tuple(sorted(study.config.leave_out)),
        ruled_out=tuple(sorted(study.ruled_out)),
        findings=tuple(finding.text for finding in measured.findings),
        periods=Splits(
            tuple(period.id for period in measured.of("fit")),
            tuple(period.id for period in measured.of("heldout")),
        ),
        verified_on_fitted_periods=not measured.of("heldout"),
        hashes={"scenario": study.scenario.hash, "measured": study.data_hash},
        versions=installed_versions("ugat-marl", "eclipse-sumo"),
        verdict=verdict,
        sentence=sentence,
        effects=(
            *(_without_search(effect, "signal log") for effect in timing),
            *(
                _without_search(
                    error.effect, "detections of single vehicles", error.margin, error.rival
                )
                for error in study.detection
            ),
        ),
        where=(),
        left=(),
        alternatives=(),
        best=None,
        heldout=None,
        evidence=None,
        statistics=(),
        lanes=(),
        criteria=None,
        travel_time=None,
        approaches=(),
        traffic_check=None,
        patterns=(),
        unnamed=(),
        next_measurement=None,
        complete=examined is None,
        untried=tuple(sorted(left)),
        corrected=None,
        not_corrected=None,
        ended_by=None if examined is None else study.engine.budget.ended,
    )


def _named(best: Tested, selected: Selected, half_interval: float) -> tuple[NamedEffect, ...]:
    """Return records of the effects of the selected model, with intervals and grounds.

    The grounds are the model's distance, and the cost by which the best model with other effects,
    or with the same ones elsewhere, is worse. `half_interval` is half the width of a 95 % interval
    in standard errors.
    """
    grounds = SearchGrounds(best.model.distance.total, selected.runner_up_is_worse_by)
    effects: list[NamedEffect] = []
    for place, (hypothesis, values) in enumerate(best.model.members):
        errors = best.errors_of(place)
        known = bool(np.isfinite(errors).all())
        margins = tuple(half_interval * float(error) for error in errors) if known else None
        effect = effect_record(hypothesis, values, margins)
        effects.append(NamedEffect(**vars(effect), evidence=grounds))
    return tuple(effects)


def _without_search(
    effect: Effect, source: str, margin: float | None = None, rival: Effect | None = None
) -> NamedEffect:
    """Return the record of an effect that the search did not fit.

    Args:
        effect: The effect.
        source: What it was read off.
        margin: Half the width of the 95 % interval of its number; None without an interval.
        rival: Another effect that looks the same in the data.
    """
    values = effect.record()
    name = str(values.pop("name"))
    texts = [str(values[key]) for key in effect.texts]
    numbers = {key: float(values[key]) for key in effect.ranges}
    window = None
    if all(key in numbers for key in WINDOW):
        begin_s, end_s = (numbers.pop(key) for key in WINDOW)
        window = (begin_s, end_s)
    parameters = {
        key: parameter(value, margin, effect.ranges[key]) for key, value in numbers.items()
    }
    grounds = LogGrounds(source, None if rival is None else str(rival))
    return NamedEffect(name, ">".join(texts) or None, window, parameters, grounds)


def _alternatives(conclusion: Conclusion, selected: Selected) -> tuple[Alternative, ...]:
    """Return the models besides the selected one; models that fit equally well come first."""
    # A set of effects may be simulated several times, with other values and more days.
    told = [keys_of(model.members) for model in (conclusion.best.model, *conclusion.indistinct)]
    others = [rival for rival in selected.rivals if keys_of(rival.members) not in told]
    ranking = [(model, True) for model in conclusion.indistinct]
    ranking += [(model, False) for model in others]
    return tuple(
        Alternative(**vars(_explanation(model)), indistinct=indistinct)
        for model, indistinct in ranking[:ALTERNATIVES]
    )


def _explanation(model: Fitted) -> Explanation:
    effects = tuple(effect_record(hypothesis, values) for hypothesis, values in model.members)
    return Explanation(effects, model.distance.total, model.cost)


def _known_gap(directory: Path, diagnosis: Diagnosis) -> dict[str, PolicyGap] | None:
    """Return the policy gap of an earlier record, if that still holds; else None.

    `ugat-marl policy-gap` measured it by simulations. It holds as long as scenario, data, versions
    and the corrected scenario are the same.
    """
    try:
        earlier = Diagnosis.read(directory)
    except ValueError:
        return None  # no file, or no diagnosis of this version
    return earlier.policy_gap if _gap_inputs(earlier) == _gap_inputs(diagnosis) else None


def _gap_inputs(diagnosis: Diagnosis) -> tuple[object, ...]:
    """Return everything that the policy gap depends on."""
    return (
        diagnosis.hashes,
        diagnosis.versions,
        diagnosis.corrected,
        diagnosis.not_corrected is None,
        _values(diagnosis.effects),
        _values(diagnosis.unnamed),
    )


def _values(effects: Sequence[NamedEffect]) -> list[object]:
    """Return the effects without intervals and grounds, since these change no simulation."""
    return [
        (
            effect.name,
            effect.place,
            effect.window,
            {name: parameter.value for name, parameter in effect.parameters.items()},
        )
        for effect in effects
    ]
