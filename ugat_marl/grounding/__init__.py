"""Grounding: actions of the simulation that do what the policy's action does in reality.

Forward model f, inverse model h, uncertainty and gate make up a transform; `ugat` is Algorithm 1 of
the UGAT paper. From data to the algorithm:

- `stacked`, `view`: transitions of unequal intersections as tensors; what models see of neighbours.
- `networks`, `forward`, `inverse`, `uncertainty`: the models, and methods by which h is unsure.
- `fitting`, `reports`: training of the models, and what it was worth.
- `gate`: the grounded action or the policy's own, by u and alpha.
- `transform`: base of all groundings; `phase` (another phase, with `joint` for neighbours) and
  `timed` (a delayed green, by the estimates of `delays`).
- `wrappers`: the grounded environment, and greens late by chance.
- `worlds`, `controls`: sources of D_sim and D_real, and negative controls.
- `config`, `state`, `ugat`: settings, checkpoint, Algorithm 1.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
