"""Many simulations in worker processes, stepped together: `vector_env`."""

from ugat_marl.envs.vector.arrays import Arrays
from ugat_marl.envs.vector.environment import Autoreset, Ended, VectorEnv, VectorStep, vector_env
from ugat_marl.envs.vector.remote import Episode
from ugat_marl.envs.vector.spec import in_turn

__all__ = [
    "Arrays",
    "Autoreset",
    "Ended",
    "Episode",
    "VectorEnv",
    "VectorStep",
    "in_turn",
    "vector_env",
]
