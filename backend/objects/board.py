"""The dots printed on a board, by which a camera finds it."""

from __future__ import annotations

import numpy as np

from backend.core.flow import FloatArray

DOTS_MM: FloatArray = np.array([[-40.0, -40.0], [40.0, -40.0], [40.0, 40.0], [-40.0, 40.0]])
"""Centres of the four dots in frame ``O``, counter-clockwise from the lower left."""
DOT_RADIUS_MM = 4.0
