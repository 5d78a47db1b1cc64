"""Lines across the edges of a square: which pixels they hold, and where these lie to their edge."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.estimators.vision.edge_crossings import cross, edges_of, pixels_across
from microdrivers.estimators.vision.quadrilateral import FloatArray

SHAPE = (90, 130)


def quad_of(centre: tuple[float, float], side_px: float, angle_deg: float, lean_px: float) -> FloatArray:
    """A square whose third corner is moved by `lean_px`."""
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    local = 0.5 * side_px * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    local[2] += lean_px
    return np.asarray(np.array(centre) + local @ np.array([[c, s], [-s, c]]))


@given(
    centre=st.tuples(st.floats(0.0, 130.0), st.floats(0.0, 90.0)),
    side_px=st.floats(12.0, 60.0),
    angle_deg=st.floats(0.0, 360.0),
    lean_px=st.floats(-1.0, 1.0),
    stride=st.integers(1, 2),
    reach=st.integers(1, 9),
)
@settings(deadline=None, max_examples=60)
def test_every_pixel_is_where_its_line_says(
    centre: tuple[float, float], side_px: float, angle_deg: float, lean_px: float, stride: int, reach: int
) -> None:
    quad = quad_of(centre, side_px, angle_deg, lean_px)
    edges = edges_of(quad)
    crossings = cross(edges, SHAPE, lines=4, stride=stride, reach=reach)
    u, v, across, along = (
        crossings.middles[:, k, None] + crossings.steps[:, k, None, None] * crossings.places[:, None] for k in range(4)
    )
    assert crossings.cells.shape == u.shape == (4, 2 * reach + 1, 9)
    whole_u, whole_v = np.rint(u), np.rint(v)
    assert np.abs(u - whole_u).max() < 1e-9
    assert np.abs(v - whole_v).max() < 1e-9
    visible = (whole_u >= 0) & (whole_u < SHAPE[1]) & (whole_v >= 0) & (whole_v < SHAPE[0])
    if crossings.in_view is None:
        assert visible.all()
    else:
        assert np.array_equal(crossings.in_view, visible)
    assert np.array_equal(crossings.cells[visible], (whole_v * SHAPE[1] + whole_u)[visible])
    assert 0 <= crossings.cells.min() <= crossings.cells.max() < SHAPE[0] * SHAPE[1]
    for k, (start, end) in enumerate(zip(quad, np.roll(quad, -1, axis=0), strict=True)):
        tangent = (end - start) / np.hypot(*(end - start))
        from_middle = np.stack([u[k], v[k]], axis=-1) - 0.5 * (start + end)
        assert from_middle @ (-tangent[1], tangent[0]) == pytest.approx(across[k], abs=1e-9)
        assert from_middle @ tangent == pytest.approx(along[k] * edges[k].half_length, abs=1e-9)
        assert len(np.unique(np.stack([u[k], v[k]]).reshape(2, -1), axis=1).T) == u[k].size
    # The middle pixel is the one nearest to the edge, and lines lead inward.
    assert np.abs(crossings.middles[:, 2]).max() <= 0.5 * crossings.steps[:, 2].max() + 1e-9
    assert crossings.steps[:, 2].min() >= np.sqrt(0.5) - 0.1


@given(angle_deg=st.floats(0.0, 360.0), reach_px=st.floats(1.0, 12.0), within_px=st.floats(8.0, 25.0))
@settings(deadline=None, max_examples=40)
def test_lines_of_a_span_hold_all_pixels_within_it(angle_deg: float, reach_px: float, within_px: float) -> None:
    edges = edges_of(quad_of((65.0, 45.0), 60.0, angle_deg, 0.0))
    reach = pixels_across(edges, reach_px)
    crossings = cross(edges, SHAPE, lines=60, stride=1, reach=reach)
    lead = crossings.steps[:, 3, None, None] * crossings.places[:, None]
    along_px = 30.0 * np.abs(crossings.middles[:, 3, None] + lead)
    from_middle = np.abs(np.arange(-60, 61))
    for edge, own in zip(edges, along_px, strict=True):
        # The line's own place is rounded, and so is where it meets the edge.
        assert from_middle[(own <= within_px).any(axis=0)].max() <= edge.span(within_px, reach) + 1.0
        inner = from_middle <= edge.span(within_px, -reach) - 1.0
        assert (own[:, inner] <= within_px).all()
