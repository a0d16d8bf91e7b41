"""The field loop: a policy drives the lights of a real street, behind checks that keep it safe.

- `site`: the intersections, and the observation that the policy needs.
- `street`: the interface of a street, and a running SUMO in its place.
- `watchdog`: checks of the counts.
- `safety`: signal machines, the fixed-time plan, and the trust in the policy.
- `lights`: all lights of a street, with a check of what they show.
- `answering`: calls of the policy with a deadline.
- `decisions`: decisions and their log.
- `loop`: the loop and its summary.
- `health`: the state of the loop, for others.
- `service`: the loop as a service, which looks for a street that is gone.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
