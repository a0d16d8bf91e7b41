"""Grounding: actions of the simulation that do what the policy's action does in reality.

A transform holds forward model f, inverse model h and gate. `ugat` is Algorithm 1 of the UGAT
paper. The modules, from data to the algorithm:

- `stacked`, `view`: transitions of unequal intersections as tensors; inputs from neighbours.
- `networks`, `forward`, `inverse`, `uncertainty`: the models; methods for the uncertainty of h.
- `fitting`, `reports`: training of the models; their errors on held-out data.
- `gate`: choice between the grounded action and the policy's action, by u and alpha.
- `transform`: base of all groundings; `phase` (another phase, with `joint` for neighbours) and
  `timed` (a delayed green, by the estimates of `delays`).
- `trust`, `residual`: where f is better than a fitted street; f and h on top of one.
- `wrappers`: the grounded environment; greens with random delays.
- `worlds`, `controls`: sources of D_sim and D_real; negative controls.
- `detected`, `measured_log`: vehicles on lanes from detections; measured data as a log.
- `oversaturation`: decisions of a log at which lanes are full.
- `channel`, `eyes`, `summaries`, `regression`, `presence`, `posterior`: commands, detectors and
  worlds of a street, fitted from its log; `street` puts them together and draws the world of each
  episode.
- `config`, `state`, `algorithm`: settings, checkpoint, plain training.
- `ugat`, `street_training`: Algorithm 1; training in a fitted street, and its `rival`, which
  trains with late greens.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
