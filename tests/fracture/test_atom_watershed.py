"""The watershed over atoms: where a field joins two atoms across their interface."""

from __future__ import annotations

import numpy as np

from fracsim.fracture.atom_watershed import flooded_passes


def test_atoms_join_where_two_vertices_of_an_interface_are_above_its_own_distance():
    udf = np.array([0.0, 0.05, 0.05, 0.02])
    interface_vertices = np.array([[0, 1, 2, 3], [0, 1, 3, 3], [1, 2, 1, 2]])
    own = np.array([[0.0] * 4, [0.0] * 4, [0.05] * 4])
    np.testing.assert_array_equal(flooded_passes(udf, interface_vertices, own, 0.03), [True, False, False])
