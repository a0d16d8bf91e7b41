"""Simulation: SUMO in this process or in a process of its own, and what is measured in it.

The only room that imports libsumo. A simulator advances by some seconds with one signal state per
second and returns a `Snapshot`; at the end of an episode it returns `Trips`.

`simulator` runs SUMO in this process, with `mesoscopic` for SUMO's queue model; `process` runs it
in another one. `host` starts and ends processes for `process` and for vectors of environments,
`worker` is what runs in them, `channel` the line between the two. `snapshots`, `trips` and
`detectors` hold what is measured.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
