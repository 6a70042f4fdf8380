"""What sensors read on whatever holds a cable: forces and moments, a row each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class Quantity:
    """One kind of reading; the names of its readings end with its own, such as `end_force`.

    Parameters
    ----------
    name, unit : str
    others : mapping of str to float
        Other units in which users may write it, and their number per unit.
    turning : bool
        Whether it turns a cable: a moment about one axis in a plane, three in space, forces times a
        lever arm. A force has a component along each axis.
    """

    name: str
    unit: str
    others: Mapping[str, float]
    turning: bool

    @property
    def std_key(self) -> str:
        """Key of its noise in `experiment.measurement`: one standard deviation of a component."""
        return f"{self.name}_std"

    @property
    def bias_key(self) -> str:
        """Key of the offset of its sensors in `experiment.tolerances`."""
        return f"{self.name}_bias"

    def components(self, axes: Sequence[str]) -> tuple[str, ...]:
        """Names of its components in a plane or in space, of two or three axes; one has none."""
        return ("",) if self.turning and len(axes) == 2 else tuple(axes)

    def written(self, axes: Sequence[str]) -> str:
        """How a configuration gives it, such as [fx, fy]."""
        names = [f"{self.name[0]}{axis}" for axis in self.components(axes)]
        return f"[{', '.join(names)}]" if len(names) > 1 else "one number"

    def scale(self, force: float, arm: float) -> float:
        """Its usual size where forces are of the size `force` [N], and lever arms of `arm` [m]."""
        return force * arm if self.turning else force


FORCE = Quantity(
    "force", "N", {"grams-force": 101.97, "kilograms-force": 0.10197, "millinewtons": 1e3}, False
)
MOMENT = Quantity("moment", "N m", {"N mm": 1e3, "N cm": 1e2, "kgf cm": 10.197}, True)
QUANTITIES = (FORCE, MOMENT)


def quantity_of(reading: str) -> Quantity:
    """What a reading is of, by its name."""
    return next(x for x in QUANTITIES if reading.endswith(x.name))
