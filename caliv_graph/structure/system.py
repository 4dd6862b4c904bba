"""The linearised system of structure: sightings, motion data, and how the vehicle stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from caliv_graph.products import Array
from caliv_graph.structure.beams import mean_rows
from caliv_graph.structure.elimination import Surfaces, eliminated
from caliv_graph.structure.layout import Layout, Nuisances, State
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.rows import PLACE_PRIOR_M, TILT_PRIOR_RAD, Rows
from caliv_graph.structure.standing import Standing, Stands, standing_rows


@dataclass(frozen=True)
class System:
    """A quadratic `d^T H d / 2 - b^T d` on all coordinates, the surfaces' own eliminated.

    Attributes:
        layout: the coordinates.
        H: (R, R) of the first R = `layout.plane` coordinates, without guesses of extrinsics.
        b: (R,).
        surfaces: what was eliminated.
    """

    layout: Layout
    H: Array
    b: Array
    surfaces: Surfaces


def system_of(
    rows: Rows,
    state: State,
    layout: Layout,
    prior: PosePrior,
    nuisances: Nuisances,
    standing: Standing,
    stands: Stands,
) -> System:
    """The normal equations of structure, motion data, and how the vehicle stands."""
    rest = layout.plane
    quadratic = rows.normal_equations(rest)
    del rows  # as large as H
    own_errors = slice(layout.standing, layout.turn)
    standing_J, standing_r = standing_rows(
        standing,
        stands,
        state.R_map_vehicle,
        state.t_map_vehicle,
        state.centres_map,
        state.normals_map,
        state.errors[own_errors],
        layout.standing,
        layout.plane,
        layout.size,
    )
    mean_J, mean_r = mean_rows(layout.beams, layout.beam, state.errors)
    J = scipy.sparse.vstack([standing_J, mean_J], format="csr")
    weight = np.zeros(layout.size)
    weight[layout.plane : layout.bend] = np.tile(
        [TILT_PRIOR_RAD**-2.0, TILT_PRIOR_RAD**-2.0, PLACE_PRIOR_M**-2.0], layout.strips
    )
    errors = layout.error_columns()
    weight[errors] = layout.error_sigmas(nuisances) ** -2.0
    tilt = standing.tilt_sigma_rad or 1.0
    weight[own_errors] = np.array([standing.height_sigma_m, tilt, tilt]) ** -2.0
    weight[layout.turn : layout.jitter] = nuisances.turn_rad_s.ravel() ** -2.0
    if nuisances.jitter_s > 0.0:
        weight[layout.jitter : layout.plane] = nuisances.jitter_s**-2.0
    more = (J.T @ J + scipy.sparse.diags_array(weight)).tocsr()
    of_first = more[:rest, :rest].tocoo()
    quadratic.first[of_first.row, of_first.col] += of_first.data
    right = quadratic.b - J.T @ np.concatenate([standing_r, mean_r]) - weight * state.errors
    # Handed over: they are large, and only their parts are needed further on.
    held = [quadratic.V_t, quadratic.others + more[rest:], quadratic.first]
    del quadratic
    blocks = layout.of_surfaces()
    H, b, surfaces = eliminated(held.pop(), held.pop(), held.pop(), right, blocks)
    prior.add_to(H, b, state.moved)
    if layout.parameters:
        own = slice(6 * layout.poses, layout.rate)
        H[own, own] += prior.parameter_information
        b[own] -= prior.parameter_information @ (prior.parameter_offset + state.moved[own])
    return System(layout, H, b, surfaces)
