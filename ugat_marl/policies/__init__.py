"""Policies choose green phases; learners improve them.

`rules` holds controllers that follow a rule, `learners` the algorithms that improve a policy, and
`export` writes trained policies for places where the suite is not installed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
