"""Learners: algorithms that improve a policy by acting in an environment."""

from ugat_marl.learners.dqn import DQN, DQNConfig
from ugat_marl.learners.dqn_policy import DQNPolicy

__all__ = ["DQN", "DQNConfig", "DQNPolicy"]
