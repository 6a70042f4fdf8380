"""Where a contact begins, from the forces of its nodes."""

import numpy as np
import pytest

from dlo_casadi.model.contact import _inwards


def test_where_a_contact_begins_between_uneven_nodes():
    """From nodal forces of the sum and moment of a point force and an even load inwards of it."""
    places = 0.3 + np.cumsum(np.random.default_rng(0).uniform(0.015, 0.025, 16))
    begin, point, even = places[0] + 0.4 * (places[1] - places[0]), 0.7, 3.0
    force = even * np.gradient(places)
    x, half = places[3] - begin, (places[4] - places[3]) / 2
    arms = places[3] - places[:2]
    total = point + even * (x + half) - force[2:4].sum()
    moment = point * x + even * (x**2 - half**2) / 2 - force[2] * (places[3] - places[2])
    force[:2] = np.linalg.solve([[1.0, 1.0], arms], [total, moment])
    assert places[0] + _inwards(force, places) == pytest.approx(begin, abs=1e-12)
