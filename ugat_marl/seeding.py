"""Seeds derived from seeds: the same path of numbers gives the same stream.

No generator state is saved. A resumed run derives the stream of "iteration 3, episode 2" again.
"""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


def derive_seed(seed: int, *path: int | str) -> int:
    """Return a 31-bit seed, independent for every `path` below the same root `seed`.

    Numbers count modulo 2^32, the root modulo 2^64, and a text of one letter as the letter's code:
    a part that is a number at one call should not be a text at another.
    """
    root = operator.index(seed)  # of NumPy's integers, which may be too narrow
    words = [root & 0xFFFFFFFF, (root >> 32) & 0xFFFFFFFF]
    for part in path:
        words.extend(
            part.encode() if isinstance(part, str) else [operator.index(part) & 0xFFFFFFFF]
        )
        words.append(0xFFFFFFFF)  # ends a part, so that ("ab", "c") and ("a", "bc") differ
    return int(np.random.SeedSequence(words).generate_state(1, np.uint32)[0] >> 1)


def numpy_generator(seed: int, *path: int | str) -> np.random.Generator:
    """Return a numpy generator for the stream `path` below `seed`."""
    return np.random.default_rng(derive_seed(seed, *path))


def torch_generator(seed: int, *path: int | str) -> torch.Generator:
    """Return a torch CPU generator for the stream `path` below `seed`."""
    import torch  # imported late: most processes that need a seed need no torch

    return torch.Generator().manual_seed(derive_seed(seed, *path))
