"""Tables of control delay and level of service, approach by approach."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rich.console import Group, RenderableType
from rich.text import Text

from ugat_marl.data import level_of_service, mean_delay_s
from ugat_marl.experiments import Evaluation
from ugat_marl.reporting.formats import fixed, number_text
from ugat_marl.reporting.light_names import LIGHT_HEADING, LightNames
from ugat_marl.reporting.page import Grid
from ugat_marl.reporting.terminal import in_tables, named_table
from ugat_marl.scenarios import Network, named_approaches

MOST_APPROACHES = 8
"""Most approaches in a table of the terminal."""
MOST_CONTROLLERS = 3
"""Most controllers side by side in a table of the terminal: more leave names no room."""
MOST_DOMAINS = 6
"""Most domains side by side, for the same reason."""
LEGEND = (
    "Mean control delay in s: what all vehicles on an approach lose, those that still wait at the "
    "end included, per vehicle that passed the light. Level of service of the Highway Capacity "
    "Manual: A to 10 s, B to 20, C to 35, D to 55, E to 80, F above. Vehicles that wait outside "
    "the network do not count, nor do approaches that nobody passed."
)
_PASSED = "veh: vehicles that passed the light, fewest and most of the policies."

Delays = Mapping[str, tuple[float, float]]
"""Approach to the number of vehicles that passed and their mean control delay, s."""


NOBODY = "none passed"
"""Cell of an approach at which vehicles waited and none passed."""
EMPTY = "none came"
"""Cell of an approach that no vehicle came to."""


def approach_text(vehicles: float, delay_s: float) -> str:
    """Return delay and level of service of an approach, or that nobody passed or came."""
    if vehicles:
        return delay_text(delay_s)
    return EMPTY if math.isnan(delay_s) else NOBODY


def delay_text(delay_s: float) -> str:
    """Return a control delay in s with its level of service, as in ``38.2 D``.

    Where rounding would pass the limit of the level, there are more decimals, as in ``10.04 B``.
    """
    level, text = level_of_service(delay_s), number_text(delay_s)
    for decimals in range(2, 17):
        if not level or level_of_service(float(text)) == level:
            break
        text = fixed(delay_s, decimals)
    return f"{text} {level}".strip()


def service_tables(evaluation: Evaluation, network: Network) -> list[RenderableType]:
    """Return the level of service of each policy, and that of the worst approaches.

    Args:
        evaluation: Episodes with `Scores.approaches`; without, the list is empty.
        network: The network.
    """
    measured = {
        (policy, domain): found
        for domain in evaluation.domains
        for policy in evaluation.policies
        if (found := evaluation.approaches(policy, domain))
    }
    if not measured:
        return []
    tables: list[RenderableType] = []
    for domains in in_tables(evaluation.domains, MOST_DOMAINS):
        table = named_table(
            f"{evaluation.scenario}: control delay and level of service (HCM)", "policy"
        )
        for domain in domains:
            table.add_column(domain, justify="right", overflow="fold")
        for policy in evaluation.policies:
            own = [measured.get((policy, domain), {}) for domain in domains]
            table.add_row(Text(policy), *(delay_text(mean_delay_s(d.values())) for d in own))
            worst = [max(delays.values(), key=_badness, default=None) for delays in own]
            cells = ["-" if at is None else approach_text(*at) for at in worst]
            table.add_row(*(Text(text, style="dim") for text in ("  worst approach", *cells)))
        tables.append(table)
    last = evaluation.domains[-1]
    delays = {policy: measured.get((policy, last), {}) for policy in evaluation.policies}
    by_approach = control_delay_table(f"The same by approach, in {last}", delays, network)
    return [Group(*tables, by_approach)]


def control_delay_table(
    title: str, delays: Mapping[str, Delays], network: Network
) -> RenderableType:
    """Return delay and level of service of the worst approaches under several controllers.

    Args:
        title: Title of the table.
        delays: Delays by controller; the first one decides which approaches are the worst. Three
            controllers stand side by side, more beneath each other.
        network: The network.
    """
    names, lights = named_approaches(network), LightNames.of(network)
    roads = _worst_first(delays)
    shown = roads[:MOST_APPROACHES]
    more = f", the worst {len(shown)} of {len(roads)}" if len(roads) > len(shown) else ""
    tables: list[RenderableType] = []
    for controllers in in_tables([*delays], MOST_CONTROLLERS):
        part = {controller: delays[controller] for controller in controllers}
        table = named_table(f"{title}{more}", LIGHT_HEADING, "approach", "road")
        table.add_column("veh", justify="right")
        for controller in part:
            lines = controller.replace(":", ":\n", 1)
            table.add_column(lines, justify="right", overflow="fold")
        for road in shown:
            named = names.get(road)
            light, approach = (lights.text(named.light), named.name) if named else ("", "")
            passed = [own.get(road) for own in part.values()]
            counts = [round(own[road][0]) for own in delays.values() if road in own]
            least, most = min(counts), max(counts)
            count = f"{least}" if least == most else f"{least}-{most}"
            cells = ["-" if at is None else approach_text(*at) for at in passed]
            table.add_row(Text(light), Text(approach), Text(road), count, *cells)
        tables.append(table)
    return Group(*tables, Text(f"{LEGEND} {_PASSED}", style="dim"))


def service_grid(
    evaluation: Evaluation, policies: Sequence[str], network: Network | None
) -> Grid | None:
    """Return delay and level of service of all approaches in the last domain; None without any.

    Args:
        evaluation: The episodes.
        policies: Policies to show.
        network: The network; None shows approaches by their road alone.
    """
    names = {} if network is None else named_approaches(network)
    lights = LightNames() if network is None else LightNames.of(network)
    domain = evaluation.domains[-1]
    delays = {policy: evaluation.approaches(policy, domain) for policy in policies}
    rows: list[list[str]] = []
    for road in _worst_first(delays):
        named = names.get(road)
        cells = [approach_text(*own[road]) if road in own else "–" for own in delays.values()]
        texts = (lights.whole(named.light), named.name) if named else ("", "")
        rows.append([*texts, road, *cells])
    headings = [f"{policy}, s per vehicle" for policy in delays]
    return Grid(["intersection", "approach", "road", *headings], rows, headings) if rows else None


def _worst_first(delays: Mapping[str, Delays]) -> list[str]:
    roads = dict.fromkeys(road for own in delays.values() for road in own)
    first = next(iter(delays.values()), {})
    return sorted(roads, key=lambda road: -_badness(first.get(road, (1.0, 0.0))))


def _badness(approach: tuple[float, float]) -> float:
    """Return the delay of an approach; below 0 if nobody came."""
    delay_s = approach[1]
    return -1.0 if math.isnan(delay_s) else delay_s
