"""Scenarios: road network, demand, timing and signal rules, and the importers that make them.

A scenario is a directory with `scenario.toml` and SUMO files. This room reads it, validates it and
hashes it. It also derives the static network. Nothing here runs a simulation of traffic.

- `scenario`, `settings`: the directory and its ``scenario.toml``.
- `network`, `lanes`, `junctions`, `phases`, `naming`: the static network.
- `street_names`: names of streets, approaches, turns and intersections.
- `signal_plans`: fixed-time plans in rings and barriers, and their tables.
- `signals`: signal timing as pure functions.
- `demand`, `routes`, `days`: checks of route files, routes of vehicles, other days of a demand.
- `speed_factors`: distributions of desired speeds in vehicle types.
- `periods`: detectors, and the recordings of detectors and signals.
- `inspection`: facts about a scenario.
- `capacity`: demand as a share of capacity.
- `sumo_tools`: SUMO's programs and tools.
- `admission`, `confinement`: limits of what a scenario's files may say, and of what the processes
  of SUMO may read and write.
- `importers`: scenarios from a seed, grids, OpenStreetMap, SUMO, CityFlow and counts.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
