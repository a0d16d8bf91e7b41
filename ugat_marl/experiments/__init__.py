"""Experiments: settings x domains x seeds, trained, judged and compared with intervals.

A `Setting` says how a policy is made and names its row in a table. A `Job` adds a scenario, a
domain, a training seed and a folder. The driver performs jobs in processes or on Ray, and resumes
interrupted ones. `train`, the tables of the UGAT paper, the learning curves of the learners and
``studies.bench strength`` are lists of settings.

- `functions`: `train` and `evaluate` for scripts and notebooks.
- `settings`, `jobs`, `driver`, `forked`, `training`: a setting, a job, many jobs, jobs in forked
  processes, one training.
- `plans`: the plan of a run and its expected work; `packing`: trained policies with their cards.
- `transfers`, `paper`, `learning_curves`, `baseline`: the trainings of each command.
- `evaluation`, `scores`, `comparison`, `standings`, `statistics`, `gap_costs`: episodes of
  policies, their scores and intervals.
- `tuning`, `transfer_headroom`, `scenario_check`: the tuning of rules, and the check of scenarios
  with them.
- `sim_check`, `transfer_outcome`: is a policy trained; what did grounding change?
- `recording`: measured data of a domain.
- `training_curves`: means of what trainings log.
- `queues`: halting vehicles per intersection and minute.
- `typical_plans`: the behaviour of a policy as a fixed-time plan.
- `policy_gaps`: travel times before and after a diagnosis.
- `randomised`: worlds drawn at random.
- `machine`: facts of the machine.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
