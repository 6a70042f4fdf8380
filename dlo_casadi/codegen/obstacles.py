"""Obstacles of a generated solver: how many, and those of the model."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.c_text import c_number
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.contact import surfaces_at
from dlo_casadi.rod.obstacles import Obstacle, Plane


@dataclass(frozen=True)
class Obstacles:
    """Obstacles of a solver: at most `most` per call, and those of the model if a fit has them."""

    most: int = 0
    declared: tuple[Obstacle, ...] = ()

    @classmethod
    def of(cls, model: CableModel, p: FloatArray, most: int) -> Self:
        """Make room for at least the model's own obstacles.

        Raises
        ------
        DloError
            If `most` is not a valid number, or the cable is one of links.
        """
        whole = isinstance(most, int | np.integer) and not isinstance(most, bool)
        if not whole or not 0 <= most <= 1000:
            raise DloError(f"obstacles: a whole number, 0 to 1000, found {most!r}\n  Try: 1")
        if most and not model.chain.kind.smooth:
            raise DloError(
                "a cable of links cannot lie on obstacles\n"
                "  Try: another element, --element quadratic"
            )
        declared = surfaces_at(model, p)
        return cls(max(int(most), len(declared)), declared)

    @property
    def words(self) -> dict[str, str]:
        """Text parts of the templates, by mark; empty for a solver without obstacles."""
        found = {
            "AMONG": "const dlo_obstacle *obstacles, size_t n_obstacles,\n                     ",
            "GIVEN": "obstacles, n_obstacles, ",
            "TAKEN": "take_obstacles(w, obstacles, n_obstacles)",
            "DECLARED_GIVEN": "DECLARED_OBSTACLES, DLO_DECLARED, " if self.declared else "0, 0, ",
            "NO_OBSTACLES": "NULL, 0, ",
            "OBSTACLES_ARE": _SAID,
            "HPP_OBSTACLES": "    std::vector<dlo_obstacle> obstacles; "
            "/* on which the cable may lie */\n\n",
            "HPP_GIVEN": "obstacles.data(), obstacles.size(), ",
            "DECLARED_OBSTACLES": ", ".join(map(_initializer, self.declared)),
        }
        none = dict.fromkeys(found, "") | {"TAKEN": "take_obstacles(w, 0, 0)"}
        return found if self.most else none


# Text about obstacles in the header.
_SAID = """\
 *   obstacles  in   [n_obstacles], rigid and without friction, on which the cable may lie. Where
 *                   the status is DLO_OK the whole cable, its radius and its fixtures are outside
 *                   of them but for 1e-6 of its length. Places at which it touches slide along
 *                   it in derivatives. Along a path it touches down and lifts off without a jump
 *   n_obstacles in  at most DLO_OBSTACLES
"""


def row_of(obstacle: Obstacle) -> tuple[int, tuple[float, ...], tuple[float, ...], float]:
    """Kind, places a and b, and radius of an obstacle: the layout of dlo_obstacle."""
    if isinstance(obstacle, Plane):
        return 1, obstacle.point, obstacle.normal, 0.0
    return 0, obstacle.a, obstacle.b, obstacle.radius


def _initializer(obstacle: Obstacle) -> str:
    """An obstacle as an initialiser of dlo_obstacle."""
    kind, *places, radius = row_of(obstacle)
    a, b = (", ".join(c_number(float(x)) for x in place) for place in places)
    name = ("DLO_CAPSULE", "DLO_HALF_SPACE")[kind]
    return f"{{{name}, {{{a}}}, {{{b}}}, {c_number(radius)}}}"
