"""What the paper printed: its cable, its poses, its tables.

Quartaro, Moser, Cooper, Komendera, Front. Robot. AI 12:1565837 (2025), CC BY; see data/LICENSE.txt.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel

FloatArray = NDArray[np.floating]

DATA = Path(__file__).parent / "data"
# Table 2, but for the length: 0.812 m is rounded from 0.8125 m, as Table 4's energies show.
LENGTH, MASS, DIAMETER = 0.8125, 0.23, 0.0128
GRAVITY = (0.0, -9.81)
# Table 2: k_theta = 94.956 n [N m/rad], that is EI = 94.956 L [N m^2] on any mesh.
K_THETA_PER_LINK = 94.956
STIFFNESS = K_THETA_PER_LINK * LENGTH
# Links of Tables 3 and 4, and the meshes of Table 5.
LINKS = 10
MESHES = (5, 10, 20, 35, 50, 81)
# Places in Table 4 of the two poses that Table 6 predicts.
HELD_OUT = (3, 6)
INCH = 0.0254


def table(number: int) -> list[dict[str, float]]:
    """Rows of a table with numbers only."""
    with (DATA / f"table{number}.csv").open() as file:
        return [{name: float(text) for name, text in row.items()} for row in csv.DictReader(file)]


def rest_angles() -> FloatArray:
    """theta_0 of Table 3 after the estimate (9,) [rad], at the interior joints of ten links."""
    with (DATA / "table3.csv").open() as file:
        final = next(row for row in csv.DictReader(file) if row["parameter"] == "final")
    return np.array([float(final[f"theta_0_{i}"]) for i in range(2, LINKS + 1)])


def poses() -> list[HeldPose]:
    """The twelve poses of Table 4 on the grid of one inch from which it was rounded.

    The branch is that of the printed energies: counter-clockwise from start to end.
    """
    rows = table(4)
    ends = [(INCH * row["grid_x"], INCH * row["grid_y"]) for row in rows]
    return [HeldPose((0.0, 0.0), end, branch="ccw", name=label(end)) for end in ends]


def label(end: tuple[float, float]) -> str:
    """End position [m] as it is printed."""
    return f"({end[0]:.2f}, {end[1]:.2f})".replace("-0.00", "0.00").replace("-", "−")


def cable(stiffness: float = STIFFNESS) -> CableData:
    """The paper's cable with a bending stiffness [N m^2]."""
    return CableData(LENGTH, MASS, DIAMETER, stiffness)


@dataclass(frozen=True)
class RestShape:
    """Rest curvature of Table 3 on any mesh.

    Parameters
    ----------
    angles : (9,) [rad]
        theta_0 at the interior joints of ten links. Between them theta_0 / h is interpolated by
        a cubic spline that vanishes at both pins, whose angles the paper does not estimate.
    """

    angles: FloatArray

    @property
    def curvature(self) -> CubicSpline:
        """kappa_0(s) [1/m]."""
        joints = np.linspace(0.0, LENGTH, LINKS + 1)
        return CubicSpline(joints, np.concatenate([[0.0], self.angles, [0.0]]) * LINKS / LENGTH)

    def on(self, model: CableModel) -> FloatArray:
        """Means over a model's bending cells (n_cells,) [1/m]."""
        turn = self.curvature.antiderivative()
        cells = model.chain.cells
        return (turn(cells[:, 1]) - turn(cells[:, 0])) / np.diff(cells, axis=1).ravel()
