"""Measured data of a street.

- `values`: the data in memory; `tables`: the files and their columns, read without trust.
- `reading`: a directory becomes `values.Measured`; `passages`: on and off become vehicles.
- `coverage`: findings on what is missing; `writing`: the way back.
- `atspm`, `atspm_mapping`: logs of signal controllers.
"""
