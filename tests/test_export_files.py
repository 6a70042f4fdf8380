"""Numbers in the files of simulators, read back without the simulators."""

import sys
from types import SimpleNamespace
from unittest.mock import MagicMock
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_export import MASS, PLACE, RATIO, in_plane, in_space

from dlo_casadi.export.rod import Rod
from dlo_casadi.export.targets import TARGETS

N = 20


@pytest.fixture(scope="module")
def rod():
    """A curved flat cable with a compact mass, between two clamps."""
    values = {"lumped_mass__mass": MASS, "lumped_mass__position": PLACE}
    values |= {"bending_anisotropy__ratio": RATIO, "bending_anisotropy__angle": 0.4}
    return Rod.of(in_space("bending_anisotropy", "lumped_mass", **values), N)


def names_in(target, rod, monkeypatch):
    """What a file of Python defines, with stand-ins for the simulators that it imports."""
    for name in ("elastica", "newton", "warp"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    made = {}
    exec(TARGETS[target].write(rod, []), made)
    return made


def test_a_compact_mass_hangs_at_its_arc_length_in_mujoco(rod):
    tree = ElementTree.fromstring(TARGETS["mujoco"].write(rod, []))
    (body,) = tree.findall(".//geom[@type='sphere']/..")
    sphere = body.find("geom[@type='sphere']")
    link, along = int(body.get("name").split("_")[1]), float(sphere.get("pos").split()[0])
    assert rod.s[link] + along == pytest.approx(PLACE)
    assert 0.0 <= along <= rod.h
    assert float(sphere.get("mass")) == MASS


def test_pyelastica_has_masses_at_nodes_and_the_tangent_last(rod, monkeypatch):
    made = names_in("pyelastica", rod, monkeypatch)
    shapes = {"bend_matrix": (3, 3, N - 1), "shear_matrix": (3, 3, N), "mass": (N + 1,)}
    shapes |= dict.fromkeys(
        ("mass_second_moment_of_inertia", "inv_mass_second_moment_of_inertia"), (3, 3, N)
    )
    empty = {name: np.zeros(shape) for name, shape in shapes.items()}
    made["ea"].CosseratRod.straight_rod = lambda **given: SimpleNamespace(**empty, **given)
    found = made["make_rod"]()

    assert found.position == pytest.approx(rod.nodes.T)
    assert found.directors == pytest.approx(rod.frames.as_matrix()[:, :, [1, 2, 0]].T)
    assert found.mass.sum() == pytest.approx(0.03 + MASS)
    middles = (rod.s[1:] + rod.s[:-1]) / 2
    moment = rod.masses @ middles + MASS * PLACE
    assert found.mass @ rod.s == pytest.approx(moment)
    assert found.bend_matrix[:2, :2] == pytest.approx(np.moveaxis(rod.bending, 0, 2))
    assert found.bend_matrix[2, 2] == pytest.approx(rod.torsion)
    assert found.rest_kappa == pytest.approx(rod.rest[:, [1, 2, 0]].T)
    assert (made["HELD_NODES"], made["HELD_ELEMENTS"]) == ((0, 1, -1, -2), (0, -1))
    assert made["GRAVITY"] == pytest.approx(rod.gravity)


def test_newton_has_masses_of_links_and_the_tangent_last(rod, monkeypatch):
    made = names_in("newton", rod, monkeypatch)
    assert made["NODES"] == pytest.approx(rod.nodes)
    turned, rest = (Rotation.from_quat(made[f"{x}QUATERNIONS"]) for x in ("", "REST_"))
    assert turned.as_matrix() == pytest.approx(rod.frames.as_matrix()[:, :, [1, 2, 0]])
    steps = rod.h * rest.apply([0.0, 0.0, 1.0])
    assert np.diff(made["REST_NODES"], axis=0) == pytest.approx(steps)
    assert made["REST_NODES"][0] == pytest.approx(rod.nodes[0])
    turns = (rest[:-1].inv() * rest[1:]).as_rotvec()
    assert turns == pytest.approx(rod.h * rod.rest[:, [1, 2, 0]], abs=1e-10)
    middles = (rod.s[1:] + rod.s[:-1]) / 2
    assert made["MASSES"].sum() == pytest.approx(0.03 + MASS)
    assert made["MASSES"] @ middles == pytest.approx(rod.masses @ middles + MASS * PLACE)
    assert made["BENDING"] == pytest.approx((1 + RATIO) / 2 * 0.015)
    assert made["TORSION"] == pytest.approx(rod.torsion)
    assert (made["CLAMPED"], made["PINNED"]) == ([0, -1], [])


def test_newton_holds_pins_by_the_outer_ends_of_links(monkeypatch):
    made = names_in("newton", Rod.of(in_plane(), N), monkeypatch)
    assert (made["CLAMPED"], made["PINNED"]) == ([], [(0, -1), (-1, 1)])
