"""``ugat-marl scenario new``: make a scenario from a road network and demand."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import (
    given_words,
    option_text,
    refuse_options,
    require_numbers,
    unused,
)
from ugat_marl.errors import OptionError, counted
from ugat_marl.progress import Bars
from ugat_marl.reporting import LIGHT_HEADING, LightNames, plot_network, titled_table
from ugat_marl.scenarios import (
    ControlSettings,
    CountFit,
    RoadSource,
    VehicleSource,
    arterial_roads,
    drawn_sources,
    episode_of,
    from_cityflow,
    from_counts,
    from_od,
    from_osm,
    from_routes,
    from_sumo,
    from_turning_shares,
    grid_roads,
    is_configuration,
    make_draft,
    make_scenario,
)

ROADS = ("grid", "arterial", "osm", "sumo", "cityflow", "draw")
DEMANDS = ("routes", "vph", "counts", "od")
MOST_COUNTS = 8
"""Largest number of counts that are shown; the file has them all."""
_ONLY_FOR = {
    ("spacing_m", "speed_mps"): ("grid", "arterial"),
    ("guess_signals", "left_hand"): ("osm",),
    ("exact_drivers",): ("cityflow",),
    ("link",): ("sumo", "routes"),
    ("turns",): ("vph",),
    ("seed",): ("vph", "counts", "od"),
}
"""Options that only some sources of roads or vehicles use."""
_OWN = Annotated[float | None, arg(metavar="FLOAT", help_behavior_hint="(default: the source's)")]


@dataclass(frozen=True)
class ScenarioNew:
    """Make a scenario directory: roads with demand, ready for all other commands.

    Name a source of roads and one of vehicles; --draw stands for both.

    Examples:
        ugat-marl scenario new my-grid --grid 4x4 --vph 400
        ugat-marl scenario new drawn --draw 7
        ugat-marl scenario new my-city --sumo city.net.xml --routes cars.rou.xml
        ugat-marl scenario new my-city --sumo city.sumocfg
        ugat-marl scenario new my-city --osm city.osm.pbf --vph 300
        ugat-marl scenario new my-city --osm city.osm.pbf
        ugat-marl scenario new my-town --osm town.osm --counts my-town/counts.csv
        ugat-marl scenario new my-city --cityflow roadnet.json flow.json

    Attributes:
        name: Directory to write; its last part is the scenario's name.
        grid: Rows and columns of a grid, as in 4x4.
        arterial: Intersections along a main road.
        osm: File of OpenStreetMap: .osm, .osm.gz, or .osm.pbf (needs the extra osm).
        guess_signals: Put lights at large junctions of --osm that have none.
        left_hand: Traffic of --osm keeps to the left.
        sumo: SUMO configuration (with its vehicles) or network.
        cityflow: CityFlow's roadnet.json and flow.json (with its vehicles).
        draw: Seed from which roads, phases, timing and vehicles are drawn, at 0.3 to 1.1 of
            capacity.
        exact_drivers: Keep CityFlow's headways, and drive without randomness. Without this option,
            vehicles keep size, accelerations and speed, and follow each other as SUMO's do.
        routes: Route files for the network.
        vph: Vehicles an hour at every road into the network.
        turns: Shares of left turns, straight on and right turns, for --vph.
        counts: CSV file of counts: edge,count or from,to,count; also begin_s,end_s or begin,end.
            Rows with a blank count are left out. Without any vehicles, counts.csv is written as a
            sheet to fill in, with a row for every turn at a light and its streets.
        od: CSV file of origins and destinations: from,to,count; also begin_s,end_s or begin,end.
        seed: Seed of the vehicles of --vph, --counts and --od.
        spacing_m: Distance between intersections of a grid or arterial, m.
        speed_mps: Speed limit of a grid or arterial, m/s.
        phases: Green phases: as the source gives them; those of the programme; derived from the
            conflicts; derived with permitted left turns.
        begin_s: Start of an episode on the clock of the routes, s after midnight: 25200 is 7:00.
        duration_s: Length of an episode, s.
        link: Leave the files of --sumo and --routes where they are.
        force: Replace a scenario of this name.
    """

    name: Annotated[Positional[Path], arg(metavar="NAME")]
    grid: Annotated[str | None, unused("RxC")] = None
    arterial: Annotated[int | None, unused("N")] = None
    osm: Annotated[Path | None, unused("FILE")] = None
    guess_signals: bool = False
    left_hand: bool = False
    sumo: Annotated[Path | None, unused("FILE")] = None
    cityflow: Annotated[tuple[Path, Path] | None, unused("ROADNET FLOW")] = None
    draw: Annotated[int | None, unused("SEED")] = None
    exact_drivers: bool = False
    routes: Annotated[tuple[Path, ...], unused("FILE [FILE ...]")] = ()
    vph: Annotated[float | None, unused("N")] = None
    turns: tuple[float, float, float] = (0.2, 0.65, 0.15)
    counts: Annotated[Path | None, unused("FILE")] = None
    od: Annotated[Path | None, unused("FILE")] = None
    seed: int = 0
    spacing_m: float = 300.0
    speed_mps: float = 13.9
    phases: Literal["source", "programme", "conflict-free", "permitted"] = "source"
    begin_s: _OWN = None
    duration_s: _OWN = None
    link: bool = False
    force: bool = False

    def run(self, console: Console) -> int:
        """Make the scenario and print its facts."""
        require_numbers(0, draw=self.draw, seed=self.seed)
        for name, value in (("begin_s", self.begin_s), ("duration_s", self.duration_s)):
            if value is not None and not 0 <= value < math.inf:
                raise OptionError(
                    f"{option_text(name)} {value}: give a finite number of seconds, 0 or more"
                )
        decision_s = ControlSettings().decision_interval_s
        if self.duration_s is not None and self.duration_s < decision_s:
            raise OptionError(
                f"--duration-s {self.duration_s:g}: an episode has one decision at least, of "
                f"{decision_s:g} s"
            )
        roads, vehicles = self._sources()
        if vehicles is None and not self._brings_vehicles():
            return self._draft(roads, console)
        made = make_scenario(
            self.name,
            roads,
            vehicles,
            settings=self._settings(),
            command=self._command(),
            force=self.force,
            reporter=Bars(console),
            draw=plot_network,
        )
        agents = len(made.network.intersections)
        phases = sum(len(light.phases) for light in made.network.intersections)
        console.print(
            f"{self.name}: {counted(agents, 'intersection')} with {phases} green phases, "
            f"{counted(made.demand.vehicles, 'vehicle')}"
            + (f" and {counted(made.demand.flows, 'flow')}" if made.demand.flows else ""),
            soft_wrap=True,
        )
        if made.fits:
            console.print(_fit_table(made.fits, LightNames.of(made.network)))
        for note in made.notes:
            console.print(f"note: {note}", soft_wrap=True)
        where = shlex.quote(str(self.name))
        console.print(f"next: ugat-marl scenario check {where}", soft_wrap=True)
        return 0

    def _draft(self, roads: RoadSource, console: Console) -> int:
        """Make a folder with roads, drawn lights and a sheet of counts."""
        reporter = Bars(console)
        draft = make_draft(
            self.name,
            roads,
            settings=self._settings(),
            command=self._command(),
            force=self.force,
            draw=plot_network,
            reporter=reporter,
        )
        sheet = shlex.quote(str(draft.sheet))
        lights = counted(len(draft.network.intersections), "intersection")
        for text in (
            f"{self.name}: roads with {lights}, no vehicles yet",
            *(f"note: {note}" for note in draft.notes),
            f"fill in: {sheet}, {draft.turns} turns; {self.name}/pictures shows the lights",
            f"next: {self._command()} --counts {sheet} (or --vph N, --routes FILE, --od FILE)",
        ):
            console.print(text, soft_wrap=True)
        return 0

    def _sources(self) -> tuple[RoadSource, VehicleSource | None]:
        if self.draw is None:
            return self._roads(), self._vehicles()
        others = {field.name for field in fields(self)} - {"name", "draw", "force"}
        refuse_options(self, others, "--draw draws roads and vehicles with all their settings")
        return drawn_sources(self.draw)

    def _roads(self) -> RoadSource:
        given = [name for name in ROADS if getattr(self, name) is not None]
        if len(given) != 1:
            raise OptionError(
                f"scenario new needs one source of roads, not {len(given)}: "
                f"give one of {_listed(ROADS)}"
            )
        for names, sources in _ONLY_FOR.items():
            if not set(sources) & {*given, *self._demands()}:
                refuse_options(self, names, f"only {_listed(sources)} would use it")
        if self.grid is not None:
            return grid_roads(self.grid, self.spacing_m, self.speed_mps)
        if self.arterial is not None:
            return arterial_roads(self.arterial, self.spacing_m, self.speed_mps)
        if self.osm is not None:
            return from_osm(self.osm, guess=self.guess_signals, left_hand=self.left_hand)
        if self.cityflow is not None:
            return from_cityflow(
                *self.cityflow,
                self.begin_s or 0.0,
                self.duration_s,
                own_vehicles=not self._demands(),
                exact=self.exact_drivers,
            )
        assert self.sumo is not None
        return from_sumo(self.sumo, link=self.link, own_vehicles=not self._demands())

    def _demands(self) -> list[str]:
        return [name for name in DEMANDS if getattr(self, name) not in (None, ())]

    def _brings_vehicles(self) -> bool:
        """Return True if the source of roads has vehicles of its own."""
        return bool(self.draw is not None or self.cityflow or self._configured())

    def _configured(self) -> bool:
        """Return True if the source of roads is a SUMO configuration."""
        return self.sumo is not None and is_configuration(self.sumo)

    def _episode(self) -> tuple[float, float]:
        """Return begin and duration of the episode, s, of sources that do not bring them."""
        if self.begin_s is not None and self.duration_s is not None:
            return self.begin_s, self.duration_s
        begin_s, length_s = episode_of(self.sumo, self.begin_s)
        return begin_s, length_s if self.duration_s is None else self.duration_s

    def _vehicles(self) -> VehicleSource | None:
        given = self._demands()
        if len(given) > 1:
            raise OptionError(
                f"scenario new needs one source of vehicles, not {len(given)}: "
                f"give one of {_listed(DEMANDS)}"
            )
        if self.routes:
            return from_routes(self.routes, link=self.link)
        if not given:
            return None
        begin_s, length_s = self._episode()
        if self.vph is not None:
            return from_turning_shares(self.vph, self.turns, begin_s, length_s, self.seed)
        if self.counts is not None:
            return from_counts(self.counts, begin_s, length_s, self.seed)
        assert self.od is not None
        return from_od(self.od, begin_s, length_s, self.seed)

    def _settings(self) -> Mapping[str, Any]:
        times = {"begin_s": self.begin_s, "duration_s": self.duration_s}
        if self.begin_s is not None and self._configured():
            times["duration_s"] = self._episode()[1]
        settings: dict[str, Any] = {k: v for k, v in times.items() if v is not None}
        if self.phases != "source":
            settings["control"] = {"phases": self.phases}
        return settings

    def _command(self) -> str:
        """Return the command line that makes the same scenario again."""
        words = ["ugat-marl", "scenario", "new", str(self.name)]
        return shlex.join([*words, *given_words(self, without=("force",))])


def _fit_table(fits: Sequence[CountFit], names: LightNames) -> Table:
    """Return the counts that are met worst, with their GEH."""
    worst = sorted(fits, key=lambda fit: -fit.geh)[:MOST_COUNTS]
    table = titled_table(f"Counts and vehicles, the {len(worst)} largest GEH of {len(fits)}")
    several = len({(fit.begin_s, fit.end_s) for fit in fits}) > 1
    times = ["time, s"] * several
    for name in (LIGHT_HEADING, "from", "turn", "to", *times, "counted", "driven", "GEH"):
        right = name in ("counted", "driven", "GEH")
        table.add_column(name, justify="right" if right else "left", overflow="fold")
    for fit in worst:
        turn = fit.turn
        start = f"{turn.street or fit.roads[0]}, {turn.approach}" if turn else fit.roads[0]
        goal = (turn.to_street if turn else "") or (fit.roads[-1] if len(fit.roads) > 1 else "")
        cells = (f"{fit.counted:g}", f"{fit.driven}", f"{fit.geh:.1f}")
        light, way = (names.text(turn.light), turn.turn) if turn else ("", "")
        time = [f"{fit.begin_s:g} to {fit.end_s:g}"] * several
        table.add_row(light, start, way, goal, *time, *cells)
    return table


def _listed(names: tuple[str, ...]) -> str:
    texts = [option_text(name) for name in names]
    return " or ".join(filter(None, (", ".join(texts[:-1]), texts[-1])))
