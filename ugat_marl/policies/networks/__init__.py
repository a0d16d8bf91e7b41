"""Networks that map observations to values of actions, for all intersections at once.

`batched` holds perceptrons, `frap` and `colight` networks from the literature, `structure` the
plain numbers about intersections that these two need, and `q_network` builds one by its name.
"""
