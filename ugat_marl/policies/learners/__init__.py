"""Learners: algorithms that improve a policy by acting in an environment."""
