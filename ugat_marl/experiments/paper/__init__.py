"""The paper's tables, and those it lacks: many trainings, resumable, beside each other."""
