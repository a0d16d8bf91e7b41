"""Effects: named physical values that turn a scenario into another scenario.

The same value makes a "real" domain different from the simulation, is what a diagnosis names, and
is what repairs a model. `base` holds what every effect can do, `table` all effects by name,
`domains` named lists of effects, V1 to V4 of the UGAT paper among them. Effects on the simulation
stand in `vehicles`, `fleet`, `demand`, `turning`, `roads`, `signals` and `engine`, effects on what
detectors report in `detectors`, and effects on controllers in `sensors`, `actuators` and
`objectives`, over the parts of `controllers`. `documents` and `places` serve them all: edits of
SUMO's files, and the places of a network.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
