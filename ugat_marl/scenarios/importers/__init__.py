"""Importers: scenario directories from other road networks and demand.

- `making`: a scenario directory from a source of roads and a source of vehicles.
- Sources of roads: `plan` (grids, arterials), `osm` with `osm_crossings`, `sumo_files`,
  `cityflow` with `cityflow_roadnet`.
- Sources of vehicles: `turning_shares`, `counts`, `sumo_files`, `cityflow`.
- `count_sheet`: sheets of turning counts, to fill in and to show their fit.
- `utdf`: fixed-time plans from Synchro's files.
- Sources of both: `drawn`, from a seed.
- `streets`: the roads for cars in a network.
- `long_files`: files read piece by piece.
"""
