"""Studies of the suite itself, run in a checkout: `bench`, `blind` and `behaviour_digests`."""
