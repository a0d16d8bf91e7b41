"""Studies of the suite itself, run in a checkout: `studies.bench` and `studies.blind`."""
