"""Networks that map observations to values of actions, for all intersections at once.

`batched` holds perceptrons. `frap` and `colight` hold networks from the literature. `structure`
holds the facts about intersections that these two need. `q_network` builds a network by its name.
"""
