"""Clips and contact beside closed forms, and beside SciPy's `solve_bvp`."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_bvp

import dlo_casadi as dlo
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.rod.obstacles import Capsule, Plane

MESHES = (20, 40, 80)
# Shortening of the rod from which on it touches along a stretch, relative to that at first contact.
LINE = 12 / np.pi**2


def solved(model: CableModel, pose: HeldPose, start: np.ndarray | None = None) -> Equilibrium:
    """The equilibrium of a cable that is straight at rest."""
    rest = np.zeros(model.chain.n_rests)
    (found,) = solve_equilibria(model, model.nominal, rest, [pose], [start])
    if not isinstance(found, Equilibrium):
        raise found
    return found


def check_beam() -> None:
    """Small slopes: H = q l^4 / (72 EI), and Q = q l / 3 where the beam leaves the table."""
    weight, stiffness, height = 0.5, 0.02, 0.004
    lift = (72 * stiffness * height / weight) ** 0.25
    for length in (0.8, 0.806, 0.812):
        for n in MESHES:
            cable = CableData(length, weight * length / 9.81, 0.004, stiffness)
            table = Plane((0.0, -height - 0.002), (0.0, 1.0))
            model = CableModel(cable, n, start="clamped", end="free", n_rest=0, obstacles=(table,))
            found = solved(model, HeldPose((0.0, 0.0), start_heading=0.0))
            held = -found.start_force[1] / (2 / 3 * weight * lift)
            print(
                f"beam {length:g} m, n = {n}: lift-off {found.contacts[0].start / lift - 1:+.1e}, "
                f"force on the clamp {held - 1:+.1e}"
            )


def check_cylinder() -> None:
    """T + M^2 / (2 EI) - w y is the same everywhere: compared at the ends, with the force there."""
    weight, radius = 1.0, 0.1
    for n in MESHES:
        cable = CableData(1.0, weight / 9.81, 0.006, 2e-3)
        cylinder = Capsule((0.0, 0.0), (0.0, 0.0), radius)
        model = CableModel(cable, n, n_rest=0, obstacles=(cylinder,))
        over = np.linspace(0.23 + 2.03, 0.23 - 2.03, n + 1)[:, None]
        try:
            found = solved(model, HeldPose((-0.2, -0.25), (0.22, -0.15)), over)
        except dlo.DloError:
            print(f"cylinder n = {n}: no equilibrium found")
            continue
        ahead = np.concatenate([np.cos(found.x), np.sin(found.x)], axis=1)
        ends = found.end_force @ ahead[-1], -found.start_force @ ahead[0]
        force = float(np.linalg.norm(found.contacts[0].force))
        places = NodeCurve.of(1.0, curve_of(model, found)).at(np.linspace(0, 1, 2001))
        depth = radius + 0.003 - np.linalg.norm(places, axis=1).min()
        print(
            f"cylinder n = {n}: T_2 - T_1 - w dy = {ends[0] - ends[1] + weight * 0.1:+.1e} N of "
            f"{force:.3f} N, between nodes {1e3 * depth:.3f} mm deep"
        )


def check_rod() -> None:
    """A weightless rod between pins pushed against a wall at the distance A, small slopes.

    With P in units of pi^2 EI / L^2: it touches at P = 1, shortened by pi^2 A^2 / (4 L); in a
    point with the force 2 P A / (l - tan(k l) / k), k^2 = P / EI, l = L/2; from P = 4 on along a
    stretch, l from either pin, where k l = pi and the shortening is 3 A^2 / (2 l).
    """
    stiffness, gap = 0.02, 0.005
    cable = CableData(1.0, 1e-9, 0.004, stiffness)
    walls = tuple(Plane((0.0, y * (gap + 0.002)), (0.0, -y), f"wall {y:+g}") for y in (1.0, -1.0))
    for n in MESHES:
        model = CableModel(cable, n, n_rest=0, gravity=(0.0, 0.0), obstacles=walls)
        bent = gap * np.pi * np.cos(np.pi * model.chain.places)[:, None]
        touch = np.pi**2 * gap**2 / 4
        for share in (0.98, 1.1, 1.5, 1.8):
            found = solved(model, HeldPose((0.0, 0.0), (1 - share * touch, 0.0)), bent)
            pushed = abs(found.end_force[0]) / (np.pi**2 * stiffness)
            told = f"rod n = {n}, shortened by {share:g} of first contact: P = {pushed:.4f}"
            for one in found.contacts:
                k = np.pi * np.sqrt(pushed)
                force = 2 * pushed * np.pi**2 * stiffness * gap / (0.5 - np.tan(k / 2) / k)
                lifts = 3 * gap**2 / (2 * share * touch)
                told += (
                    f", force {one.force[1] / force - 1:+.1e}"
                    if share < LINE
                    else (f" (line: {1 / lifts**2:.4f}), lift-off {one.start / lifts - 1:+.1e}")
                )
            print(told)


def curve_of(model: CableModel, found: Equilibrium) -> np.ndarray:
    """Rows of places and slopes of the pose of `check_cylinder`."""
    pose = HeldPose((-0.2, -0.25), (0.22, -0.15))
    given = Inputs.of(model.nominal, np.zeros(model.chain.n_rests), pose.vector[None])
    return Assembly(model, found.shapes, given).curve()[0]


def check_bvp() -> None:
    """A heavy elastica through one pinned clip, on two meshes."""
    stiffness, weight, at, place, end = 0.02, 0.2 * 9.81, 0.437, (0.33, 0.12), (0.7, 0.05)
    spans = np.array([at, 1 - at])

    def slopes(u, y, p):
        rows = []
        for k in (0, 1):
            _, _, phi, bend = y[4 * k : 4 * k + 4]
            nx, ny = p[2 * k], p[2 * k + 1] + weight * spans[k] * u
            cos, sin = np.cos(phi), np.sin(phi)
            rows += [cos, sin, bend, -(cos * ny - sin * nx) / stiffness]
        return np.array(rows) * np.repeat(spans, 4)[:, None]

    def conditions(a, b, p):
        return np.array(
            [
                *(a[0], a[1], a[3]),
                *(b[:2] - place),
                *(a[4:6] - place),
                *(a[6:8] - b[2:4]),
                *(b[4:6] - end),
                b[7],
            ]
        )

    for n in (40, 80, 160):
        model = CableModel(CableData(1.0, 0.2, 0.01, stiffness), n, n_rest=0, clips=("pinned",))
        pose = HeldPose((0.0, 0.0), end, clips=(HeldClip("pinned", place, at),))
        (eq,) = solve_equilibria(model, model.nominal, np.zeros(n), [pose])
        given = Inputs.of(model.nominal, np.zeros(n), pose.vector[None])
        here = Assembly(model, eq.shapes, given)
        curve, u = NodeCurve.of(1.0, here.curve()[0]), np.linspace(0, 1, 201)
        nodes = here.clipped.places[0]
        guess = []
        for s in (at * u, at + (1 - at) * u):
            phi = np.interp(s, nodes, eq.phi)
            guess += [*curve.at(s).T, phi, np.gradient(phi, s)]
        first = eq.start_force
        pulls = [first, first + np.array([0.0, weight * at]) + eq.clips[0].force]
        found = solve_bvp(slopes, conditions, u, np.array(guess), np.ravel(pulls), tol=1e-10,
                          max_nodes=200000)  # fmt: skip
        there = np.hstack([found.sol(u)[:2], found.sol(u)[4:6]]).T
        apart = np.abs(np.vstack([curve.at(at * u), curve.at(at + (1 - at) * u)]) - there).max()
        print(f"solve_bvp ({found.message}), n = {n}: shapes differ by {apart:.1e} L", flush=True)
