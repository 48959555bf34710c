"""Geometry that a running simulation and the offline rooms share: complexes, surface points, frames.

It needs NumPy and SciPy alone, and imports fracsim.common only.
"""
