"""The field loop: a policy at a real street, behind what keeps it safe."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
