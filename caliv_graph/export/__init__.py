"""Calibrations in the formats of other programs: one file per consumer in `consumers`.

`consumers.export` makes an export; `request` has its input and output.
"""
