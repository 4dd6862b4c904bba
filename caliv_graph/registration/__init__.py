"""Joint registration of the target's clouds.

`register`: the loop, and the state that `calibration` steps through with the graph in it.
`mixture`: seed, E-step, M-step of the components. `moments`: weighted sums over points.
`quadratic`: the M-step of the poses, as a quadratic. `clouds`: the stacked points and their
normals. `symmetry`, with `self_comparison`: rotations that the target's shape does not determine.
"""
