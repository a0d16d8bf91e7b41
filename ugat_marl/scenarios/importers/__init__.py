"""Importers: road networks and demand from anywhere, made into scenario directories.

- `making`: a scenario directory from a source of roads and one of vehicles.
- Roads: `plan` (grids, arterials), `osm` with `osm_crossings`, `sumo_files`, `cityflow`.
- Vehicles: `turning_shares`, `counts`, `sumo_files`, `cityflow`.
- `streets`: where cars may drive; `long_files`: files read piece by piece.
"""
