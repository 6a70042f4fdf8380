"""CableModel: a cable with mesh, boundaries and effects; tolerances of declared values."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.effects import (
    CableData,
    ContactEffect,
    Effect,
    Kinematics,
    Load,
    SectionLaw,
    StateEffect,
)
from dlo_casadi.effects.cable import STIFFNESS_BOUNDS, Parameter
from dlo_casadi.errors import DloError, counted
from dlo_casadi.model.clips import clip_size
from dlo_casadi.rod.chain import DEFAULT_ELEMENT, Chain, RestCurvature
from dlo_casadi.rod.ends import EndConditions, deviation_names
from dlo_casadi.rod.node import NODES, Node
from dlo_casadi.rod.obstacles import Capsule, Obstacle
from dlo_casadi.rod.supports import SupportKind

BENDING_STIFFNESS = "bending_stiffness"
# Prior std of log EI, ln(1000): a first guess may be wrong by three decades.
STIFFNESS_PRIOR_STD = float(np.log(1e3))
# Prior std of log(GJ / EI), ln(3): a solid round rod has 1 / (1 + nu), strands differ.
STIFFNESS_RATIO_STD = float(np.log(3.0))
# Prior std of the end roll [rad]: the twist at which the cable was gripped is unknown.
ROLL_STD = 1.0
TORSIONAL_STIFFNESS, DAMPING_TIME = "torsional_stiffness", "damping_time"
STIFFNESSES = (BENDING_STIFFNESS, TORSIONAL_STIFFNESS)
# Number of elements of `CableModel.coarse`, and their smallest mean number between two clips.
COARSE_MESH, COARSE_SPAN = 10, 6
# Parameter name: true minus declared roll of the end clamp [rad], equivalent to a rest twist.
END_ROLL = "end_roll"
# Deviation of a pose: of the free length of a cable that slides through an end [m].
FREE_LENGTH = "free_length"
# Size of the camera part of `HeldPose.vector`.
VIEWPOINT_SIZE = 3


def _stiffness(name: str, nominal: float) -> Parameter:
    bounds, std = STIFFNESS_BOUNDS, STIFFNESS_PRIOR_STD
    return Parameter(name, "N m^2", nominal, 1.0, *bounds, prior_std=std, log=True)


@dataclass(frozen=True)
class CableModel:
    """An elastic cable between two fixtures, in a plane or in space; immutable.

    Parameters
    ----------
    cable : CableData
    n : int
        Number of elements.
    element : str
        A name of `rod.chain.ELEMENTS`.
    start, end : SupportKind
        How the ends are held; also by its word. One of `STARTS` and of `ENDS`.
    gravity : (dimension,) [m/s^2]
        In the board frame; three numbers for a cable in space.
    effects : tuple of Effect
        Those of one kind are applied in this order.
    n_rest : int
        Number of spline coefficients of the rest curvature; 0 = straight at rest.
    priors : dict
        Standard deviations of Gaussian priors on effect parameters, by qualified name. These
        effects are nuisances within a declared tolerance, not findings.
    clips : tuple of SupportKind
        Kinds of the clips between the ends, in the order along the cable.
    obstacles : tuple of Obstacle
        What the cable may touch in any pose, without friction.
    fed_by_length : bool
        Whether poses tell the length between the ends of a cable that slides through one, not the
        tension beyond it.
    random : tuple of Effect
        Effects whose parameters each pose has of its own: they are among `deviation_names`.
    """

    cable: CableData
    n: int = 40
    element: str = DEFAULT_ELEMENT
    start: SupportKind = SupportKind.PINNED
    end: SupportKind = SupportKind.PINNED
    gravity: tuple[float, ...] = (0.0, -9.81)
    effects: tuple[Effect, ...] = ()
    n_rest: int = 9
    priors: Mapping[str, float] = field(default_factory=dict, hash=False)
    clips: tuple[SupportKind, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    random: tuple[Effect, ...] = ()
    fed_by_length: bool = False

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            object.__setattr__(self, name, SupportKind(getattr(self, name)))
        object.__setattr__(self, "clips", tuple(map(SupportKind, self.clips)))
        if len(self.gravity) != len(self.cable.axes):
            raise DloError(
                f"gravity has {counted(len(self.gravity), 'number')}, but the cable "
                f"{'has no' if len(self.gravity) == 3 else 'has a'} torsional stiffness: in space "
                "give both, in a plane neither"
            )
        named = {"clips": self.clips, "obstacles": self.surfaces, "ends that slide": self.slides}
        what = [name for name, there in named.items() if there]
        if what and not self.chain.kind.smooth:
            text = f"{what[0]} need a smooth element, found {self.element!r}; try 'quadratic'"
            raise DloError(text)
        if self.start.slides and not self.end.place:
            text = "through a start that slides a cable with a free end runs out or falls"
            raise DloError(f"{text}\n  Try: end: pinned, swivel or clamped")
        if all(self.loose) and self.fed_by_length:
            raise DloError("of a cable that slides through both ends poses tell the tensions")
        every = (*self.effects, *self.random)
        for effect in every:
            if [other.label for other in every].count(effect.label) > 1:
                raise DloError(
                    f"two effects are both labelled {effect.label!r}; give one another label, "
                    f"e.g. {type(effect).__name__}(label='{effect.label}_2')"
                )

    @cached_property
    def chain(self) -> Chain:
        """The chain of n elements."""
        held = (self.start.direction, self.end.direction)
        return Chain(self.cable.length, self.n, self.element, *held, node=self.node)

    @property
    def in_space(self) -> bool:
        """Whether the cable may leave the plane."""
        return len(self.gravity) == 3

    @cached_property
    def node(self) -> type[Node]:
        """The kind of its nodes."""
        return NODES[len(self.gravity)]

    @property
    def weight(self) -> float:
        """Declared weight [N]."""
        return self.cable.mass * float(np.linalg.norm(self.gravity))

    @property
    def force_scale(self) -> float:
        """Scale of forces [N]: the cable's weight plus the force that bends it."""
        return self.weight + self.cable.bending_stiffness / self.cable.length**2

    @property
    def n_pose(self) -> int:
        """Size of `HeldPose.vector`."""
        return EndConditions.size(self.node) + VIEWPOINT_SIZE + sum(self.loose) + self.clip_numbers

    @property
    def clip_numbers(self) -> int:
        """Size of the clips' part of `HeldPose.vector`."""
        return len(self.clips) * clip_size(self.node)

    @cached_property
    def deviation_names(self) -> tuple[str, ...]:
        """Names of the unknowns that each pose has of its own."""
        random = (f"{x.label}.{q.name}" for x in self.random for q in x.parameters(self.cable))
        return (*deviation_names(self.node, len(self.clips)), *random)

    @cached_property
    def rest(self) -> RestCurvature:
        """Basis of the rest curvature."""
        return RestCurvature(self.cable.length, 0 if self.cable.straight else self.n_rest)

    @cached_property
    def rest_basis(self) -> FloatArray:
        """Rest curvature per coefficient (n_rests, n_coefficients): kappa_0 = rest_basis @ c.

        In space the coefficients about the axis z follow those about y; the rest twist is zero.
        """
        means, strains = self.rest.cell_means(self.chain.cells), len(self.node.strains)
        return np.kron(np.eye(strains)[:, -len(self.node.curvatures) :], means)

    @property
    def roughness(self) -> FloatArray:
        """Second differences of the rest coefficients, about each axis."""
        return np.kron(np.eye(len(self.node.curvatures)), self.rest.roughness)

    @property
    def n_coefficients(self) -> int:
        """Number of rest coefficients."""
        return self.rest.n_coefficients * len(self.node.curvatures)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Stiffnesses, in space the roll of the end, then the effects' with qualified names."""
        listed = [_stiffness(BENDING_STIFFNESS, self.cable.bending_stiffness)]
        if self.cable.torsional_stiffness is not None:
            torsion = _stiffness(TORSIONAL_STIFFNESS, self.cable.torsional_stiffness)
            # Its prior is on the ratio to the bending stiffness, see `Unknowns.prior`.
            listed.append(replace(torsion, prior_std=np.inf))
            if self.start.roll and self.end.roll:
                std = self.priors.get(END_ROLL, ROLL_STD)
                roll = Parameter(END_ROLL, "rad", scale=0.1, lower=-9.0, upper=9.0, prior_std=std)
                listed.append(roll)
        if self.cable.damping_time is not None:
            listed.append(Parameter(DAMPING_TIME, "s", self.cable.damping_time, 0.01, 0.0, 10.0))
        for effect in self.effects:
            for parameter in effect.parameters(self.cable):
                name = f"{effect.label}.{parameter.name}"
                std = self.priors.get(name, parameter.prior_std)
                listed.append(replace(parameter, name=name, prior_std=std))
        return tuple(listed)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Qualified names of the parameters, in the order of the vector `p`."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def stiffness_indices(self) -> list[int]:
        """Indices of the stiffnesses in the vector `p`, bending first."""
        return [k for k, name in enumerate(self.names) if name in STIFFNESSES]

    @cached_property
    def nominal(self) -> FloatArray:
        """Parameter vector `p` at the nominal values."""
        return np.array([parameter.nominal for parameter in self.parameters])

    def with_effect(self, effect: Effect, priors: dict[str, float] | None = None) -> Self:
        """Return this model with one more effect."""
        known = {**self.priors, **(priors or {})}
        return replace(self, effects=(*self.effects, effect), priors=known)

    def without_effect(self, label: str) -> Self:
        """Return this model without the effect that has this label."""
        kept = tuple(effect for effect in self.effects if effect.label != label)
        priors = {k: v for k, v in self.priors.items() if not k.startswith(f"{label}.")}
        return replace(self, effects=kept, priors=priors)

    def without_kind(
        self, kind: type[Effect] | tuple[type[Effect], ...], p: FloatArray
    ) -> tuple[Self, FloatArray]:
        """The model without the effects of one kind, or some, and the remaining part of `p`."""
        effects = tuple(x for x in self.effects if not isinstance(x, kind))
        if effects == self.effects:
            return self, p
        plain = replace(self, effects=effects, priors={})
        return plain, p[[name in plain.names for name in self.names]]

    def with_mesh(self, n: int, element: str | None = None) -> Self:
        """Return the same model on another mesh."""
        return replace(self, n=n, element=element or self.element)

    @cached_property
    def unmeshed(self) -> Self:
        """One model for all meshes, rest splines and priors: their expressions are the same."""
        return replace(self, n=2, n_rest=0, priors={})

    @property
    def extensible(self) -> bool:
        """Whether some effect lets the cable stretch under tension."""
        return any(item.extensible for item in self.effects if isinstance(item, Kinematics))

    @property
    def n_inner(self) -> int:
        """Number of internal unknowns of a segment: those of the element, and the axial strain."""
        return int(self.extensible) + self.chain.kind.n_inner

    @property
    def has_state(self) -> bool:
        """Whether a pose changes the rest curvature of the next one."""
        return any(isinstance(effect, StateEffect) for effect in self.effects)

    @cached_property
    def may_spin(self) -> bool:
        """Whether only a rest curvature determines the roll of the cable about its own axis."""
        held = any(kind.roll for kind in (self.start, self.end, *self.clips))
        laws = [effect for effect in self.effects if isinstance(effect, SectionLaw)]
        return self.node.twists and not held and all(law.isotropic for law in laws)

    @property
    def coarse(self) -> Self:
        """The same model on a coarse mesh, with elements no longer than the thickness of a bar."""
        count = max(COARSE_MESH, COARSE_SPAN * (len(self.clips) + 1))
        if self.surfaces:
            thin = min((x.radius for x in self.surfaces if isinstance(x, Capsule)), default=np.inf)
            count = max(2 * count, int(self.cable.length / (2 * thin + self.cable.diameter)))
        return self.with_mesh(count)

    @property
    def n_springs(self) -> int:
        """Number of springs at places of the cable."""
        return sum(effect.n_springs for effect in self.effects if isinstance(effect, Load))

    @cached_property
    def n_border(self) -> int:
        """Number of unknowns of the whole pose: `border_names`."""
        return len(self.border_names)

    @cached_property
    def surfaces(self) -> tuple[Obstacle, ...]:
        """All that the cable may touch: declared obstacles, then those added by effects."""
        own = (x.surface(self.gravity) for x in self.effects if isinstance(x, ContactEffect))
        return (*self.obstacles, *(one for one in own if one is not None))

    @property
    def n_contacts(self) -> int:
        """Number of places at which the cable may touch obstacles, see `contact`."""
        return len(self.surfaces) * (self.n - self.end.place)

    @cached_property
    def n_lam(self) -> int:
        """Number of border unknowns on which segments depend: all except contact forces."""
        return self.n_border - self.n_contacts

    @cached_property
    def end_pull(self) -> list[int]:
        """Rows of the border (dimension,) of a force at the end of the cable, if there are any.

        With obstacles a free end has them, too, with zeros: all forces beyond a segment act there.
        """
        free = not self.end.place
        if free and not self.surfaces:
            return []
        what = "free_end" if free else "end_position"
        return [self.border_names.index(f"{what}_{axis}") for axis in self.node.axes]

    @property
    def no_pull(self) -> list[int]:
        """Those rows of `end_pull` that are zero, for a free end."""
        return [] if self.end.place else self.end_pull

    @cached_property
    def border_kinds(self) -> dict[str, Literal["distance", "angle", "place"]]:
        """Kinds of unknowns beside the nodes, by name: end conditions, springs, clips, contacts.

        A multiplier belongs to a condition on a distance [m] or an angle [rad]. A spring's place y
        [m] is an unknown, held on the cable by a multiplier [N]; the Hessian then couples only
        neighbouring nodes, see `SpringAt`. The arc length [m] at an eyelet, or at an end that
        slides, is an unknown, too. The multiplier of a contact is the size of its force [N];
        contacts differ from mesh to mesh.
        """
        places, pulls = ([f"{x}_{axis}" for axis in self.node.axes] for x in ("place", "pull"))
        kinds: dict[str, Literal["distance", "angle", "place"]] = {}
        for name in self.condition_names:
            kinds[name] = "distance" if name.startswith("end_position") else "angle"
        for k in range(self.n_springs):
            kinds |= {f"spring_{k}.{name}": "place" for name in places}
            kinds |= {f"spring_{k}.{name}": "distance" for name in pulls}
        for k, kind in enumerate(self.clips):
            kinds |= {f"clip_{k}.{name}": "distance" for name in pulls}
            if kind.slides:
                kinds[f"clip_{k}.place_s"] = "place"
        for side, slides in zip(("start", "end"), self.loose, strict=True):
            if slides and not self.fed_by_length:
                kinds[f"{side}.place_s"] = "place"
        if self.surfaces and not self.end.place:
            kinds |= {f"free_end_{axis}": "distance" for axis in self.node.axes}
        for k in range(self.n_contacts):
            kinds[f"contact_{k} on {self.n}"] = "distance"
        return kinds

    @cached_property
    def border_names(self) -> tuple[str, ...]:
        """Names of the unknowns beside the nodes, see `border_kinds`."""
        return tuple(self.border_kinds)

    @cached_property
    def pulls(self) -> list[list[int]]:
        """Rows of the border (dimension,) of the force on each spring, then on each clip [N]."""
        owners = [f"spring_{k}" for k in range(self.n_springs)]
        owners += [f"clip_{k}" for k in range(len(self.clips))]
        rows = self.border_names.index
        return [[rows(f"{one}.pull_{axis}") for axis in self.node.axes] for one in owners]

    @cached_property
    def sliding(self) -> dict[int, int]:
        """Index of each support through which the cable slides -> border row of its arc length.

        Supports are counted along the cable: 0 is the start, 1 the first clip, the last the end.
        """
        names = ["start", *(f"clip_{k}" for k in range(len(self.clips))), "end"]
        rows = {k: f"{name}.place_s" for k, name in enumerate(names)}
        known = self.border_names
        return {k: known.index(name) for k, name in rows.items() if name in known}

    @cached_property
    def loose(self) -> tuple[bool, bool]:
        """Whether the cable slides through its start, and through its end."""
        return self.start.slides, self.end.slides

    @cached_property
    def slides(self) -> bool:
        """Whether the cable slides through an end."""
        return any(self.loose)

    @cached_property
    def moves_nodes(self) -> bool:
        """Whether nodes stand at arc lengths of their own: at clips and ends that slide."""
        return bool(self.clips) or self.slides

    @property
    def clamped_between(self) -> bool:
        """Whether a clip between the ends holds the direction of the cable."""
        return any(kind.direction for kind in self.clips)

    @cached_property
    def n_multipliers(self) -> int:
        """Number of multipliers in the border: negative eigenvalues of a minimum's Hessian."""
        return int(self.are_multipliers.sum())

    @cached_property
    def are_multipliers(self) -> BoolArray:
        """Whether each border unknown (n_border,) is a multiplier; the others are places."""
        return np.array([kind != "place" for kind in self.border_kinds.values()], dtype=bool)

    @cached_property
    def condition_names(self) -> tuple[str, ...]:
        """Names of the end conditions: end position, then frames of clamps."""
        return self._held("end_position")

    def _held(self, place: str) -> tuple[str, ...]:
        """Names of the held components: of the end's place, named `place`, and of clamps."""
        names = [f"{place}_{axis}" for axis in self.node.axes if self.end.place]
        for side, kind in (("start", self.start), ("end", self.end)):
            held = zip(self.node.turns, kind.rotations(self.node), strict=True)
            names += [f"{side}_{turn}" for turn, blocked in held if blocked]
        return tuple(names)

    @cached_property
    def tipped_by(self) -> str | None:
        """The end condition whose angle decides which of two sides has the lower energy.

        A free end falls to either side of a clamp that points up. Between clamps in space, one
        rolled by half a turn, the cable is twisted either way.
        """
        rolled = self.start.roll and self.end.roll
        hangs = self.start.direction and not self.end.place
        name = "start_heading" if hangs else "end_rotation_x" if rolled else None
        return name if name in self.condition_names else None

    @cached_property
    def deviations(self) -> tuple[str, ...]:
        """Deviations of a pose that matter for these boundaries."""
        own = [name for effect in self.effects for name in effect.per_pose(self.cable)]
        own += [FREE_LENGTH] * (self.slides and self.fed_by_length)
        others = self.deviation_names[len(deviation_names(self.node)) :]
        return (*self._held("end"), *own, *others)
