"""Environments in the form of other libraries; each module imports one library."""
