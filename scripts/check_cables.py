"""Random cables against an oracle: python scripts/check_cables.py [--held clips] [--count 100] ...

`--held clips`: one to four clips of all kinds, in the plane and in space, against minima that IPOPT
finds from starts of its own; one shape against scipy's solve_bvp with an interior point. `--held
obstacles`: one to three obstacles against IPOPT with inequalities on the same energy, from our
shape, from that without obstacles, from the documented guesses and from random shapes; closed
forms of a heavy beam laid on a table, a cable over a cylinder, a rod between walls. `--held
obstacles-in-c`: the generated C solver, see cables/in_c.py. `--held slides-in-c`: cables fed
through an end, C beside Python, see cables/fed.py. Cables that differ are listed by their
numbers; --only tries one of them alone. With a folder of sessions (--fixtures), what their fits say
beside the truth next to it.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from cables import closed_forms, fed, in_c
from cables.draw import Case, Draw, drawn, with_clips, with_obstacles
from cables.in_c import LIGHTEST
from cables.ipopt import Ipopt
from harness import options, run

import dlo_casadi as dlo
from dlo_casadi.config import read_yaml
from dlo_casadi.equilibrium.by_ipopt import by_ipopt
from dlo_casadi.equilibrium.equilibrium import NEARBY, Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.equilibrium.spans import first_guesses
from dlo_casadi.model.cable_model import CableModel

# Least difference of energies that are not the same, relative to m g L + EI/L.
SAME_ENERGY = 1e-8


@dataclass
class Row:
    """What a cable counts for, what is wrong with it, and seconds of ours."""

    number: int
    counts: list[str] = field(default_factory=lambda: ["cables"])
    wrong: set[str] = field(default_factory=set)
    apart: float = 0.0
    seconds: float = 0.0
    detail: str = ""


def ours(case: Case) -> tuple[Equilibrium | None, Row]:
    """Our equilibrium of a case, and the row that it begins."""
    row, begin, model = Row(case.number), time.process_time(), case.model
    rest = np.zeros(model.chain.n_rests)
    (eq,) = solve_equilibria(model, model.nominal, rest, [case.pose])
    row.seconds, row.detail = time.process_time() - begin, str(case.pose)
    if not isinstance(eq, Equilibrium):
        row.detail += f"\n{eq.message}"
        return None, row
    row.counts += ["solved"] + ["touching"] * bool(eq.contacts)
    row.detail += f"\nours {eq.energy:.9g} J"
    return eq, row


def at_clips(case: Case, ipopt: bool) -> Row:
    """Our energy beside stable minima that IPOPT finds."""
    eq, row = ours(case)
    minima = list(minima_of(case)) if ipopt else []
    row.counts += ["by IPOPT"] * bool(minima)
    row.detail += f"\nIPOPT {minima}"
    here = np.inf if eq is None else eq.energy
    what = {
        "not a minimum": eq is not None and not eq.stable,
        "IPOPT alone": bool(minima) and eq is None,
        "IPOPT lower": eq is not None
        and min(minima, default=here) < here - 1e-8 * abs(here) - 1e-12,
        "neither": not (eq or minima),
    }
    row.wrong |= {name for name, so in what.items() if so}
    return row


def minima_of(case: Case) -> Iterator[float]:
    """Energies [J] of stable minima that IPOPT finds."""
    model, pose, rest = case.model, case.pose, np.zeros(case.model.chain.n_rests)
    if not model.in_space:
        found = [by_ipopt(model, model.nominal, rest, pose, x[:, 0]) for x in case.starts]
        yield from (own.energy for own in found if own is not None and own.stable)
        return
    solver = Ipopt(model)
    for one in solver.solve(model.nominal, rest, pose, case.starts, case.slid):
        (eq,) = solve_equilibria(model, model.nominal, rest, [pose], [one.frames])
        same = isinstance(eq, Equilibrium) and np.isclose(eq.energy, one.energy, rtol=1e-6)
        if same and eq.stable:
            yield eq.energy


def at_obstacles(case: Case) -> Row:
    """Our energy beside IPOPT's, see `Ipopt`.

    Energies are compared as shares of m g L + EI/L. An IPOPT shape of lower energy counts where
    Newton's method from there finds the same, stable, and apart where both shapes are one on a
    finer mesh.
    """
    eq, row = ours(case)
    model, pose, here = case.model, case.pose, np.inf
    p, rest = model.nominal, np.zeros(model.chain.n_rests)
    scale = model.cable.mass * 9.81 * model.cable.length + model.cable.bending_stiffness
    solver = Ipopt(model)
    if eq is not None:
        here = eq.energy
        for one in solver.solve(p, rest, pose, [eq.x]):
            pressed = -one.multipliers[-model.n_contacts :], eq.multipliers[model.n_lam :]
            first, second = (force > LIGHTEST * scale for force in pressed)
            if np.array_equal(first, second):
                row.counts.append("same contacts")
                row.apart = max(row.apart, abs(one.energy - here) / scale)
        row.wrong |= {"another energy"} if row.apart > SAME_ENERGY else set()
    hung, *others = case.starts
    starts = [hung, *(x for x, _ in first_guesses(model, p, rest, pose)), *others]
    every = list(solver.solve(p, rest, pose, starts))
    row.counts += ["by IPOPT"] * bool(every)
    low = [one for one in every if one.energy < here - SAME_ENERGY * scale]
    again = solve_equilibria(model, p, rest, [pose] * len(low), [one.frames for one in low])
    for one, other in zip(low, again, strict=True):
        if not isinstance(other, Equilibrium) or not other.stable:
            continue
        if abs(other.energy - one.energy) < 1e-6 * scale:
            what = "IPOPT alone" if eq is None else "IPOPT lower"
            if eq is not None and same_on_finer(model, pose, [eq.x, other.x]):
                what = "IPOPT lower, but the same on a finer mesh"
            row.wrong.add(what)
            row.detail += f"\n{what}: {one.energy:.9g} J"
    return row


def same_on_finer(model: CableModel, pose: HeldPose, found: list[np.ndarray]) -> bool:
    """Whether shapes (n_nodes, coordinates) lead to the same one on elements half as long.

    Nodes that touch a bar hold it like a notch: several minima on 30 elements were one on 60.
    """
    finer, places = model.with_mesh(2 * model.n), model.chain.places
    starts = [model.node.interpolated(finer.chain.places, places, x) for x in found]
    rest = np.zeros(finer.chain.n_rests)
    first, *others = solve_equilibria(finer, finer.nominal, rest, [pose] * len(starts), starts)
    return isinstance(first, Equilibrium) and all(
        isinstance(one, Equilibrium) and model.node.same(first.x, one.x, NEARBY) for one in others
    )


def check_random(draw: Draw, work: partial[Row], chosen: argparse.Namespace, where: str) -> None:
    """Count what is solved, and list what is not as it should be."""
    begin = time.process_time()
    cases = drawn(draw, chosen.count, where == "space", chosen.seed, chosen.only)
    rows = run(work, cases, chosen, lambda case, row, seconds: row.detail if chosen.only else "")
    found = Counter(name for row in rows for name in row.counts)
    wrong = {
        name: [row.number for row in rows if name in row.wrong]
        for name in sorted({name for row in rows for name in row.wrong})
    }
    said = "in space" if where == "space" else "in a plane"
    print(
        f"{said}: {dict(found)}; {wrong}; energies differ by at most "
        f"{max(row.apart for row in rows):.1e}; {time.process_time() - begin:.0f} s, "
        f"{sum(row.seconds for row in rows):.0f} s of them ours",
        flush=True,
    )


def check_fixtures(folder: Path) -> None:
    """What fits of sessions say, beside the truth."""
    for session in sorted(folder.glob("*/session.yaml")):
        beside = folder.parent / f"{folder.name}_truth" / session.parent.name / "truth.yaml"
        if not beside.is_file():
            continue
        truth, began, result = read_yaml(beside), time.process_time(), dlo.fit(session)
        print(f"{session.parent.name}: {result.summary()}")
        print({k: v for k, v in truth.items() if k != "poses"})
        at = [pose.get("clip_at", ()) for pose in truth.get("poses", ())]
        true = {f"pose_{k:02d}": row for k, row in enumerate(at, 1) if row}
        shapes = result.stages[-1].shapes
        off = [
            abs(clip["at"] - s)
            for name in shapes.keys() & true.keys()
            for clip, s in zip(shapes[name].clips, true[name], strict=True)
        ]
        if off:
            lost = sorted(true.keys() - shapes.keys())
            print(f"arc lengths off by at most {1e3 * max(off):.2f} mm; without a shape: {lost}")
        print(f"{time.process_time() - began:.0f} s", flush=True)


HELD = ("clips", "obstacles", "obstacles-in-c", "slides-in-c")


def main() -> None:
    """Run the checks that are asked for."""
    parser = options(
        __doc__,
        count=(100, "random cables of each dimension; in C random poses of each kind"),
        seed=0,
        where=True,
        only="of one random cable",
        jobs=True,
        output=True,
    )
    parser.add_argument("--held", nargs="+", choices=HELD, default=["clips", "obstacles"])
    parser.add_argument("--no-ipopt", action="store_true", help="of clips, what is solved alone")
    parser.add_argument("--fixtures", type=Path, help="folder of sessions, its truth beside it")
    in_c.add_options(parser)
    chosen = parser.parse_args()
    if "clips" in chosen.held:
        if chosen.only is None:
            closed_forms.check_bvp()
        for where in chosen.where:
            work = partial(at_clips, ipopt=not chosen.no_ipopt)
            check_random(with_clips, work, chosen, where)
    if "obstacles" in chosen.held:
        if chosen.only is None:
            closed_forms.check_beam()
            closed_forms.check_cylinder()
            closed_forms.check_rod()
        for where in chosen.where:
            check_random(with_obstacles, partial(at_obstacles), chosen, where)
    if "obstacles-in-c" in chosen.held:
        cases = [(where, kinds) for where in chosen.where for kinds in chosen.kinds]
        run(partial(in_c.check, chosen=chosen), cases, chosen, lambda case, text, seconds: text)
    if "slides-in-c" in chosen.held:
        work = partial(fed.check, count=chosen.count, seed=chosen.seed)
        both = [(where, clips) for where in chosen.where for clips in (False, True)]
        run(work, both, chosen, lambda case, text, seconds: text)
    if chosen.fixtures is not None:
        check_fixtures(chosen.fixtures)


if __name__ == "__main__":
    main()
