"""Networks that map observations to values of actions, for all intersections at once.

`batched` holds perceptrons. `frap` and `colight` hold networks from the literature,
`universal` one whose weights move between road networks. `structure` holds the facts about
intersections that these three need. `q_network` builds a network by its name.
"""
