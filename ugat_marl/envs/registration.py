"""Names of this package's environments in Gymnasium.

``gymnasium.make("ugat_marl:ugat_marl/single-v1")`` imports `ugat_marl`, which registers the names
if Gymnasium is loaded. If `ugat_marl` was imported before Gymnasium, the first use of one of its
environments registers them. Importing `ugat_marl` does not import Gymnasium.
"""

import gymnasium

SINGLE = ("single-v1",)
"""Shipped scenarios with one intersection."""


def register_single() -> None:
    """Register the scenarios of `SINGLE` as ``ugat_marl/<scenario>``; again changes nothing."""
    for name in SINGLE:
        full = f"ugat_marl/{name}"
        if full not in gymnasium.registry:
            gymnasium.register(
                id=full, entry_point="ugat_marl.envs.single:SingleEnv", kwargs={"scenario": name}
            )
