"""The commands of ``ugat-marl``: each a dataclass whose fields are its options."""
