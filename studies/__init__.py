"""Studies of the suite itself, run in a checkout.

These are `bench`, `blind`, `behaviour_digests` and `osm_extracts`.
"""
