"""Simulation: SUMO in this process or in a separate process, and its measurements.

Only this room imports libsumo. A simulator advances by some seconds under planned signal states and
returns a `Snapshot`. At the end of an episode it returns `Trips`.

- `launch`: what SUMO is told at the start; the interface of all simulators.
- `simulator`: SUMO in this process.
- `mesoscopic`: lane measurements in SUMO's mesoscopic model.
- `process`: SUMO in a separate process.
- `host`: start and end of processes, for `process` and for vectors of environments.
- `worker`: the program of these processes.
- `channel`: messages to and from a worker.
- `snapshots`, `trips`, `detectors`, `point_to_point`, `lane_states`, `upstream`, `approach_delays`:
  measurements; `blockers`: vehicles that they leave out.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
