"""What calibrations are good for together: factors for localisers, comparing and merging them.

`priors`, `factors` and `archive` hand a calibration to a GTSAM localiser; `terms`, `compare` and
`merge` work on what the data of each drive say, so that a shared guess is never counted twice.
"""
