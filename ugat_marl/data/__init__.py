"""Data: values that are recorded and kept in files. Nothing here computes statistics over runs.

- `transitions`: the log of transitions of roll-outs, one row per episode, step and agent.
- `layouts`: layout of observations.
- `measured`: measured data of a street, their readers (CSV, Parquet, ATSPM) and their writer.
- `runs`: the folder of a training run; `curves`: its numbers for TensorBoard.
- `checkpoints`: dictionaries of tensors.
- `row_hashes`: hashes of the rows of tables, which tell damaged ones.
- `scores`: the measures of an episode.
- `level_of_service`: the levels A to F of traffic engineers.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
