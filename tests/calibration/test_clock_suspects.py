"""The value of a LiDAR's clock is that of a solve at moved stamps, not of the linear score."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.calibration.choose import late_stamps
from caliv_graph.calibration.clock_suspects import ALL_LIDARS, clock_solved_again
from caliv_graph.calibration.estimate import estimate
from caliv_graph.calibration.suspects import suspect_scores
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import RegistrationConfig
from caliv_graph.uncertainty.suspects import ranking
from tests.calibration.test_choose import CHAIR, CONFIG, observation, trajectory

LATE_S = 0.1
COARSE = RegistrationConfig(components=40, max_points=40)


def test_all_lidars_late_alike_are_found_from_a_linear_change_far_off() -> None:
    seen = observation(CHAIR, late_s=LATE_S)
    late = [seen]  # with half of the clouds, rounding decides between the lateness and a drift
    config = CONFIG.model_copy(update={"registration": COARSE})
    solution = estimate(late, [trajectory()], config, SilentProgress())
    linear, *rest = ranking(suspect_scores(solution, [trajectory()], {}))
    assert linear.candidate.name == ALL_LIDARS
    short = replace(linear, freed=replace(linear.freed, change=np.array([0.06])), explains=0.5)
    solved = clock_solved_again([short, *rest], solution, [trajectory()], {}, config, False)
    assert solved is not None
    found, *others = solved
    sigma_s = float(np.sqrt(found.freed.cov[0, 0]))
    assert found.freed.change[0] == pytest.approx(LATE_S, abs=3.0 * sigma_s)
    # At most what the clock of given poses may be off by; the clouds tell the sum to a millisecond.
    assert sigma_s < 1.05 * config.noise.pose_time_offset_s
    # Nothing else is wrong: what else the blurred shape contradicts ends with the lateness.
    assert found.explains > 0.9
    assert max(each.sigmas_left for each in others) < 3.0


def test_the_places_of_the_clouds_tell_which_clock_is_late() -> None:
    late = late_stamps(observation(CHAIR, late_s=LATE_S), trajectory(), CONFIG)
    assert late == pytest.approx({"front": LATE_S, "rear": LATE_S}, abs=0.02)
    assert late_stamps(observation(CHAIR), trajectory(), CONFIG) == {}
