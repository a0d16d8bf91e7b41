"""Command line: one file per command, with a dataclass whose fields are the options."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
