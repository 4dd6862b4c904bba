"""Sentences about symmetries of the target."""

from __future__ import annotations

import math

from caliv_graph.registration.symmetry import Symmetry


def symmetry_sentence(symmetry: Symmetry, name: str, sigma_rad: float) -> str:
    """What a symmetry of the target `name` means for the calibration.

    `sigma_rad` is that of the initial guess of a LiDAR's rotation, the largest of all LiDARs.
    """
    about = "the vertical" if symmetry.upright else "a level axis"
    compared = ""
    if len(symmetry.unseen):
        compared = f" ({100.0 * symmetry.compared:.0f}% of it could be compared)"
    if symmetry.continuous and symmetry.upright:
        return (
            f"{name}: it looks the same after any turn about {about}{compared}: its clouds do not "
            "determine the rotation of a LiDAR about that axis. Drive around it, or use a target "
            "with corners, such as a chair"
        )
    if symmetry.continuous:
        # Also of a chair of which little more than its back is seen: it is not marginalised.
        return (
            f"{name}: what was seen of it looks nearly the same after any turn about {about}"
            f"{compared}: its clouds tell little of the rotation of a LiDAR about that axis. Drive "
            "around it, nearer if it has few points, or use a target with corners on all sides"
        )
    turn = math.degrees(symmetry.angle_rad)
    # Registration converges to the nearer of two solutions.
    limit, guess = 0.5 * turn, 3.0 * math.degrees(sigma_rad)
    verdict = (
        f"The guesses are good to {guess:.0f} degrees (3 sigma), which is enough"
        if guess < limit
        else f"The guesses are good to {guess:.0f} degrees (3 sigma) only: give better ones, or "
        "use a target that looks different from every side"
    )
    return (
        f"{name}: it looks the same after a turn by {turn:.0f} degrees about {about}{compared}: an "
        f"initial guess that is off by more than {limit:.0f} degrees gives a result that is off by "
        f"{turn:.0f} degrees. {verdict}"
    )
