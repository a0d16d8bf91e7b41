"""Seeds derived from seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ugat_marl.seeding import derive_seed


@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int32, np.uint32, np.int64])
def test_integers_of_numpy_give_the_seeds_of_python_s(kind: Any) -> None:
    assert derive_seed(kind(3), "episode", kind(2)) == derive_seed(3, "episode", 2)
