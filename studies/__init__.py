"""Studies of the suite itself, run in a checkout.

These are `bench`, `blind`, `behaviour_digests`, `detector_errors`, `detector_logs`, `osm_extracts`,
`paid_for_blocking`, `posterior_coverage`, `pretraining`, `short_zones` and `unseen`.
"""
