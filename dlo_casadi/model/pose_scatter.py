"""Random differences between poses, which also occur when the same pose is taken again."""

from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import Effect, Setup, random_effects
from dlo_casadi.model.cable_model import CableModel

# Number of cosines of a random rest curvature, and its trial correlation lengths as shares of L.
MODES = 8
SMOOTHNESS = (0.5, 0.25, 0.12)
REST_CURVATURE = "rest_curvature"
# Largest standard deviation of a rest curvature that is one, in radians over the length: twice that
# of the least repeatable cables measured, 0.3 1/m on 0.65 m. A scatter fits everything; larger ones
# were the errors of fits that had been lost (0.44 and 0.66).
MOST_BEND = 0.4


@dataclass(frozen=True)
class PoseScatter:
    """One random quantity of each pose: normally distributed, zero on average.

    Parameters
    ----------
    std : float
        Standard deviation of each component; 0 if the cable repeats. For a rest curvature [1/m]
        the root mean square along the cable; for a pin the moment over EI [1/m].
    smoothness : float
        Correlation length of a rest curvature, as a share of the cable's.
    dof : float
        Degrees of freedom of the chi-square distribution of the estimated variance.
    source : str
        `rest_curvature`, or the name of one of `random_effects`, whose parameters differ.
    rivals : tuple of PoseScatter
        Other random quantities that the data cannot distinguish from it.
    shown : bool
        Whether the data show it; if not, poses have too few points to exclude it.
    """

    std: float = 0.0
    smoothness: float = SMOOTHNESS[0]
    dof: float = np.inf
    source: str = REST_CURVATURE
    rivals: tuple["PoseScatter", ...] = ()
    shown: bool = True

    def sizes(self, count: int) -> FloatArray:
        """Standard deviations (count,) along the directions of `ways`."""
        if self.source != REST_CURVATURE:
            return np.full(count, self.std)
        share = np.exp(-((np.arange(MODES) * np.pi * self.smoothness) ** 2) / 2)
        return np.tile(self.std * np.sqrt(share / share.sum()), count // MODES)

    @property
    def rest_std(self) -> float:
        """Standard deviation of the rest curvature [1/m]."""
        return self.std if self.source == REST_CURVATURE else 0.0

    @property
    def words(self) -> str:
        """What each pose has of its own, in words."""
        known = random_effects().get(self.source)
        return known.at_random if known else "a rest curvature of its own"

    @property
    def of_moments(self) -> bool:
        """Whether it is of moments, which `std` gives per bending stiffness [1/m]."""
        kind = random_effects().get(self.source)
        return kind is not None and kind.per_stiffness

    def most(self, model: CableModel) -> float:
        """Largest `std` that counts as a scatter, see MOST_BEND."""
        return MOST_BEND / model.cable.length if self.source == REST_CURVATURE else np.inf

    def unit(self, model: CableModel) -> str:
        """Unit of `std`."""
        effect = effect_of(self.source, model)
        return "1/m" if effect is None else effect.parameters(model.cable)[0].unit

    def size(self, model: CableModel, stiffness: float) -> tuple[float, str]:
        """Standard deviation and unit as shown to users: of moments in N m, EI times `std`."""
        if self.of_moments:
            return self.std * stiffness, "N m"
        return self.std, self.unit(model)

    def deviations(self, model: CableModel) -> tuple[str, ...]:
        """Names of the deviations that it varies in `within(model)`; none for a rest curvature."""
        effect = effect_of(self.source, model)
        if effect is None:
            return ()
        names = (q.name for q in effect.parameters(model.cable))
        return tuple(effect.as_deviation.get(x, f"{effect.label}.{x}") for x in names)

    def within(self, model: CableModel) -> CableModel:
        """Return the model whose poses have the deviations that it varies: a larger one, or it."""
        effect = effect_of(self.source, model)
        if effect is None or {*self.deviations(model)} <= {*model.deviation_names}:
            return model
        both = sorted((*model.random, effect), key=lambda one: one.label)
        return replace(model, random=tuple(both))

    def ways(self, model: CableModel) -> tuple[FloatArray, FloatArray]:
        """Directions (n_deviations, q), (n_rests, q) of deviations and rests of `within(model)`.

        Each changes one component by a unit.
        """
        names, own = self.within(model).deviation_names, self.deviations(model)
        none = np.zeros((model.chain.n_rests, len(own)))
        modes = modes_in(model) if self.source == REST_CURVATURE else none
        by_deviation = np.zeros((len(names), modes.shape[1]))
        by_deviation[[names.index(name) for name in own], range(len(own))] = 1.0
        return by_deviation, modes


def sources_in(model: CableModel) -> list[str]:
    """Names of the effects that may differ from pose to pose, besides the rest curvature."""
    return [name for name in random_effects() if effect_of(name, model) is not None]


def effect_of(source: str, model: CableModel) -> Effect | None:
    """The random effect of that name, with options for a model; None if it does not apply."""
    setup = Setup(model.cable, model.start, model.end, model.gravity)
    kind = random_effects().get(source)
    if kind is None or not kind.applies(setup):
        return None
    # The model may also have that effect as one of all poses.
    return replace(kind.made_for(setup), label=f"{source}_from_pose_to_pose")


def modes_in(model: CableModel) -> FloatArray:
    """Modes (n_rests, axes MODES) of the rest curvature of a single pose, in a model's cells."""
    axes = np.eye(len(model.node.strains))[:, -len(model.node.curvatures) :]
    return np.kron(axes, modes_of(model.chain.cells, model.cable.length))


def modes_of(cells: FloatArray, length: float) -> FloatArray:
    """Means of the modes f_k over cells (n_cells, 2) [m]: (n_cells, MODES)."""
    k = np.arange(1, MODES)
    primitive = np.sin(np.pi / length * np.multiply.outer(cells, k)) * length / (k * np.pi)
    waves = (primitive[:, 1] - primitive[:, 0]) / (cells[:, 1] - cells[:, 0])[:, None]
    return np.column_stack([np.ones(len(cells)), np.sqrt(2.0) * waves])
