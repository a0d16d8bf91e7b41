"""Demand from turning shares: random arrivals and random turns.

Arrivals at each entry are a Poisson process. At each junction a vehicle draws its turn from the
shares, until it leaves the network. A route that would pass a junction twice is drawn again,
but at an entry from which no other one was found.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.files import read_xml, replacing
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.importers.making import ROUTES, VehicleFiles, VehicleSource
from ugat_marl.scenarios.importers.streets import Streets
from ugat_marl.seeding import numpy_generator

CAR = {
    "id": "car", "vClass": "passenger", "length": "5.0", "minGap": "2.5", "accel": "2.6",
    "decel": "4.5", "emergencyDecel": "9.0", "startupDelay": "0.0", "sigma": "0.5", "tau": "1.0",
    "maxSpeed": "55.55", "speedFactor": "normc(1,0.1,0.2,2)",
}  # fmt: skip
"""Attributes of SUMO's default passenger car, written out."""

MOST_VEHICLES = 5_000_000
"""Most vehicles of a scenario."""
_TRIES = 200
"""Number of routes drawn for a vehicle before it is left out."""


@dataclass(frozen=True, slots=True)
class Drive:
    """One vehicle.

    Attributes:
        id: Name of the vehicle.
        depart_s: Time of its departure.
        route: Roads of its route.
        type: Vehicle type, or empty for SUMO's default.
        speed: Speed at departure: m/s, or ``max``.
    """

    id: str
    depart_s: float
    route: tuple[str, ...]
    type: str = "car"
    speed: str = "max"


def walked(
    streets: Streets, vph: float, shares: tuple[float, float, float], length_s: float, seed: int
) -> list[Drive]:
    """Draw vehicles at every entry of a network.

    Args:
        streets: Roads of the network.
        vph: Vehicles per hour at each entry.
        shares: Shares of left turns, straight on and right turns. If a turn is not possible, the
            others keep their proportion.
        length_s: Time in which vehicles enter.
        seed: Seed of all draws.

    Returns:
        The vehicles, sorted by departure.

    Raises:
        OptionError: The shares or the rate are impossible.
        ScenarioError: No road leads into the network, no vehicle enters, or no route to an exit was
            found.
    """
    if not (math.isfinite(vph) and 0 < vph <= 1e5):
        raise OptionError(
            f"--vph {vph:g} is not a number of vehicles an hour; give one above 0, up to 100000"
        )
    if min(shares) < 0 or not math.isfinite(sum(shares)) or sum(shares) <= 0:
        raise OptionError(
            f"--turns {shares}: three shares, none negative and not all 0, are needed"
        )
    if not streets.entries:
        raise ScenarioError(
            "no road leads into the network from outside, so there is nowhere to let vehicles in; "
            "give routes (--routes) or origins and destinations (--od)"
        )
    if vph / 3600 * length_s * len(streets.entries) > MOST_VEHICLES:
        raise OptionError(
            f"--vph {vph:g} at {len(streets.entries)} entries for {length_s:g} s makes more than "
            f"{MOST_VEHICLES} vehicles; lower --vph or --duration-s"
        )
    left, straight, right = shares
    table = {"l": left, "s": straight, "r": right}
    drives: list[Drive] = []
    due = 0
    for entry in streets.entries:
        for again in (False, True):  # some roads lead out only past a junction twice
            random = numpy_generator(seed, "entry", entry)
            moments = poisson_arrivals(random, vph / 3600, length_s)
            own = [
                Drive(f"{entry}_{number}", round(moment, 2), route)
                for number, moment in enumerate(moments)
                if (route := _walk(streets, entry, table, random, again=again))
            ]
            if own:
                break
        drives += own
        due += len(moments)
    if not due:
        raise ScenarioError(
            f"nobody enters within {length_s:g} s at {vph:g} vehicles an hour; raise --vph or "
            "--duration-s"
        )
    if not drives:
        raise ScenarioError(
            "no way from an entry of the network to one of its exits was found at random; give "
            "routes (--routes) or origins and destinations (--od)"
        )
    return sorted(drives, key=lambda drive: (drive.depart_s, drive.id))


def _walk(
    streets: Streets,
    entry: str,
    shares: Mapping[str, float],
    random: np.random.Generator,
    *,
    again: bool,
) -> tuple[str, ...]:
    """Draw a route from an entry to an exit; empty if none was found.

    Args:
        streets: Roads of the network.
        entry: First road.
        shares: Share of each turn.
        random: Source of the draws.
        again: True if it may pass a junction twice, but no road.
    """

    def place(road: str) -> str:
        return road if again else streets.end[road]

    for _ in range(_TRIES):
        road, route, passed = entry, [entry], set[str]() if again else {streets.start[entry]}
        while road not in streets.exits and place(road) not in passed:
            passed.add(place(road))
            turns = streets.ahead.get(road, {})
            possible = {turn: shares[turn] for turn in turns if shares.get(turn, 0) > 0}
            possible = possible or {turn: 1.0 for turn in turns if turn != "t"}
            if not possible:
                break
            roads = turns[weighted_choice(possible, random)]
            road = weighted_choice(dict.fromkeys(roads, 1.0), random)
            route.append(road)
        if road in streets.exits and place(road) not in passed:
            return tuple(route)
    return ()


def poisson_arrivals(
    random: np.random.Generator, rate_per_s: float, length_s: float
) -> list[float]:
    """Draw the times of Poisson arrivals in [0, length_s), s."""
    times: list[float] = []
    moment = 0.0
    while rate_per_s > 0:
        moment -= math.log(1.0 - float(random.random())) / rate_per_s
        if moment >= length_s:
            break
        times.append(moment)
    return times


def weighted_choice(shares: Mapping[str, float], random: np.random.Generator) -> str:
    """Draw a key of `shares` with probability proportional to its value."""
    mark = float(random.random()) * sum(shares.values())
    for name, share in shares.items():
        mark -= share
        if mark < 0:
            return name
    return next(reversed(list(shares)))


def write_drives(
    path: Path, drives: Iterable[Drive], types: Iterable[Mapping[str, str]] = (CAR,)
) -> None:
    """Write vehicles as a route file.

    Args:
        path: The file.
        drives: The vehicles, sorted by departure.
        types: Attributes of their vehicle types.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in _route_file(drives, types))


def _route_file(drives: Iterable[Drive], types: Iterable[Mapping[str, str]]) -> Iterator[str]:
    yield "<?xml version='1.0' encoding='UTF-8'?>"
    yield "<routes>"
    for kind in types:
        yield f"    <vType{_attributes(kind)}/>"
    for drive in drives:
        head = {"id": drive.id, "depart": f"{drive.depart_s:.2f}"}
        if drive.type:
            head["type"] = drive.type
        head |= {"departLane": "best", "departSpeed": drive.speed}
        edges = quoteattr(" ".join(drive.route))
        yield f"    <vehicle{_attributes(head)}><route edges={edges}/></vehicle>"
    yield "</routes>"


def _attributes(values: Mapping[str, str]) -> str:
    return "".join(f" {key}={quoteattr(value)}" for key, value in values.items())


def from_turning_shares(
    vph: float, shares: tuple[float, float, float], begin_s: float, length_s: float, seed: int
) -> VehicleSource:
    """Return a source of vehicles that `walked` draws by turning shares, from `begin_s` on."""

    def vehicles(folder: Path, network: Path, reporter: Reporter) -> VehicleFiles:
        streets = Streets.of(read_xml(network))
        drives = walked(streets, vph, shares, length_s, seed)
        later = (replace(drive, depart_s=begin_s + drive.depart_s) for drive in drives)
        write_drives(folder / ROUTES, later)
        return VehicleFiles((ROUTES,))

    return vehicles
