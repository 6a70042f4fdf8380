"""Find mistakes about clamps: their declared directions, and readings of their force sensors."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose
from dlo_casadi.errors import counted
from dlo_casadi.session.hypotheses import (
    NEAR_AXES,
    Hypothesis,
    ReadSession,
    Suspicion,
    axes_of,
    exchanges,
    likeliest,
    listed,
    read_as,
)
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.thresholds import (
    FITS,
    FITTED_READINGS,
    HEADING_NEAR,
    HEADING_OFF,
    MISREAD,
    MUCH_BETTER,
    NEARLY_ALL,
    READ_OTHERWISE,
    READ_SCALE,
    TURNED,
    UNSEEN,
)

# A full turn [rad] with room for rounding; a declared heading beyond it needs a line that turns.
_TURN = 6.3
# Shares of the length: pieces whose direction is taken, and the part of the line used at an end.
_STEP, _PART = 0.02, 0.1
# Largest turn between two pieces of a line [rad]; beyond it the sense of rotation is unknown.
_TELLING = np.pi / 2


def _turned(*vector: float) -> Callable[[Any], FloatArray]:
    return lambda q: (Rotation.from_quat(q) * Rotation.from_rotvec(vector)).as_quat()


# What the user may have meant -> the value that a declared number then has.
_MEANT: Mapping[str, Mapping[str, Callable[[Any], Any]]] = {
    "heading": {
        "in degrees?": np.radians,
        "headings point along the cable from its start to its end:": lambda angle: angle - np.pi,
        "counter-clockwise is positive:": lambda angle: -angle,
    },
    "orientation": {
        "w last, [qx, qy, qz, qw]; here w seems to stand first:": lambda q: np.roll(q, -1),
        "x along the cable from start to end, at both clamps; here it points backwards, or start "
        "and end are exchanged:": _turned(0.0, 0.0, np.pi),
        "the clamp's frame in the world; here it seems to be the world's in the clamp, turn the "
        "signs of qx, qy, qz round:": lambda q: np.multiply(q, [-1, -1, -1, 1]),
        "x along the cable; here the clamp's z axis does:": _turned(0.0, -np.pi / 2, 0.0),
        "x along the cable; here the clamp's -z axis does:": _turned(0.0, np.pi / 2, 0.0),
        "x along the cable; here the clamp's y axis does:": _turned(0.0, 0.0, np.pi / 2),
        "x along the cable; here the clamp's -y axis does:": _turned(0.0, 0.0, -np.pi / 2),
    },
}
_RULE = {
    "heading": "headings in radians, counter-clockwise from x, along the cable",
    "orientation": "unit quaternions [qx, qy, qz, qw], x along the cable; start and end exchanged",
}
_UNLIKE = (
    "{} is {:.0%} off what the shapes need, and no other way to read it is near. Try: the fixture, "
    "axes and sign of its sensor. A large effect that the model lacks could look the same."
)
# Possible units of sensor readings, relative to newtons and newton metres.
_UNITS: Mapping[str, Mapping[str, float]] = {
    "force": {"grams-force": 101.97, "kilograms-force": 0.10197, "millinewtons": 1e3},
    "moment": {"N mm": 1e3, "N cm": 1e2, "kgf cm": 10.197},
}


# ---- directions ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shown:
    """A declared clamp value, and the directions (n, d) that the line beside it allows.

    `turned` [rad]: heading of the line's last piece with all full turns, where turns are counted.
    """

    name: str
    key: str
    value: Any
    ways: FloatArray
    turned: float | None

    @property
    def kind(self) -> str:
        """What is declared: heading or orientation."""
        return self.key.split("_")[1]

    def off(self, value: Any) -> float:
        """Angle [rad] between a value of the key and the direction of the line."""
        angle = float(np.arccos(np.clip(self.ways @ axes_of(value)[:, 0], -1.0, 1.0)).min())
        return angle if self.turned is None else max(angle, abs(value - self.turned) - np.pi)

    @property
    def wrong(self) -> bool:
        return self.off(self.value) > HEADING_OFF

    def __str__(self) -> str:
        way = self.ways[(self.ways @ axes_of(self.value)[:, 0]).argmax()]
        values, along = listed(self.value, ".3g"), f"({listed(way, '.2g')})"
        if np.ndim(self.value) == 0:
            values += " rad"
            angle = np.arctan2(way[1], way[0]) if self.turned is None else self.turned
            along = f"{angle:.3g} rad"
        off = np.degrees(self.off(self.value))
        side = self.key.split("_")[0]
        return f"its {self.key} is {values}, the line {side}s at {along}, {off:.0f} degrees off it"


def wrong_directions(session: ReadSession) -> tuple[Suspicion, ...]:
    """Headings and orientations that the lines contradict, in single poses or in most of them."""
    found: list[Suspicion] = []
    common: list[_Shown] = []
    for side in ("start", "end"):
        shown = list(_shown(session, side))
        wrong = [item for item in shown if item.wrong]
        if wrong and (2 * len(wrong) > len(shown) or (len(wrong) > 1 and _meant(shown))):
            common += shown
            continue
        found += [Suspicion.of_pose(item.name, f"{item}{_try([item])}") for item in wrong]
    if common:
        wrong = [item for item in common if item.wrong]
        keys = list(dict.fromkeys(item.key for item in common))
        text = (
            f"{' and '.join(keys)} contradict{'s' * (len(keys) == 1)} {len(wrong)} of "
            f"{counted(len(common), 'line')}. {wrong[0].name}: {wrong[0]}{_try(common)}"
        )
        # A frame is certainly wrong only where another reading of its value explains the lines.
        certain = wrong[0].kind == "heading" or bool(_meant(common))
        found.insert(0, Suspicion(text, certain))
    return tuple(found)


def _meant(shown: Sequence[_Shown]) -> str:
    """What the declared values may have meant, if one meaning explains nearly all of them."""
    found = likeliest(
        (Hypothesis(*item) for item in _MEANT[shown[0].kind].items()),
        lambda meant: np.quantile([item.off(meant(item.value)) for item in shown], NEARLY_ALL),
        HEADING_NEAR,
        near=1.0,
    )
    return "" if found is None else found[0].said


def _try(shown: Sequence[_Shown]) -> str:
    """What to try, taken from the first pose that is wrong."""
    item = next(item for item in shown if item.wrong)
    best = _meant(shown) or _meant([item])
    if not best:
        return f". Try: {_RULE[item.kind]}."
    return f". Try: {best} then {listed(_MEANT[item.kind][best](item.value), '.4g')}."


def _shown(session: ReadSession, side: str) -> Iterator[_Shown]:
    """Directions of the lines at the clamps of one side, where the lines determine them."""
    cable, experiment = session.config.cable, session.config.experiment
    if not getattr(experiment.boundary, side).direction:
        return
    weight = cable.prior_mass * float(np.linalg.norm(experiment.gravity))
    layer = np.sqrt(cable.prior_bending_stiffness / max(weight, 1e-12))
    # The weight bends the cable by 1 / layer beside a clamp: a quarter radian within half a layer.
    reach = min(layer / 2, _PART * cable.length)
    for item in session.read:
        pose = session.declared[item.name]
        for key in (f"{side}_heading", f"{side}_orientation"):
            value = getattr(pose, key)
            ways = [] if value is None else _ways(pose, item, side, cable.length, reach)
            if len(ways):
                # Behind a pinned start no turns are counted: full turns mean nothing there.
                turns = experiment.boundary.start.direction and key == "end_heading"
                far = turns and abs(value) > _TURN
                turned = _turned_to(pose, item.points, cable.length) if far else None
                yield _Shown(item.name, key, value, np.asarray(ways), turned)


def _ways(
    pose: Pose, item: PoseInput, side: str, length: float, reach: float
) -> Sequence[FloatArray]:
    """Directions (d,) that a line may have at its clamp, from start to end.

    Empty where the line begins too far from the fixture, or where its first piece (between
    sparse points) ends farther than `reach` [m] from it. Markers begin at the fixture, whose place
    is inexact, so that the second piece is used as well.
    """
    sign, place = (1 if side == "start" else -1), np.array(getattr(pose, side))
    inward = item.points[::sign]
    if item.s is not None:
        inward = np.vstack([place, inward])
    before = float(np.linalg.norm(inward[0] - place))
    pieces = _pieces(inward, _STEP * length)
    if before > FITS * length or not len(pieces):
        return []
    size = np.linalg.norm(pieces, axis=1)
    s = np.cumsum(size) - size / 2
    # The chord of a loop is short: pieces are a share of the cable's length instead.
    if before + size[0] * max(1.0, length / (s[0] + s[-1])) > reach:
        return []
    tangents = sign * pieces / size[:, None]
    near = s < max(_PART * length, s[min(2, len(s) - 1)] + 1e-12)
    fitted = np.polyfit(s[near] + before, tangents[near], min(1, near.sum() - 1))
    ways = [*tangents[near][:2], fitted[-1], fitted[-1] + s[0] * fitted[0]]
    return [way / np.linalg.norm(way) for way in ways]


def _turned_to(pose: Pose, points: FloatArray, length: float) -> float | None:
    """Heading [rad] at the end of a line, full turns included; None if it is unknown."""
    assert pose.start_heading is not None
    pieces = _pieces(points, _STEP * length)
    heading = np.unwrap(np.arctan2(pieces[:, 1], pieces[:, 0]))
    if np.abs(np.diff(heading)).max(initial=0.0) > _TELLING:
        return None
    turns = round((pose.start_heading - heading[0]) / (2 * np.pi))
    return float(heading[-1] + 2 * np.pi * turns)


def _pieces(points: FloatArray, step: float) -> FloatArray:
    """Steps (n, d) between points at least `step` [m] apart: shorter ones show noise."""
    kept = [0]
    for k in range(1, len(points)):
        if np.linalg.norm(points[k] - points[kept[-1]]) >= step:
            kept.append(k)
    return np.asarray(np.diff(points[kept], axis=0))


# ---- readings -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class ComparedReading:
    """One kind of reading on one side of the cable, of m poses.

    Parameters
    ----------
    name : str
        As in a configuration, such as end_force.
    measured, model : (m, c) [N] or [N m]
        Readings, and the values that the shapes need; known only up to the mass.
    frames : (m, d, d) or None
        Axes of the clamp in the world, as columns; None at a pin.
    forces : (m, d) or None [N]
        Only for moments: the model's forces on the same side.
    std : float [N] or [N m]
        Of one component: noise and a constant offset, as far as they are declared.
    """

    name: str
    measured: FloatArray
    model: FloatArray
    frames: FloatArray | None = None
    forces: FloatArray | None = None
    std: float = 0.0

    @property
    def noise(self) -> float:
        """Noise of the readings relative to their size."""
        size = np.sqrt(np.mean(self.measured**2))
        return self.std / max(float(size), 1e-300)

    def misfit(self, measured: FloatArray) -> float:
        """Distance from the nearest multiple of the model, relative to the size of the readings."""
        size = float((measured**2).sum() * (self.model**2).sum())
        along = max(float((measured * self.model).sum()), 0.0) / np.sqrt(max(size, 1e-300))
        return float(np.sqrt(max(1 - along**2, 0.0)))


def misread(readings: Sequence[ComparedReading], *, sized: bool = True) -> tuple[Suspicion, ...]:
    """Readings that were taken in another way than declared: the likeliest way for each.

    `sized`: whether the shapes determine stiffness over weight; if not, only the ratio of forces to
    moments is checked.
    """
    found, scales = [], {}
    for one in readings:
        if len(one.measured) * one.measured.shape[1] < 3 or not one.model.any():
            continue
        own, rows = one.misfit(one.measured), one.measured
        if MISREAD < own < UNSEEN * one.noise:
            continue
        if own > MISREAD:
            # A general rotation or lever arm fits at least as well as its special cases.
            meant = likeliest(_otherwise(one), one.misfit, MUCH_BETTER * own, READ_OTHERWISE)
            if meant is None:
                found += [Suspicion(_UNLIKE.format(one.name, own), False)] * (own > TURNED)
                continue
            (said, rows, certain), left = meant
            text = f"{one.name} is {own:.0%} off what the shapes need, but {left:.0%} {said}"
            found.append(Suspicion(text, certain))
        scales[one.name] = float((rows * one.model).sum() / (one.model**2).sum())
    # Forces in a known other unit count in newtons.
    forces = [
        scale / _UNITS["force"].get(_unit_of(name, scale) if sized else "", 1.0)
        for name, scale in scales.items()
        if name.endswith("force")
    ]
    beside = float(np.median(forces)) if forces else 1.0
    for name, scale in scales.items():
        if name.endswith("moment") and forces:
            found += _other_unit(name, scale / beside, "forces")
        elif sized:
            found += _other_unit(name, scale, "mass")
    return tuple(found)


def _otherwise(one: ComparedReading) -> Iterator[Hypothesis[FloatArray]]:
    """Other interpretations of the readings, the likely ones first."""
    a, (count, size) = one.measured, one.measured.shape
    turned = "with the other sign. Try: what the cable does to the fixture, not the fixture to it."
    yield Hypothesis(turned, -a)
    if one.frames is not None and size > 1:
        world = np.einsum("mij,mj->mi", one.frames, a)
        text = "once turned from the clamp's axes into the world's"
        yield Hypothesis(
            f"{text}. Try: world axes, R f with the clamp's frame R of each pose.", world
        )
        yield Hypothesis(
            f"{text}, with the other sign. Try: -R f, with the clamp's frame R.", -world
        )
    # Forces of few poses are nearly parallel: a fitted rotation or lever arm explains any error.
    if count < FITTED_READINGS:
        return
    # The hypothesis must also halve the misfit caused by effects: a real effect leaves no doubt.
    yield from (way for way in _fitted(one) if one.misfit(way.meant) < MISREAD)


def _fitted(one: ComparedReading) -> Iterator[Hypothesis[FloatArray]]:
    """Interpretations with parameters that are fitted to what the shapes need."""
    a, size = one.measured, one.measured.shape[1]
    if one.forces is not None:
        yield from _about_elsewhere(one, one.forces)
    if size > 1:
        for axes in exchanges(size)[1:]:
            text = f"once read as ({read_as(axes)}). Try: the axes of start and end."
            if not np.array_equal(axes, -np.eye(size)):  # the other sign
                yield Hypothesis(text, a @ axes.T, one.misfit(a) > TURNED)
        u, _, v = np.linalg.svd(a.T @ one.model)
        hand = np.diag([*np.ones(size - 1), np.sign(np.linalg.det(u @ v))])
        turn, whole = (u @ hand @ v).T, np.eye(3)
        if min(np.linalg.norm(turn - axes) for axes in exchanges(size)[1:]) < NEAR_AXES:
            return
        whole[:size, :size] = turn
        vector = Rotation.from_matrix(whole).as_rotvec()
        angle = np.degrees(np.linalg.norm(vector) if size > 2 else vector[2])
        text = f"once all are turned by {angle:.0f} degrees. Try: the axes of start and end."
        yield Hypothesis(text, a @ turn.T, one.misfit(a) > TURNED)


def _about_elsewhere(one: ComparedReading, forces: FloatArray) -> Iterator[Hypothesis[FloatArray]]:
    """Moments about a point fixed to the clamp, by least squares: M + (fixture - point) x F.

    Point and scale are found together: the equations are linear in both.
    """
    m, d = forces.shape
    frames = np.broadcast_to(np.eye(d), (m, d, d)) if one.frames is None else one.frames
    # Cross products; in a plane only the component normal to it.
    space = [np.pad(x, ((0, 0), (0, 3 - d))) for x in (*np.moveaxis(frames, 2, 0), forces)]
    arms = np.stack([np.cross(axis, space[-1])[:, -one.model.shape[1] :] for axis in space[:d]], 2)
    columns = np.concatenate([one.model[..., None], arms], axis=2).reshape(-1, 1 + d)
    scale, *arm = np.linalg.lstsq(columns, one.measured.ravel(), rcond=None)[0]
    if scale <= 0:
        return
    told = listed(-1e3 * np.array(arm) / scale, ".3g")
    axes = "of the clamp" if one.frames is not None else "of gravity's frame"
    yield Hypothesis(
        f"once taken about a point ({told}) mm from the fixture along the axes {axes}, where the "
        "sensor may be. Try: moments about the fixture, M + (sensor - fixture) x F.",
        one.measured - arms @ np.array(arm),
    )


def _unit_of(name: str, scale: float) -> str:
    """The unit that a scale of readings is near; empty if there is none."""
    units = _UNITS[name.split("_")[-1]]
    unit = min(units, key=lambda one: abs(np.log(scale / units[one])))
    return unit if 0.5 < scale / units[unit] < 2.0 else ""


def _other_unit(name: str, scale: float, beside: str) -> Iterator[Suspicion]:
    """A scale of readings that no mass explains; of moments beside the forces, if there are any."""
    if 1 / READ_SCALE < scale < READ_SCALE:
        return
    cure = ". Try: N and N m."
    if unit := _unit_of(name, scale):
        cure = f": in {unit}? Try: divide by {_UNITS[name.split('_')[-1]][unit]:g}."
    text = f"{name} is {scale:.3g} times what shapes and {beside} need{cure}"
    yield Suspicion(text, bool(unit))
