"""Measured data of a street.

- `values`: the data in memory.
- `tables`: the files and their columns, checked while they are read.
- `reading`: reader of a directory, which returns `values.MeasuredData`.
- `passages`: passages of vehicles from on and off events.
- `local_time`: local times as seconds of the scenario's clock.
- `intervals`: counts, occupancies and mean speeds of intervals.
- `tracks`: passages over detectors from positions of single vehicles.
- `lanes`: traffic of lanes from positions of single vehicles.
- `coverage`: findings on missing data.
- `writing`: writer of a directory.
- `atspm`, `atspm_mapping`: import of logs of signal controllers.
"""
