"""Finding the target, its points and the ground in the scans.

`search`: the target's place, where the config has none. `cloud`: its points in each scan.
`ground`: the ground in each scan.
"""

from caliv_graph.targets.cloud.extract import extract_targets

__all__ = ["extract_targets"]
