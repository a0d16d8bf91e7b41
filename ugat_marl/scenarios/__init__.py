"""Scenarios: road network, demand, timing and signal rules, and the sources they are made from.

A scenario is a directory with `scenario.toml` and SUMO files. This room reads, validates and hashes
it, and knows its static network: lanes, links, phases, detectors. Nothing here runs a simulation.
`importers` makes scenarios from grids, OpenStreetMap, SUMO, CityFlow and counts.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
