"""Time of one pose: COBYLA, IPOPT and the generated C, beside Table 5; and what it buys."""

from __future__ import annotations

import platform
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.optimize import minimize

from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.guesses import arc_headings
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.show.style import BLACK, GREY, VERMILLION
from paper import published
from paper.content import Claim, Part, Section, Table, Target, drawing, duration, mm
from paper.figures import COLORS, MARKERS
from paper.fits import ELEMENTS, Method
from paper.replica import PLACES, true_shapes

FloatArray = NDArray[np.floating]

# COBYLA may take so long in all [s].
BUDGET = 60.0
# Solves of one timed call of the C solver.
SOLVES = 2400
# The C solver must be so many times faster than COBYLA here.
FASTER = 1e5


def run() -> Part:
    """Time every method with the parameters of Table 3."""
    truth = [
        curve.at(PLACES) for curve in true_shapes(published.STIFFNESS, published.rest_angles())
    ]
    part = Part("speed")
    section = Section("speed", "Table 5, Figure 4b: time of one pose, and what it buys")
    part.sections.append(section)
    compiled = {
        element: {n: by_c(element, n, truth) for n in published.MESHES} for element in ELEMENTS
    }
    ipopt = {element: {n: by_ipopt(element, n) for n in published.MESHES} for element in ELEMENTS}
    cobyla = by_cobyla(truth)
    section.text = [
        "One pose is solved from the arc through its ends with the parameters αᶠ of Table 3 and "
        "the paper's stiffness; times are means over the poses. COBYLA is SciPy "
        f"{scipy.__version__}'s, in relative angles, as the paper describes it, until its steps "
        f"are below 1e-6 rad; it had {BUDGET:.0f} s in all, and what it did not reach is blank. "
        "The C solver is generated for the cable and compiled with -O2; IPOPT is called from "
        "Python through CasADi. All ran on one shared machine "
        f"({platform.machine()}, {platform.system()}); the paper's machine is not known.",
    ]
    section.tables.append(_times(compiled, ipopt, cobyla))
    _draw_times(section, compiled, ipopt, cobyla)
    _draw_pareto(section, compiled, ipopt, cobyla)
    part.targets = [_target(n, compiled["link"][n][0], cobyla.get(n)) for n in (10, 20)]
    part.data = {
        "c": _plain(compiled),
        "ipopt": ipopt,
        "cobyla": {
            n: {"seconds": s, "largest_rms_m": e, "poses": k} for n, (s, e, k) in cobyla.items()
        },
        "scipy": scipy.__version__,
    }
    part.claims = _claims(compiled, cobyla)
    return part


def _plain(rows: dict[Method, dict[int, tuple[float, float]]]) -> dict[str, Any]:
    return {
        element: {n: {"seconds": s, "largest_rms_m": e} for n, (s, e) in row.items()}
        for element, row in rows.items()
    }


def _model(element: Method, n: int) -> tuple[CableModel, FloatArray]:
    kind = "link" if element == "link" else "arc" if element == "arc" else "quadratic"
    model = CableModel(published.cable(), n=n, element=kind)
    return model, published.RestShape(published.rest_angles()).on(model)


def _largest(curves: list[NodeCurve], truth: list[FloatArray]) -> float:
    return max(
        float(np.sqrt((curve.distances(points) ** 2).mean()))
        for curve, points in zip(curves, truth, strict=False)
    )


def by_c(element: Method, n: int, truth: list[FloatArray]) -> tuple[float, float]:
    """Mean time [s] of the generated solver over the poses, and its largest RMS error [m]."""
    model, rest = _model(element, n)
    solver = CompiledSolver(model, model.nominal, rest)
    ends = np.array([pose.ends for pose in published.poses()])
    many = np.tile(ends, (SOLVES // len(ends), 1))
    seconds = []
    for _ in range(3):
        begin = perf_counter()
        found, statuses = solver.solve_many(many, branch="ccw")
        seconds.append((perf_counter() - begin) / len(many))
    if statuses.any():
        raise RuntimeError(f"the C solver failed in {int((statuses != 0).sum())} solves")
    curves = []
    for pose, record in zip(published.poses(), found, strict=False):
        curves.append(_seen(model, rest, pose, record["x"], record["end_force"]))
    return min(seconds), _largest(curves, truth)


def _seen(
    model: CableModel, rest: FloatArray, pose: HeldPose, x: FloatArray, lam: FloatArray
) -> NodeCurve:
    """Curve of given headings."""
    given = Inputs.of(model.nominal, rest, pose.vector[None])
    shapes = Shapes.declared(x.reshape(1, -1, 1), lam[None])
    return NodeCurve.of(published.LENGTH, Assembly(model, shapes, given).curve()[0])


def by_ipopt(element: Method, n: int) -> float:
    """Mean time [s] over the poses, the solver being built."""
    model, rest = _model(element, n)
    poses = published.poses()
    solve_equilibrium(model, model.nominal, rest, poses[0])
    begin = perf_counter()
    for pose in poses:
        solve_equilibrium(model, model.nominal, rest, pose)
    return (perf_counter() - begin) / len(poses)


def by_cobyla(truth: list[FloatArray]) -> dict[int, tuple[float, float, int]]:
    """Mean time [s], largest RMS error [m] and number of poses for each n within the budget.

    A mesh on which the budget ends keeps the poses that were solved.
    """
    out = {}
    left = BUDGET
    for n in published.MESHES:
        seconds: list[float] = []
        curves = []
        for pose in published.poses():
            # The next one takes about as long as the last: none is begun that cannot end.
            if left < (seconds[-1] if seconds else 0.0):
                break
            begin = perf_counter()
            theta = cobyla(pose, n)
            seconds.append(perf_counter() - begin)
            left -= seconds[-1]
            model, rest = _model("link", n)
            curves.append(_seen(model, rest, pose, np.cumsum(theta), np.zeros(2)))
        if not seconds:
            break
        out[n] = (float(np.mean(seconds)), _largest(curves, truth), len(seconds))
        if left <= seconds[-1]:
            break
    return out


def cobyla(pose: HeldPose, n: int) -> FloatArray:
    """Eq. 8 in relative angles (n,) [rad] by COBYLA, from the arc through both ends."""
    model, rest = _model("link", n)
    h = model.chain.h
    k_theta, weight = published.STIFFNESS / h, published.MASS / n * 9.81
    end = np.array(pose.end)
    start = arc_headings(model.chain.places, published.LENGTH, end, 1)

    def energy(theta: FloatArray) -> float:
        rise = h * np.sin(np.cumsum(theta))
        bend = k_theta / 2 * ((theta[1:] - rest * h) ** 2).sum()
        return float(bend + weight * (np.cumsum(rise) - rise / 2).sum())

    def gap(theta: FloatArray) -> FloatArray:
        phi = np.cumsum(theta)
        return h * np.array([np.cos(phi).sum(), np.sin(phi).sum()]) - end

    sides: list[Callable[[FloatArray], FloatArray]] = [gap, lambda theta: -gap(theta)]
    found = minimize(
        energy,
        np.concatenate([start[:1], np.diff(start)]),
        method="COBYLA",
        constraints=[{"type": "ineq", "fun": side} for side in sides],
        options={"maxiter": 200000, "tol": 1e-6, "rhobeg": 0.1, "catol": 1e-6},
    )
    return np.asarray(found.x)


def _times(
    compiled: dict[Method, dict[int, tuple[float, float]]],
    ipopt: dict[Method, dict[int, float]],
    found: dict[int, tuple[float, float, int]],
) -> Table:
    rows = []
    for line in published.table(5):
        n = int(line["n"])
        seconds, error, poses = found.get(n, (None, None, 0))
        rows.append(
            [
                str(n),
                duration(line["average_time_s"]),
                duration(seconds),
                str(poses) if poses else "",
                mm(error, 3),
                *(duration(ipopt[element][n]) for element in ELEMENTS),
                *(duration(compiled[element][n][0]) for element in ELEMENTS),
                *(mm(compiled[element][n][1], 4) for element in ELEMENTS),
            ]
        )
    return Table(
        "Average time of one pose, and the largest RMS error over the poses [mm]",
        ["n", "printed", "time", "poses", "error", *ELEMENTS, *ELEMENTS, *ELEMENTS],
        rows,
        groups=[
            *(("", 1), ("paper", 1), ("COBYLA here", 3)),
            *(("IPOPT", 3), ("generated C", 3), ("error of C", 3)),
        ],
    )


def _draw_times(
    section: Section,
    compiled: dict[Method, dict[int, tuple[float, float]]],
    ipopt: dict[Method, dict[int, float]],
    found: dict[int, tuple[float, float, int]],
) -> None:
    with drawing(section, "figure-4b", "Figure 4b: time of one pose against n.", (6.6, 4.2)) as fig:
        axes = fig.subplots()
        printed = published.table(5)
        axes.loglog(
            [row["n"] for row in printed],
            [row["average_time_s"] for row in printed],
            *("*--",),
            color=BLACK,
            label="printed",
        )
        axes.loglog(
            list(found), [s for s, _, _ in found.values()], "s-", color=VERMILLION, label="COBYLA"
        )
        for element in ELEMENTS:
            style = {"color": COLORS[element], "marker": MARKERS[element]}
            axes.loglog(
                published.MESHES,
                list(ipopt[element].values()),
                ls=":",
                label=f"IPOPT, {element}",
                **style,
            )
            axes.loglog(
                published.MESHES,
                [seconds for seconds, _ in compiled[element].values()],
                label=f"C, {element}",
                **style,
            )
        axes.set_xticks(published.MESHES, [str(n) for n in published.MESHES])
        axes.set_xticks([], minor=True)
        axes.set_xlabel("elements n")
        axes.set_ylabel("time of one pose [s]")
        fig.legend(loc="outside right upper")


def _draw_pareto(
    section: Section,
    compiled: dict[Method, dict[int, tuple[float, float]]],
    ipopt: dict[Method, dict[int, float]],
    found: dict[int, tuple[float, float, int]],
) -> None:
    caption = (
        "Accuracy against computing time: largest RMS error over the poses against the continuous "
        "cable with the same parameters. Numbers at the points are n; IPOPT has the errors of C."
    )
    with drawing(section, "pareto", caption, (7.6, 4.6)) as figure:
        axes = figure.subplots()
        for element in ELEMENTS:
            style = {"color": COLORS[element], "marker": MARKERS[element]}
            errors = [1e3 * error for _, error in compiled[element].values()]
            times = [seconds for seconds, _ in compiled[element].values()]
            axes.loglog(times, errors, label=f"C, {element}", **style)
            axes.loglog(
                list(ipopt[element].values()), errors, ls=":", label=f"IPOPT, {element}", **style
            )
            for n, x, y in zip(published.MESHES, times, errors, strict=True):
                axes.annotate(str(n), (x, y), (4, 3), textcoords="offset points", fontsize=7)
        axes.loglog(
            [s for s, _, _ in found.values()],
            [1e3 * e for _, e, _ in found.values()],
            *("s-",),
            color=VERMILLION,
            label="COBYLA, link",
        )
        for n, (seconds, error, _) in found.items():
            place = (seconds, 1e3 * error)
            axes.annotate(str(n), place, (4, 3), textcoords="offset points", fontsize=7)
        axes.axhline(1.0, color=GREY, lw=0.6)
        axes.set_xlabel("time of one pose [s]")
        axes.set_ylabel("largest RMS error [mm]")
        figure.legend(loc="outside right upper")


def _target(n: int, ours: float, theirs: tuple[float, float, int] | None) -> Target:
    name = f"Time of one pose, n = {n}: COBYLA here over generated C (links)"
    if theirs is None:
        return Target(name, f"at least {FASTER:.0e}", "COBYLA did not get there", False)
    ratio = theirs[0] / ours
    value = f"{ratio:.2e} ({duration(theirs[0])} over {duration(ours)})"
    return Target(name, f"at least {FASTER:.0e}", value, ratio >= FASTER)


def _claims(
    compiled: dict[Method, dict[int, tuple[float, float]]],
    found: dict[int, tuple[float, float, int]],
) -> list[Claim]:
    printed = {int(row["n"]): row["average_time_s"] for row in published.table(5)}
    ours = compiled["link"][20][0] / compiled["link"][10][0]
    claims = [
        Claim(
            "Table 5",
            "average time 0.5 s at n = 10 and 1.9 s at n = 20",
            "; ".join(
                f"n = {n}: COBYLA here {duration(found[n][0])}" for n in (10, 20) if n in found
            )
            or "COBYLA did not get there",
            "holds"
            if all(n in found and 0.1 < found[n][0] / printed[n] < 10 for n in (10, 20))
            else "in part",
        ),
        Claim(
            "Section 4.2",
            "from 10 to 20 links takes 4 times as long",
            f"true of COBYLA; the generated C takes {ours:.1f} times as long",
            "in part",
        ),
    ]
    return claims
