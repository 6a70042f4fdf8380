"""A cable with what is known of it: its fitted values and their errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from dlo_casadi.cable.estimate import Covariance, Estimate, Metadata, Named
from dlo_casadi.cable.limits import Asked
from dlo_casadi.cable.placing import Aim, Placing, placed
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import counted


@dataclass(frozen=True, eq=False)
class KnownCable(CasadiCable):
    """The model of a cable with its fitted values, and what is known of their errors.

    Parameters
    ----------
    metadata : Metadata
    """

    metadata: Metadata

    def __repr__(self) -> str:
        mesh = counted(self.model.n, f"{self.model.element} element")
        rows = (f"  {name}: {x}" for name, x in self.params.items() if not x.fixed)
        return "\n".join([f"<FittedCable {self.name!r}: {self.length:g} m, {mesh}>", *rows])

    @property
    def name(self) -> str:
        """What the cable is called."""
        return self.model.cable.name

    @property
    def params(self) -> dict[str, Estimate]:
        """All parameters of the model by name, as they were estimated."""
        return Named(self.metadata.params)

    @property
    def covariance(self) -> Covariance:
        """Covariance of all fitted parameters by their names."""
        return self.metadata.covariance

    @property
    def length(self) -> float:
        """Length [m] as declared."""
        return self.model.cable.length

    def place(
        self,
        count: int,
        poses: Sequence[Mapping[str, Any]],
        within: ArrayLike,
        limits: Asked = None,
        *,
        aim: Aim = "margin",
    ) -> Placing:
        """Find arc lengths and places of pinned clips that suit all of some poses of the ends.

        The least of what limits leave in any pose is made as large as it can be, or the greatest
        force on all fixtures and clips as small as limits allow. The shapes are the stable ones of
        lowest energy. From several first guesses the best is taken: others may be better still.

        Parameters
        ----------
        count : int
            Number of clips.
        poses : sequence of mapping
            How the ends are held in each pose, as keywords of `solve`: [{"end": (0.3, -0.1)}, ...].
        within : ((d,), (d,)) [m]
            Two corners of the region in which clips may be: least and greatest coordinates. A wall
            has the same coordinate in both.
        limits : Limits or mapping, optional
            As of `Shape.check`; the session's by default.
        aim : "margin" or "force"
            What is sought; for "force" there may be no limits.

        Raises
        ------
        DloError
            If no clips in the region keep the limits, an argument has no meaning for this cable, or
            a span has no room.
        EquilibriumError
            If the cable has no shape in a pose without clips.
        """
        return placed(self, self.metadata, count, poses, within, limits, aim)
