"""Detectors that are compared with the simulation, and findings on the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import polars as pl

from ugat_marl.data import Finding, MeasuredData
from ugat_marl.diagnosis.intervals import without_gaps
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.errors import MeasuredDataError, counted
from ugat_marl.scenarios import Detector, Scenario, driven_routes, edge_of_lane

_NAMED = 6
"""Largest number of edges that a message names."""


def compared_detectors(
    scenario: Scenario, measured: MeasuredData, thresholds: Thresholds
) -> tuple[tuple[Detector, ...], tuple[Finding, ...]]:
    """Return the detectors to compare, and findings on the others and on their roads."""
    detectors = one_of_each(measured, detectors_to_compare(measured))
    findings = (
        *duplicate_detector_findings(measured, detectors),
        *unreached_edge_findings(scenario, measured, detectors),
        *missing_interval_findings(measured, detectors, thresholds),
    )
    return detectors, findings


def detectors_to_compare(measured: MeasuredData) -> tuple[Detector, ...]:
    """Return the detectors to compare.

    If at least half of the detectors never saw a vehicle, they count as missing from the recording,
    and only the others are compared. Otherwise a silent detector counted zero vehicles.
    """
    if not measured.has_events:
        return measured.detectors
    seen = {
        x for period in measured.periods for x, passages in period.passages.items() if len(passages)
    }
    detectors = tuple(detector for detector in measured.detectors if detector.id in seen)
    return (
        detectors
        if detectors and 2 * len(detectors) <= len(measured.detectors)
        else measured.detectors
    )


def one_of_each(measured: MeasuredData, detectors: Sequence[Detector]) -> tuple[Detector, ...]:
    """Return detectors of which no two of a kind lie on one lane, so that no vehicle counts twice.

    Those that saw vehicles in most periods, or in most intervals of counts, are kept; of equals the
    first.
    """
    if measured.has_events or measured.counts is None:
        rows = Counter(name for period in measured.periods for name in period.passages)
    else:
        rows = Counter(measured.counts.filter(pl.col("count") > 0)["detector_id"].to_list())
    taken: set[tuple[str, str]] = set()
    kept: set[str] = set()
    for detector in sorted(detectors, key=lambda one: -rows[one.id]):
        if taken.isdisjoint(places := _places(detector)):
            taken |= places
            kept.add(detector.id)
    return tuple(detector for detector in detectors if detector.id in kept)


def _places(detector: Detector) -> set[tuple[str, str]]:
    """Return lane and kind of a detector, for each lane that it lies on."""
    return {(lane, detector.kind) for lane in detector.lanes}


def duplicate_detector_findings(
    measured: MeasuredData, compared: Sequence[Detector]
) -> tuple[Finding, ...]:
    """Return a finding on each detector that is not compared beside another of its kind."""
    used = {place: detector.id for detector in compared for place in _places(detector)}
    findings: list[Finding] = []
    for detector in measured.detectors:
        others = [place for place in sorted(_places(detector)) if place in used]
        if others and used[others[0]] != detector.id:
            lane, kind = others[0]
            findings.append(
                Finding(
                    f"detectors.csv: {detector.id!r} is not compared; lane {lane!r} has "
                    f"{used[lane, kind]!r} as {kind} detector already"
                )
            )
    return tuple(findings)


def missing_interval_findings(
    measured: MeasuredData, compared: Sequence[Detector], thresholds: Thresholds
) -> tuple[Finding, ...]:
    """Return a finding on the detectors whose counts lack intervals."""
    if measured.has_events or measured.counts is None:
        return ()
    whole = without_gaps(measured.counts, measured.periods, thresholds)
    others = {detector.id for detector in compared} - whole
    if not others:
        return ()
    return (
        Finding(
            f"counts.csv: intervals are missing at {len(others)} of "
            f"{counted(len(compared), 'detector')} ({_few(others)}); there only times are compared "
            "that half of the periods have, and no means. Fill the gaps, or leave the periods with "
            "gaps out"
        ),
    )


def unreached_edge_findings(
    scenario: Scenario, measured: MeasuredData, detectors: Sequence[Detector]
) -> tuple[Finding, ...]:
    """Return a finding on edges where detectors counted vehicles but no route of the demand leads.

    Args:
        scenario: The scenario as it is.
        measured: The measured data.
        detectors: Detectors that are compared.

    Raises:
        MeasuredDataError: No route leads over any of the measured edges.
    """
    edges = {detector.id: edge_of_lane(detector.lane) for detector in detectors}
    counted: dict[str, int] = {}
    for period in measured.periods:
        for name, passages in period.passages.items():
            if name in edges and len(passages):
                counted[edges[name]] = counted.get(edges[name], 0) + len(passages)
    if not measured.has_events and measured.counts is not None:
        for name, count in measured.counts.select("detector_id", "count").iter_rows():
            if name in edges and count:
                counted[edges[name]] = counted.get(edges[name], 0) + int(count)
    left = set(edges.values())
    for way in driven_routes(scenario):
        left.difference_update(way)
        if not left:
            return ()
    if left == set(edges.values()):
        raise MeasuredDataError(
            f"scenario {scenario.id!r}: no vehicle of its demand comes over a measured edge "
            f"({_few(left)}); check lane_id in detectors.csv, and the demand of the scenario"
        )
    missed = {edge for edge in left if counted.get(edge)}
    if not missed:
        return ()
    vehicles = sum(counted[edge] for edge in missed)
    return (
        Finding(
            f"scenario {scenario.id!r}: no vehicle of its demand comes over {_few(missed)}, where "
            f"detectors counted {vehicles}; demand that is not there is no effect of the library, "
            "so add it to the scenario first"
        ),
    )


def _few(edges: set[str]) -> str:
    named = sorted(edges)
    return ", ".join(named[:_NAMED]) + (" ..." if len(named) > _NAMED else "")
