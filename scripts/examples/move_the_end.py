"""The quickest motion of a cable's end on which it never pulls harder than a limit, by rockit.

    pip install "dlo-casadi[examples]"
    python scripts/examples/move_the_end.py        draws results/move_the_end.png

The cable is a path constraint like any other, stated twice by the generated C, which
`casadi.external` loads: as the search in `cable.function()`, with an exact Hessian, and alone.
"""

from pathlib import Path
from tempfile import mkdtemp
from time import perf_counter

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
import rockit

from dlo_casadi.codegen import generate
from dlo_casadi.codegen.compiler import compile_library
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.model.cable_model import CableModel

START, GOAL = (0.65, -0.45), (0.3, 0.5)  # m
FASTEST, LIMIT = 2.0, 1.1  # m/s^2, N


def cable() -> CasadiCable:
    """0.9 m between pins; `dlo_casadi.load("results/...")` gives a fitted one."""
    data = CableData(length=0.9, mass=0.12, diameter=0.01, bending_stiffness=0.08)
    model = CableModel(data, n=24, element="arc", n_rest=0)
    return CasadiCable(model, model.nominal, np.zeros(model.chain.n_rests))


def quickest(shape: ca.Function, limit: float, hessian: str) -> tuple[np.ndarray, ...]:
    """Times (21,) [s], ends (21, 2) [m], pulls (21,) [N] of the motion; `hessian` as in IPOPT."""
    motion = rockit.Ocp(T=rockit.FreeTime(2.0))
    end, speed, push = motion.state(2), motion.state(2), motion.control(2)
    pull = ca.norm_2(shape(pose=ca.vertcat(0, 0, end, 0, 0))["end_force"])
    motion.set_der(end, speed)
    motion.set_der(speed, push)
    motion.subject_to(ca.sumsqr(push) <= FASTEST**2)
    motion.subject_to(pull <= limit)
    for place, here in ((START, motion.at_t0), (GOAL, motion.at_tf)):
        motion.subject_to(here(ca.vertcat(end, speed)) == ca.DM([*place, 0, 0]))
    motion.set_initial(end, ca.DM(START) + motion.t / 2.0 * (ca.DM(GOAL) - ca.DM(START)))
    motion.add_objective(motion.T)
    own = {"print_level": 0, "sb": "yes", "hessian_approximation": hessian}
    motion.solver("ipopt", {"print_time": False, "show_eval_warnings": False, "ipopt": own})
    motion.method(rockit.MultipleShooting(N=20))
    done = motion.solve()
    return *done.sample(end, grid="control"), done.sample(pull, grid="control")[1]


if __name__ == "__main__":
    known, folder = cable(), Path(mkdtemp())
    library = compile_library(generate(known.model, known.p, known.rest), folder)
    search, alone = (ca.external(f"dlo_{f}_ccw", str(library)) for f in ("equilibrium", "cable"))
    shape = known.function(search=search)
    figure, (scene, pulls) = plt.subplots(1, 2, figsize=(11, 6), layout="constrained")
    for name, style, arguments in (
        ("at any pull", "k--", (shape, np.inf, "exact")),
        (f"below {LIMIT} N, with Hessian", "C3.-", (shape, LIMIT, "exact")),
        (f"below {LIMIT} N, C alone", "C0x", (alone, LIMIT, "limited-memory")),
    ):
        begun = perf_counter()
        t, ends, forces = quickest(*arguments)
        print(f"{name}: {t[-1]:.4f} s, found in {perf_counter() - begun:.1f} s")
        scene.plot(*ends.T, style, label=name)
        pulls.plot(t, forces, style, label=f"{name}: {t[-1]:.3f} s")
    for k, end in enumerate(ends):
        points = np.array(shape([0, 0, *end, 0, 0])[0])
        scene.plot(*points, color=plt.get_cmap("viridis_r")(k / 20), lw=1, zorder=0)
    scene.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="The end's way, and shapes")
    pulls.set(xlabel="time [s]", title="Pull on the end [N]", yticks=[0.8, 0.9, 1, LIMIT, 1.2, 1.3])
    pulls.legend()
    Path("results").mkdir(exist_ok=True)
    figure.savefig("results/move_the_end.png", dpi=120)
