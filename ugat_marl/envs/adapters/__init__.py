"""Environments in the form a library wants; each module imports one library."""
