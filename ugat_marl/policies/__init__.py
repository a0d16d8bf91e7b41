"""Policies choose green phases; learners improve them.

`rules` holds controllers that follow a rule. `learners` holds the algorithms that improve a policy.
`networks` holds their neural networks. `export` writes trained policies to files that other
programs read without this package; `portable` holds networks in a form that needs no torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
