"""Uncertainty of modes, from the covariance of a fit."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.cable.shape_in_motion import directions

SVG = "{http://www.w3.org/2000/svg}"


def unsure(cable, **std):
    """The cable with independent standard deviations of its numbers."""
    covariance = np.diag(np.square(list(std.values())))
    given = {"names": tuple(std), "covariance": covariance}
    uncertainty = replace(cable.metadata.uncertainty, **given)
    return replace(cable, metadata=replace(cable.metadata, uncertainty=uncertainty))


@pytest.fixture(scope="module")
def rod():
    """A weightless rod, clamped at its start."""
    data = dlo.Cable(length=0.5, mass=0.05, diameter=0.005, bending_stiffness=0.02)
    free = ("clamped", "free")
    return dlo.known_cable(data, gravity=(0, 0), boundary=free, model={"n": 10}).with_damping(0.004)


def test_frequencies_go_with_the_root_of_the_stiffness(rod):
    modes = unsure(rod, bending_stiffness=4e-4, damping_time=2e-4).solve(start_heading=0.0).modes(3)
    np.testing.assert_allclose(modes.frequency_std, 0.01 * modes.frequencies, rtol=1e-3)
    # zeta = w tau / 2
    np.testing.assert_allclose(
        modes.damping_ratio_std, np.hypot(0.01, 0.05) * modes.damping_ratios, rtol=2e-3
    )
    assert "+-" in repr(modes)


def test_modes_swing_in_a_picture(rod, tmp_path):
    modes = rod.solve(start_heading=0.0).modes(4)
    drawn = ElementTree.parse(modes.animate(tmp_path / "modes.svg")).getroot()
    played = [float(x.get("dur", "")[:-1]) for x in drawn.iter(f"{SVG}animate")]
    np.testing.assert_allclose(played, 1 / modes.frequencies, rtol=1e-3)
    with pytest.raises(dlo.DloError, match=r"modes.gif: .* SVG"):
        modes.animate(tmp_path / "modes.gif")


def test_a_known_cable_has_none(rod):
    modes = rod.solve(start_heading=0.0).modes(2)
    assert not modes.frequency_std.any()
    assert "+-" not in repr(modes)


def test_a_coefficient_of_the_rest_curvature_changes_all_places_that_it_reaches():
    data = dlo.Cable(length=0.5, mass=0.05, diameter=0.005, bending_stiffness=0.02)
    given = {"gravity": (0, -9.81), "boundary": ("clamped", "free"), "model": {"n": 10}}
    cable = dlo.known_cable(data, rest_curvature=[0.5, 1.0, 0.2, 0.0], **given)
    ((p, rest),) = directions(unsure(cable, **{"rest_curvature[1]": 0.1}))
    assert not p.any()
    np.testing.assert_allclose(np.abs(rest), np.abs(0.1 * cable.model.rest_basis[:, 1]))
