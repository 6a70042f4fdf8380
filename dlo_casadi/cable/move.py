"""A motion of the fixtures after which a cable is at rest, as a result."""

from __future__ import annotations

import json
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.move_checks import held_by, number, table_file
from dlo_casadi.cable.moving_picture import draw_move
from dlo_casadi.cable.simulated import Motion
from dlo_casadi.io.files import write_file
from dlo_casadi.planning.course import Course
from dlo_casadi.planning.problem import CLEAR

# Rate [1/s] of tables for robots, unless asked otherwise.
RATE = 250.0
# Swing [lengths] from which it is told that limits cause it.
_STILL = 1e-3


@dataclass(frozen=True, eq=False)
class Move:
    """A motion of the fixtures after which the cable is at rest.

    Parameters
    ----------
    duration : float [s]
    motion : Motion
        The cable under it, by a fine simulation, and one period of its slowest mode beyond.
    rest : (101, d) [m]
        Where the cable comes to rest.
    swings : dict
        Of this motion ("planned"), of least jerk ("minimum jerk") and of that shaped to leave out
        the slowest mode ("zero vibration", if the duration allows it), both without limits: root
        of the mean square [m] of the distance from rest, over all points and one period after
        arrival.
    band : (float, float) [m]
        5 % and 95 % quantiles of the swing under the parameters' covariance; of a cable without
        one both are the swing.
    limits, used : dict
        What was asked, and the largest used share of each along the way, 1 at the limit; of a
        clearance one less for each twentieth of the length beyond it.
    steps : int
        Of IPOPT.
    """

    duration: float
    motion: Motion
    rest: FloatArray
    swings: dict[str, float]
    band: tuple[float, float]
    limits: dict[str, float]
    used: dict[str, float]
    steps: int
    course: Course
    theta: FloatArray

    @property
    def swing(self) -> float:
        """Of this motion [m], see `swings`."""
        return self.swings["planned"]

    @property
    def active(self) -> list[str]:
        """Limits that the motion uses to 99 % or more."""
        return [name for name, share in self.used.items() if share > 0.99]

    def table(self, rate: float = RATE) -> dict[str, FloatArray]:
        """Where the fixtures are, as arguments of `simulate`, at `t` (N,) [s].

        `start`, `end` (N, d) [m], and their headings (N,) [rad] or orientations (N, 4), of what is
        held. Raises DloError if `rate` [1/s] is none.
        """
        rate = number("rate", rate)
        count = max(int(np.ceil(self.duration * rate - 1e-9)), 1)
        t = np.minimum(np.arange(count + 1) / rate, self.duration)
        rest = {name: np.tile(x, (len(t), 1)) for name, x in held_by(self.course.before).items()}
        rest = {name: x[:, 0] if name.endswith("heading") else x for name, x in rest.items()}
        return {"t": t, **rest, **rows_of(self.course, self.course.values(self.theta, t))}

    def save(self, path: str | PathLike[str], *, rate: float = RATE) -> Path:
        """Write the table as CSV, or all as JSON; `dlo simulate` reads the CSV.

        Raises
        ------
        DloError
            If the name ends in neither .csv nor .json, or if the file cannot be written.
        """
        file, table = table_file(path), self.table(rate)
        if file.suffix.lower() == ".json":
            rows = {name: x.tolist() for name, x in table.items()}
            write_file(file, json.dumps({**self.as_dict(), "table": rows}, indent=1) + "\n")
            return file
        node, names, columns = self.motion.cable.model.node, ["t_s"], [table.pop("t")[:, None]]
        for key, values in table.items():
            side, _, direction = key.partition("_")
            own = node.columns if direction else [f"{axis}_m" for axis in node.axes]
            names += [f"{side}_{x}" for x in own]
            columns.append(values.reshape((len(values), -1)))
        lines = (",".join(f"{x:.9g}" for x in row) for row in np.hstack(columns).tolist())
        write_file(file, "\n".join([",".join(names), *lines, ""]))
        return file

    def as_dict(self) -> dict[str, Any]:
        """Duration, swings, band and limits as plain data."""
        own = {"duration": self.duration, "swings": self.swings, "band": list(self.band)}
        return {**own, "limits": self.limits, "used": self.used, "steps": self.steps}

    def plot(self) -> Figure:
        """Draw the motion, and its swing beside those of the other ones."""
        names = {name: 1e3 * x for name, x in self.swings.items()}
        return draw_move(self.motion.points, self.motion.t, self.duration, names)

    def animate(self, path: str | PathLike[str]) -> Path:
        """Write the motion in real time as a GIF, see `Motion.animate`."""
        return self.motion.animate(path)

    def __repr__(self) -> str:
        rows = [f"{name:16}{1e3 * x:10.3f} mm" for name, x in self.swings.items()]
        low, high = (1e3 * x for x in self.band)
        rows.append(f"{'90 % band':16}{low:10.3f} to {high:.3f} mm")
        for name, x in self.used.items():
            if name == "clearance":
                gap = self.limits[name] + (1 - x) * CLEAR * self.motion.cable.length
                rows.append(f"{name:16}{1e3 * gap:10.3g} mm, {1e3 * self.limits[name]:g} asked")
            else:
                rows.append(f"{name:16}{100 * x:10.1f} % of its limit")
        if self.active and self.swing > _STILL * self.motion.cable.length:
            rows.append(f"the limit of {' and '.join(self.active)} leaves a swing: take longer")
        return "\n".join([f"{self.duration:.4g} s; swing after arrival:", *rows])


def rows_of(course: Course, values: FloatArray) -> dict[str, FloatArray]:
    """Arguments of `simulate` of coordinates (N, C)."""
    direction = course.before.node.direction
    rows = {name.replace("frame", direction): x for name, x in course.rows_of(values).items()}
    return {name: x[:, 0] if name.endswith("heading") else x for name, x in rows.items()}
