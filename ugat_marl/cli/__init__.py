"""Command line: one file per verb, each a dataclass whose fields are its options."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
