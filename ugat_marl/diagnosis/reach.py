"""Whether vehicles of the scenario come where vehicles were measured; nothing is simulated."""

from __future__ import annotations

from collections.abc import Sequence

from ugat_marl.data import Finding, Measured
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import Detector, Scenario, driven_routes, edge_of

_NAMED = 6


def unreached(
    scenario: Scenario, measured: Measured, detectors: Sequence[Detector]
) -> tuple[Finding, ...]:
    """A finding on edges where detectors counted vehicles, and which no route leads over.

    Args:
        scenario: The scenario as it is.
        measured: The data.
        detectors: Those that are compared.

    Raises:
        MeasuredDataError: No route leads over any of the measured edges.
    """
    edges = {item.id: edge_of(item.lane) for item in detectors}
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
