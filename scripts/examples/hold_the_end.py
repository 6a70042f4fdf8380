"""Where to hold a cable's end so that it pulls least and bends nowhere tighter than 50 mm.

    python scripts/examples/hold_the_end.py        draws results/hold_the_end.png

The cable hangs from a plug that points down to one that points up. `cable.function()` is the shape
as a CasADi function of where the plugs are; Opti and IPOPT do the rest. The bound is on the
curvature at all places: its maximum, one over the bend radius, has kinks.
"""

from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.model.cable_model import CableModel

LOW, HIGH = (0.03, 0.0), (0.3, 0.2)  # m, where the end may be
DOWN, UP, RADIUS = -np.pi / 2, np.pi / 2, 0.05  # rad, rad, m


def cable() -> CasadiCable:
    """0.5 m of a soft charging cable; `dlo_casadi.load("results/...")` gives a fitted one."""
    data = CableData(length=0.5, mass=0.015, diameter=0.003, bending_stiffness=2e-5)
    # It bends within 14 mm of a plug: on 30 elements the radius there would be 20 % too large.
    model = CableModel(data, n=120, start="clamped", end="clamped", n_rest=0)
    return CasadiCable(model, model.nominal, np.zeros(model.chain.n_rests))


def best_end(shape: ca.Function, first: np.ndarray) -> tuple[np.ndarray, float, int]:
    """End [m], pull on it [N], and iterations of IPOPT from a first guess of the end."""
    problem = ca.Opti()
    end = problem.variable(2)
    found = shape(pose=ca.vertcat(0, 0, end, DOWN, UP))
    pull = ca.norm_2(found["end_force"])
    problem.minimize(pull)
    problem.subject_to(found["curvature"] <= 1 / RADIUS)
    problem.subject_to(problem.bounded(LOW, end, HIGH))
    problem.set_initial(end, first)
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    done = problem.solve()
    return done.value(end), done.value(pull), done.stats()["iter_count"]


def draw(known: CasadiCable, firsts: np.ndarray, ends: np.ndarray, path: Path) -> None:
    """Pull and bend radius wherever the end may be, from the compiled solver, and the best end."""
    solver = CompiledSolver(known.model, known.p, known.rest)
    x, y = np.meshgrid(*(np.linspace(a, b, 91) for a, b in zip(LOW, HIGH, strict=True)))
    poses = np.stack([0 * x, 0 * x, x, y, 0 * x + DOWN, 0 * x + UP], axis=-1).reshape(-1, 6)
    shapes, _ = solver.solve_many(poses)
    pull = 1e3 * np.linalg.norm(shapes["end_force"], axis=1).reshape(x.shape)
    radius = shapes["min_bend_radius"].reshape(x.shape)
    figure, axes = plt.subplots(figsize=(6, 7), layout="constrained")
    axes.contourf(x, y, radius, [0, RADIUS], colors="0.85")
    lines = axes.contour(x, y, pull, np.arange(60, 150, 5), cmap="viridis_r", linewidths=1)
    axes.clabel(lines, fmt="%.0f mN")
    held = np.array(known.function()([0, 0, *ends[0], DOWN, UP])[0])
    axes.plot(*held, "C3", lw=3, solid_joinstyle="round", label="the cable, held best")
    axes.plot(*firsts.T, "k.", label="first guesses")
    axes.plot(*ends.T, "k*", ms=14, label="IPOPT's ends")
    corners = zip(LOW, (HIGH[0], LOW[1]), HIGH, (LOW[0], HIGH[1]), LOW, strict=True)
    axes.plot(*corners, "k--", lw=1, label="where the end may be")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="pull on the end; grey: radius below 50 mm")
    axes.set_aspect("equal")
    figure.legend(loc="outside lower center", ncols=2)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    known, firsts = cable(), np.random.default_rng(0).uniform(LOW, HIGH, (10, 2))
    found = [best_end(known.function(), first) for first in firsts]
    for end, pull, count in found:
        print(f"end ({end[0]:.6f}, {end[1]:.6f}) m, pull {pull:.6f} N, {count} iterations")
    Path("results").mkdir(exist_ok=True)
    draw(known, firsts, np.array([end for end, _, _ in found]), Path("results/hold_the_end.png"))
