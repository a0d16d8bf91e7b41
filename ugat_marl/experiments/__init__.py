"""Experiments: settings x domains x seeds, trained, judged and compared with intervals.

A `Setting` says how a policy is made and what its row is called. A `Job` is a setting with a
scenario, a domain and a training seed, in a folder of its own. The driver performs jobs in
processes or on Ray and takes interrupted ones up again. `train`, the tables of the UGAT paper,
the learning curves of the learners and ``studies.bench strength`` are lists of settings.

- `settings`, `jobs`, `driver`, `training`: a setting, a job, many jobs, one training.
- `transfers`, `paper`, `learning_curves`, `baseline`: what is trained for each command.
- `evaluation`, `scores`, `comparison`, `statistics`, `gaps`: policies played, and what follows.
- `tuning`, `headroom`, `trial`: rules tuned, and scenarios tried out with them.
- `recording`, `queues`, `policy_gaps`, `randomised`, `machine`: measured data, halting vehicles,
  the worth of a diagnosis, worlds drawn at random, facts of the machine.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
