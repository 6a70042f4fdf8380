"""A pinned cable has two stable shapes, bowed either way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.show.style import BLUE, ORANGE
from paper import published
from paper.content import Claim, Part, Section, Table, drawing, number
from paper.replica import REVEALING

FloatArray = NDArray[np.floating]


def add(part: Part) -> None:
    """Both shapes of every pose, with the printed parameters and for the limper cable."""
    section = Section("second-equilibrium", "The second equilibrium")
    part.sections.append(section)
    cases = [
        ("α⁰, EI = 77", published.STIFFNESS, False),
        ("αᶠ, EI = 77", published.STIFFNESS, True),
        ("αᶠ, EI = 0.3", REVEALING, True),
    ]
    found = {name: _both_ways(stiffness, bent) for name, stiffness, bent in cases}
    rows = []
    for k, pose in enumerate(published.poses()):
        cells = [pose.name]
        for pairs in found.values():
            cells += [number(energy) for energy in pairs[k][0]]
        rows.append(cells)
    section.tables.append(
        Table(
            "Energy [J] of the stable equilibria that turn counter-clockwise and clockwise; "
            "nothing where there is none",
            ["end [m]", *(["ccw", "cw"] * len(cases))],
            rows,
            groups=[("", 1), *((name, 2) for name in found)],
        )
    )
    counts = {
        name: sum(None not in energies for energies, _ in pairs) for name, pairs in found.items()
    }
    gap = max(abs(e[1] - e[0]) for e, _ in found["α⁰, EI = 77"] if None not in e)
    where = ", ".join(f"{count} of 12 poses ({name})" for name, count in counts.items())
    section.text = [
        "The paper says that gravity leaves one solution of Eq. 8. Two stable ones, bowed either "
        f"way, exist in {where}; "
        f"at α⁰ their energies differ by at most {gap:.2f} J of up to 490 J. Which one a local "
        "solver finds depends on its start, so a prediction must name the branch or compare "
        "both, as is done here.",
    ]
    _draw_branches(section, found)
    part.data["stable_on_both_sides"] = counts
    part.claims.append(
        Claim(
            "Section 2.2.1",
            "gravity results in one solution",
            f"two stable equilibria in {counts['α⁰, EI = 77']} of 12 poses at α⁰",
            "does not hold",
        )
    )


def _both_ways(
    stiffness: float, bent: bool
) -> list[tuple[list[float | None], list[FloatArray | None]]]:
    """Energies and shapes of both branches of every pose; None where one has no equilibrium."""
    model = CableModel(published.cable(stiffness), n=20, element="arc")
    rest = published.RestShape(published.rest_angles() * bent).on(model)
    out = []
    for pose in published.poses():
        energies: list[float | None] = []
        shapes: list[FloatArray | None] = []
        for branch, sign in (("ccw", 1), ("cw", -1)):
            side = replace(pose, branch="ccw" if branch == "ccw" else "cw")
            try:
                eq = solve_equilibrium(model, model.nominal, rest, side)
            except EquilibriumError:
                eq = None
            there = eq is not None and eq.stable and sign * (eq.phi[-1] - eq.phi[0]) > 0
            energies.append(eq.energy if eq is not None and there else None)
            shapes.append(eq.points if eq is not None and there else None)
        out.append((energies, shapes))
    return out


def _draw_branches(
    section: Section,
    found: dict[str, list[tuple[list[float | None], list[FloatArray | None]]]],
) -> None:
    caption = "Both stable shapes in the pose (0.51, 0.10) m: counter-clockwise, and clockwise."
    with drawing(section, "branches", caption, (8.6, 3.6)) as figure:
        for axes, (name, pairs) in zip(
            figure.subplots(1, len(found), sharey=True), found.items(), strict=True
        ):
            for points, color, label in zip(
                pairs[2][1], (BLUE, ORANGE), ("ccw", "cw"), strict=True
            ):
                if points is not None:
                    axes.plot(*points.T, color=color, label=label)
            axes.set_aspect("equal")
            axes.set_title(name)
            axes.set_xlabel("x [m]")
        figure.axes[0].set_ylabel("y [m]")
        figure.axes[0].legend()
