"""The diagnosis from data to a corrected scenario: locate, hypothesise, fit, select, apply, verify.

Every simulated day is remembered, so that a diagnosis that was interrupted goes on where it was,
and one of the same scenario under the same signals needs few simulations.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Any

from ugat_marl.data import Measured, versions_of
from ugat_marl.diagnosis.engine import OutOfTime
from ugat_marl.diagnosis.fit import Fitted
from ugat_marl.diagnosis.locate import Disagreement, locate
from ugat_marl.diagnosis.residual import Tested
from ugat_marl.diagnosis.select import Selection, Selector
from ugat_marl.diagnosis.signal_timing import IN_THE_LOG, timing_effects
from ugat_marl.diagnosis.study import DiagnosisConfig, Study
from ugat_marl.diagnosis.verdict import Conclusion, conclude, describe_members, effect_record
from ugat_marl.diagnosis.verify import (
    Verification,
    courtesy,
    lanes_table,
    statistics_table,
    travel_times,
    verify,
)
from ugat_marl.effects import Effect, apply_effects
from ugat_marl.files import write_whole
from ugat_marl.progress import Reporter, Silent
from ugat_marl.scenarios import Scenario

__all__ = ["DiagnosisConfig", "Study", "corrected", "diagnose", "where"]

SCHEMA = "ugat-marl/diagnosis/1"
FILE, CORRECTED = "diagnosis.json", "corrected"
_ALTERNATIVES = 12


def diagnose(
    scenario: Scenario,
    measured: Measured,
    directory: Path,
    config: DiagnosisConfig | None = None,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Finds where scenario and data disagree, names the missing effects, and adds them.

    Args:
        scenario: The simulation.
        measured: The data; see `ugat_marl.data.measured.reading.read_measured`.
        directory: ``diagnosis.json`` and the scenario ``corrected`` go there.
        config: How.
        reporter: Shows progress.

    Returns:
        The content of ``diagnosis.json``; docs/explanation/diagnosis.md explains every key. The
        policy gap of an earlier diagnosis in `directory` is kept where the same was found.

    Raises:
        MeasuredDataError: The data hold nothing to compare.
    """
    config = config or DiagnosisConfig()
    reporter = reporter or Silent()
    study = Study.of(scenario, measured, config)
    for item in study.measured.findings:
        reporter.say(f"note: {item.text}")
    read = timing_effects(scenario, study.network, measured)
    timing = tuple(effect for effect in read if effect.name not in config.leave_out)
    try:
        base = study.base(reporter)
    except OutOfTime:
        record = _nothing_simulated(study, timing)
    else:
        record = _compared(study, base, timing, reporter)
    effects = record.pop("_effects")
    record |= _head(study)
    record["corrected"] = CORRECTED if effects else None
    place = directory / CORRECTED
    if (place / "scenario.toml").is_file():  # of an earlier diagnosis
        shutil.rmtree(place)
    if effects:
        corrected(scenario, effects, place)
    record = _plain(record)
    record["policy_gap"] = _known_gap(directory / FILE, record)
    text = json.dumps(record, indent=1, sort_keys=True, allow_nan=False)
    write_whole(directory / FILE, text + "\n")
    return json.loads(text)


def _compared(
    study: Study, base: Tested, timing: tuple[Effect, ...], reporter: Reporter
) -> dict[str, Any]:
    """The record, once the scenario as it is has been simulated."""
    alpha = study.config.alpha
    selector = study.selector(base, reporter)
    complete = True
    if base.residual.p > alpha:
        try:
            base = selector.looked_closer(base)
        except OutOfTime:
            complete = False
    if base.residual.p > alpha:
        record = _nothing(study, base, timing, complete)
    else:
        record = _search(study, base, selector, timing, reporter)
    left = [] if record["complete"] else _untried(study, selector.examined)
    return record | {"untried": left}


def _untried(study: Study, examined: Collection[str]) -> list[str]:
    """Effects that were not examined; those of the signal log are read off it at once."""
    return sorted(study.allowed.difference(examined, IN_THE_LOG))


def where(study: Study, model: Tested) -> list[Disagreement]:
    """Where the fitted periods disagree with a model."""
    periods = study.measured.of("fit")
    spans = {(period.begin_s, period.end_s) for period in periods}
    span = spans.pop() if len(spans) == 1 else None
    distance = model.model.reference.distance(study.fit)
    return locate(study.site, model.model.reference, distance, study.config.alpha, span)


def corrected(scenario: Scenario, effects: tuple[Effect, ...], directory: Path) -> Path:
    """Writes the scenario with the effects: a domain like any other."""
    return apply_effects(scenario, effects).write(directory)


def _nothing(
    study: Study, base: Tested, timing: tuple[Effect, ...], complete: bool
) -> dict[str, Any]:
    """The record where the scenario as it is could have made the data."""
    verification = verify(study, base, base)
    ruled = f"; {len(study.ruled_out)} effects could not be examined" if study.ruled_out else ""
    sentence = f"Nothing in the data contradicts the scenario as it is{ruled}."
    if timing:
        named = " and ".join(map(str, timing))
        sentence = f"The signal log has {named}; with that, nothing contradicts the scenario."
    if not complete:
        sentence += " The budget ended before single effects were looked for."
    return {
        "verdict": "explained" if timing else "no_discrepancy",
        "sentence": sentence,
        "effects": [_timing_record(effect) for effect in timing],
        "where": [],
        "left": [],
        "alternatives": [],
        "heldout": verification.as_dict(),
        "evidence": {"p_fit": base.residual.p, "p_fit_after": base.residual.p},
        "best": None,
        "next_measurement": None,
        "complete": complete,
        **_tables(study, base, base),
        "_effects": timing,
    }


def _nothing_simulated(study: Study, timing: tuple[Effect, ...]) -> dict[str, Any]:
    """The record of a budget that does not suffice for the scenario as it is."""
    done = study.engine.known
    return {
        "verdict": "unknown",
        "sentence": (
            f"The budget of {study.config.budget_s:g} s ended after {done} of {study.effort.base} "
            "simulated days of the scenario as it is, before anything could be compared. Run the "
            "same command again to go on, or give a larger budget."
        ),
        "effects": [_timing_record(effect) for effect in timing],
        "where": [],
        "left": [],
        "alternatives": [],
        "heldout": None,
        "evidence": {},
        "best": None,
        "next_measurement": None,
        "complete": False,
        "untried": _untried(study, ()),
        "_effects": timing,
    }


def _search(
    study: Study,
    base: Tested,
    selector: Selector,
    timing: tuple[Effect, ...],
    reporter: Reporter,
) -> dict[str, Any]:
    """The record where the scenario as it is could not have made the data."""
    located = where(study, base)
    selection = selector.select(base)
    try:
        verification = verify(study, base, selection.best)
        conclusion = conclude(
            base, selection, selector, verification, study.config.alpha, study.site
        )
        plain = conclusion.verdict == "no_discrepancy"
        tables = {} if plain else _tables(study, base, selection.best)
    except OutOfTime:
        selection = Selection(selection.best, selection.rivals, complete=False)
        verification, conclusion = _unverified(base, selection)
        tables = {}
    if conclusion.verdict == "no_discrepancy":  # its tables are those of the scenario as it is
        record = _nothing(study, base, timing, selection.complete)
        hint = f"{record['sentence']} {conclusion.sentence}" if timing else conclusion.sentence
        return record | {
            "sentence": hint,
            "where": [item.as_dict() for item in located],
            "alternatives": [_alternative(item) for item in _ranking(conclusion, selection)],
            "next_measurement": conclusion.next_measurement,
        }
    best = conclusion.best
    named = conclusion.verdict != "unknown"
    records: list[dict[str, Any]] = []
    place = 0
    for hypothesis, values in best.model.members if named else ():
        errors = tuple(float(e) for e in best.errors[place : place + len(values)])
        place += len(values)
        records.append(
            effect_record(hypothesis, values, errors) | {"evidence": _evidence(best, selection)}
        )
    records += [_timing_record(effect) for effect in timing]
    return {
        "verdict": conclusion.verdict,
        "sentence": conclusion.sentence,
        "effects": records,
        "where": [item.as_dict() for item in located],
        "left": [item.as_dict() for item in where(study, best)] if best.model.members else [],
        "alternatives": [_alternative(item) for item in _ranking(conclusion, selection)],
        "heldout": verification.as_dict(),
        "evidence": {"p_fit": base.residual.p, "p_fit_after": best.residual.p},
        "best": _alternative(best.model) if best.model.members else None,
        "next_measurement": conclusion.next_measurement,
        "complete": selection.complete,
        **tables,
        "_effects": (*timing, *best.model.effects) if named else timing,
    }


def _unverified(base: Tested, selection: Selection) -> tuple[Verification, Conclusion]:
    """What can be said when the budget ended before the model was verified."""
    verification = Verification(base.residual, base.residual, None)
    members = selection.best.model.members
    nearest = f" The nearest so far is {describe_members(members)}." if members else ""
    sentence = (
        "Simulation and measurement disagree; the budget ended before an explanation was verified."
        f"{nearest} Run the same command again to go on."
    )
    return verification, Conclusion("unknown", selection.best, (), sentence, None)


def _ranking(conclusion: Conclusion, selection: Selection) -> list[Fitted]:
    """Models beside the one selected; those that fit as well come first."""
    chosen = conclusion.best.model
    others = [
        item
        for item in selection.rivals
        if item.members != chosen.members and item not in conclusion.indistinct
    ]
    return [*conclusion.indistinct, *others][:_ALTERNATIVES]


def _alternative(model: Fitted) -> dict[str, Any]:
    effects = [effect_record(h, v, (0.0,) * len(v)) for h, v in model.members]
    for effect in effects:
        for parameter in effect["parameters"].values():
            parameter["low"] = parameter["high"] = None
    return {"effects": effects, "distance": model.distance.total, "cost": model.cost}


def _evidence(best: Tested, selection: Selection) -> dict[str, Any]:
    """How much better the model is than the best one without its effects."""
    names = {hypothesis.name for hypothesis, _ in best.model.members}
    others = [
        item.cost
        for item in selection.rivals
        if {hypothesis.name for hypothesis, _ in item.members} != names
    ]
    return {
        "distance": best.model.distance.total,
        "runner_up_is_worse_by": min(others) - best.model.cost if others else None,
    }


def _timing_record(effect: Effect) -> dict[str, Any]:
    """An effect read off the signal log, which is as certain as the log."""
    record = effect.record()
    name = record.pop("name")
    return {
        "name": name,
        "place": None,
        "window": None,
        "parameters": {
            key: {"value": value, "low": value, "high": value, "unit": effect.ranges[key].unit}
            for key, value in record.items()
        },
        "evidence": {"source": "signal log"},
    }


def _tables(study: Study, base: Tested, best: Tested) -> dict[str, Any]:
    found: dict[str, Any] = {
        "statistics": statistics_table(study, base, best),
        "lanes": lanes_table(study, base, best),
        "courtesy": courtesy(study, base, best),
    }
    found["travel_time"] = travel_times(study, best)
    return found


def _head(study: Study) -> dict[str, Any]:
    """What every diagnosis says of itself."""
    measured = study.measured
    return {
        "schema": SCHEMA,
        "scenario": study.scenario.id,
        "seed": study.config.seed,
        "alpha": study.config.alpha,
        "budget_s": study.config.budget_s,
        "left_out": sorted(study.config.leave_out),
        "ruled_out": sorted(study.ruled_out),
        "findings": [item.text for item in measured.findings],
        "periods": {split: [p.id for p in measured.of(split)] for split in ("fit", "heldout")},
        "verified_on_fitted_periods": not measured.of("heldout"),
        "policy_gap": None,
        "hashes": {"scenario": study.scenario.hash, "measured": measured.hash},
        "versions": versions_of("ugat-marl", "eclipse-sumo"),
    }


def _known_gap(file: Path, record: dict[str, Any]) -> Any:
    """The policy gap in an earlier record of the same corrected scenario, else None.

    It took the simulations of `ugat-marl policy-gap` to measure, and holds as long as scenario,
    data, versions and effects are the same.
    """
    try:
        earlier: Any = json.loads(file.read_text(encoding="utf-8"))
        same = all(earlier[key] == record[key] for key in ("schema", "hashes", "versions"))
        if same and _values(earlier) == _values(record):
            return _plain(earlier["policy_gap"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        pass  # none, or none that `diagnose` wrote
    return None


def _values(record: dict[str, Any]) -> list[Any]:
    """The effects of a record without intervals and evidence, which change no simulation."""
    return [
        [
            *(effect[key] for key in ("name", "place", "window")),
            {key: parameter["value"] for key, parameter in effect["parameters"].items()},
        ]
        for effect in record["effects"]
    ]


def _plain(value: Any) -> Any:
    """The value with numbers rounded to nine digits, and without what JSON cannot say."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool) or value is None or isinstance(value, str | int):
        return value
    number = float(value)
    return float(f"{number:.9g}") if number == number and abs(number) < 1e300 else None
