"""Lead a cable's end past obstacles so that its peak pull is as small as it can be.

    python scripts/examples/lead_the_end.py        draws results/lead_the_end.png

Twenty poses are one problem: their shapes are unknowns, the balance of each a constraint, from
`cable.equations()`. Cable, obstacles, start and goal are those of scripts/planner.
"""

from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.model.cable_model import CableModel

WAY = np.array([[0.62, 0.40, 0.45], [-0.30, 0.15, 0.62]])  # m: start, a first guess, goal
DISCS = ((0.55, 0.12, 0.07), (0.12, 0.42, 0.06), (0.72, 0.36, 0.05))  # x, y, radius [m]
GAP = 0.013  # m, of nodes at and midway between poses: everywhere else it is 10 mm
# The end's way by scripts/planner/plan.py, the shortest found by RRT* and the compiled solver [m].
X = (0.62, 0.5797, 0.5328, 0.5085, 0.4705, 0.4405, 0.422, 0.389, 0.4076, 0.4349, 0.45)
Y = (-0.3, -0.1914, -0.0849, -0.0195, 0.0796, 0.1776, 0.2473, 0.3916, 0.445, 0.5579, 0.62)


def cable() -> CasadiCable:
    """0.9 m between pins; `dlo_casadi.load("results/...")` gives a fitted one."""
    data = CableData(length=0.9, mass=0.12, diameter=0.01, bending_stiffness=0.08)
    model = CableModel(data, n=30, element="arc", n_rest=0)
    return CasadiCable(model, model.nominal, np.zeros(model.chain.n_rests))


def easiest(known: CasadiCable, count: int = 20) -> dict[str, np.ndarray]:
    """The way of least peak pull [N]: ends, points, pulls and residuals of its poses."""
    firsts = np.array([np.interp(np.linspace(0, 2, count), [0, 1, 2], row) for row in WAY])
    guesses = [known.initial([0, 0, *end, 0, 0], branch="ccw") for end in firsts.T]
    problem = ca.Opti()
    peak, ends = problem.variable(), problem.variable(2, count)
    x, multipliers = (problem.variable(rows, count) for rows in (guesses[0].x.size, 2))
    problem.set_initial(ends, firsts)
    problem.set_initial(x, np.vstack([guess.x for guess in guesses]).T)
    problem.set_initial(multipliers, np.stack([g.multipliers for g in guesses], axis=1))
    poses, system = ca.vertcat(0 * ends, ends, 0 * ends), known.equations().map(count)
    at = {**system(x=ca.vec(x).T, multipliers=multipliers, pose=poses), "ends": ends}
    steps, at["pulls"] = ends[:, 1:] - ends[:, :-1], ca.sum1(at["end_force"] ** 2) ** 0.5
    problem.minimize(peak + 0.01 * ca.sumsqr(steps))
    problem.subject_to(at["residual"] == 0)
    problem.subject_to(peak >= at["pulls"].T)
    problem.subject_to((count - 1) * ca.sum1(steps**2).T ** 0.5 <= 1.33)  # m, even steps
    problem.subject_to([ends[:, 0] == WAY[:, 0], ends[:, -1] == WAY[:, -1]])
    after, before = at["points"][:, known.model.n + 1 :], at["points"][:, : -known.model.n - 1]
    for *center, radius in DISCS:
        for places in (after, (before + after) / 2):
            apart = ca.sum1((places - ca.DM(center)) ** 2).T
            problem.subject_to(apart >= (radius + known.model.cable.diameter / 2 + GAP) ** 2)
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    done = problem.solve()
    return {name: done.value(at[name]) for name in ("ends", "points", "pulls", "residual")}


if __name__ == "__main__":
    known, (figure, (scene, pulls)) = cable(), plt.subplots(1, 2, figsize=(11, 6.5))
    best, shape = easiest(known), known.function(branch="ccw")
    for *center, radius in DISCS:
        scene.add_patch(plt.Circle(center, radius, color="0.75"))
    for k, points in enumerate(np.split(best["points"], len(best["pulls"]), axis=1)):
        scene.plot(*points, color=plt.get_cmap("viridis_r")(k / len(best["pulls"])))
    for name, way, style in (("least peak", best["ends"], "C3.-"), ("shortest", (X, Y), "k.--")):
        forces = [float(ca.norm_2(shape([0, 0, *end, 0, 0])[1])) for end in np.transpose(way)]
        scene.plot(*way, style, label=f"way of the end: {name}")
        along = [0, *np.linalg.norm(np.diff(way), axis=0).cumsum()]
        pulls.plot(along, forces, style, label=f"{name}: up to {max(forces):.3f} N")
    scene.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    pulls.set(xlabel="along the way [m]", ylabel="pull on the end [N]")
    figure.legend(loc="upper center", ncols=2)
    Path("results").mkdir(exist_ok=True)
    figure.savefig("results/lead_the_end.png", dpi=120)
