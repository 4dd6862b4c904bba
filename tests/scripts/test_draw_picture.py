"""The README's picture: its figures and its size. The drive itself is scripts/demo's."""

from __future__ import annotations

import io

import gtsam
import numpy as np
from PIL import Image

from scripts import draw_picture


def test_the_errors_in_a_title_are_lengths_in_mm_and_mrad() -> None:
    truth = {
        "front": gtsam.Pose3(gtsam.Rot3(), np.array([2.0, 0.0, 1.0])),
        "rear": gtsam.Pose3(gtsam.Rot3.Yaw(np.pi), np.array([0.0, 0.0, 1.0])),
    }
    # 3 mm and 4 mm at right angles; 0.02 rad about the LiDAR's own x. The rear one is right.
    moved = gtsam.Pose3(gtsam.Rot3.Roll(0.02), np.array([0.0, 0.003, 0.004]))
    found = {"front": truth["front"].compose(moved), "rear": truth["rear"]}

    text = draw_picture.errors_in_words(found, truth)

    assert text.splitlines() == [
        "front to rear: 5 mm, 20 mrad off",
        "LiDAR to vehicle: 5 mm, 20 mrad off at most",
    ]


def test_the_picture_shows_both_lidars_in_both_columns_on_a_plain_ground() -> None:
    rng = np.random.default_rng(1)
    after = rng.uniform([5.0, -0.3, 0.1], [5.5, 0.3, 1.0], (400, 3))
    points = draw_picture.Points(np.repeat([0, 1], 200), after + 0.2, after)

    content = draw_picture.as_png(
        draw_picture.draw(points, ("front", "rear"), ("before", "after")), dpi=60
    )

    image = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))
    assert len(content) < draw_picture.LARGEST_BYTES
    assert (image[0, 0] == 255).all()
    half = image.shape[1] // 2
    above_legend = image[: int(0.95 * len(image))]
    for column in (above_legend[:, :half], above_legend[:, half:]):
        redder = column[:, :, 0].astype(int) - column[:, :, 2]
        assert (redder < -60).sum() > 20  # blue: 'front'
        assert (redder > 60).sum() > 20  # orange: 'rear'
