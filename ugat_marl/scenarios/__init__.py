"""Scenarios: road network, demand, timing and signal rules, and the sources they are made from.

A scenario is a directory with `scenario.toml` and SUMO files. This room reads, validates and hashes
it, and knows its static network. Nothing here runs a simulation of traffic.

- `scenario`, `settings`: the directory and its ``scenario.toml``.
- `network`, `lanes`, `junctions`, `phases`, `naming`: the static network.
- `signals`: signal timing as pure functions.
- `demand`, `routes`, `days`: route files, vehicles with their routes, other days of a demand.
- `periods`: detectors and what they and the signals recorded.
- `inspection`: facts about a scenario; `programs`: SUMO's programs.
- `importers`: scenarios from grids, OpenStreetMap, SUMO, CityFlow and counts.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
