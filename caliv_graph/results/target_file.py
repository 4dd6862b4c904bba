"""target.ply: the reconstructed target."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caliv_graph.products import Mixture


def write_target(mixture: Mixture, path: Path, name: str) -> None:
    """Writes a reconstructed target as ASCII PLY: component means (metres) and unit normals.

    `name` of the target goes to a comment in the file.

    Raises:
        OSError: it cannot be written.
    """
    header = [
        "ply",
        "format ascii 1.0",
        f"comment {' '.join(name.split())}, in the target frame, metres",
        f"element vertex {len(mixture.means_target)}",
        *(f"property float {field}" for field in ("x", "y", "z", "nx", "ny", "nz")),
        "end_header",
    ]
    rows = np.hstack([mixture.means_target, mixture.normals_target])
    body = [" ".join(f"{value:.6f}" for value in row) for row in rows]
    path.write_text("\n".join([*header, *body, ""]), encoding="utf-8")
