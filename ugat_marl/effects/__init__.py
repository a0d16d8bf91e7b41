"""Effects: named physical values that turn a scenario into another scenario.

Effects make the real domain different from the simulation. A diagnosis names effects, and a
corrected scenario contains them.

- `base`: base of all effects; `table`: all effects by name.
- `domains`: named lists of effects, with V1 to V4 of the UGAT paper.
- `vehicles`, `fleet`, `demand`, `turning`, `roads`, `signals`, `engine`: effects on the simulation.
- `detectors`: effects on the reports of detectors; `detection`: where detectors really lie, and
  what they report of each vehicle.
- `sensors`, `actuators`, `objectives`: effects on controllers, made of the parts in `controllers`.
- `service`: an effect on the green of single lanes.
- `documents`, `places`: edits of SUMO's files, and the places of a network.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
