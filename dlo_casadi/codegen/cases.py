"""Contents of the templates: what differs between cables, in a plane and in space."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import files
from typing import ClassVar

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.c_text import c_number
from dlo_casadi.codegen.feeding import feed_marks
from dlo_casadi.codegen.kernels import Holding, Kernels, Moved, kernels_of
from dlo_casadi.codegen.obstacles import Obstacles
from dlo_casadi.codegen.statuses import STATUS_TEXTS
from dlo_casadi.effects import Load
from dlo_casadi.equilibrium.guess_table import HALF_ANGLE, NUMBERS, SLACKS, GuessRow, guess_table
from dlo_casadi.equilibrium.guesses import resting_headings
from dlo_casadi.equilibrium.sides import NEAR_BAR
from dlo_casadi.equilibrium.solve import MOST_SHED, coarse_rest
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import Lagrangian, lagrangian_of
from dlo_casadi.rod.supports import SupportKind

# Newton steps of a descent, and for a part of a path, as in the templates.
ITERATIONS, TRY_STEPS = 80, 12


def template(name: str) -> str:
    """Text of a template."""
    return (files("dlo_casadi.codegen") / "templates" / name).read_text(encoding="utf-8")


def case_of(
    model: CableModel, p: FloatArray, rest: FloatArray, inline: bool, obstacles: Obstacles
) -> "Case":
    """Contents of the templates for this cable."""
    if model.slides and model.n_springs:
        side = "start" if model.start.slides else "end"
        raise DloError(
            f"no solver can be generated for a cable with a tether that slides through its {side}\n"
            "  Try: solve, which knows both, or a clip in place of the tether."
        )
    kind = {1: _PlaneCase, 3: _SpaceCase}[model.node.increment]
    return kind(model, p, rest, inline, obstacles)


@dataclass(frozen=True)
class Case:
    """Contents of the templates: the cable's numbers, and the text parts of its kind.

    `name`: of its templates.
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray
    inline: bool
    obstacles: Obstacles
    name: ClassVar[str]
    # Elements of the mesh for first guesses; 0 if there is none.
    coarse_elements: ClassVar[int] = 0

    @cached_property
    def meshes(self) -> dict[str, Kernels]:
        """Kernels of its meshes by their names in C, the cable's own first."""
        moved = Moved.SOME if self.model.clips else Moved.NONE
        moved = Moved.ALL if self.model.slides else moved
        return {"kernel": self.kernels(self.model, self.rest, moved)}

    def kernels(self, model: CableModel, rest: FloatArray, moved: Moved) -> Kernels:
        """Kernels of a mesh without the supports between the ends."""
        others = [x for x in model.effects if not (isinstance(x, Load) and x.n_springs)]
        still = [SupportKind.SWIVEL if kind.slides else kind for kind in (model.start, model.end)]
        bare = replace(
            model,
            start=still[0],
            end=still[1],
            clips=(),
            effects=tuple(others),
            fed_by_length=False,
        )
        p = np.array([self.p[model.names.index(name)] for name in bare.names])
        if not bare.end.place and (self.obstacles.most or self.holds):
            bare = replace(
                bare, end=SupportKind.PINNED
            )  # segments before a clip or a contact carry a force
        if not (self.holds or self.model.slides):
            return kernels_of(bare, p, rest, self.inline)
        if not bare.chain.kind.smooth:
            raise DloError(
                "no solver can be generated for a cable of links with a tether\n"
                "  Try: another element, --element quadratic"
            )
        tethers = [x for x in model.effects if x not in others]
        fed = model.slides
        held = Holding(moved, bool(model.sliding), tethers[0] if tethers else None, fed)
        return kernels_of(bare, p, rest, self.inline, held)

    @property
    def holds(self) -> int:
        """Number of clips and tethers that hold the cable between its ends."""
        return len(self.model.clips) + len(self.tethers)

    @property
    def eyelets(self) -> list[int]:
        """Indices of the clips through which the cable slides."""
        return [k for k, kind in enumerate(self.model.clips) if kind.slides]

    @property
    def eyelet_rows(self) -> list[int]:
        """Row of each holder's arc length in the border; 0 for holders that do not slide."""
        first, rows = self.model.node.dimension * (1 + self.holds), [0] * self.holds
        for k, clip in enumerate(self.eyelets):
            rows[clip] = first + k
        return rows

    @property
    def border(self) -> int:
        """Number of unknowns of the border: forces, then arc lengths."""
        return self.model.node.dimension * (1 + self.holds) + len(self.model.sliding)

    @property
    def holding(self) -> list[float]:
        """Per clip the true minus the declared values; and each tether."""
        node, length = self.model.node, self.model.cable.length
        own = np.array(node.identity)
        places, at, turns = (
            np.array(x)
            for x in functions_of(self.model).true_clips(self.p, np.zeros(self.model.n_pose))
        )
        clips = [
            [s / length, *place, 0.0, *node.moved(own, turn)]
            for s, place, turn in zip(at.ravel(), places.T, turns.T, strict=True)
        ]
        tethers = [[*tether, *own] for tether in self.tethers]
        return [float(x) for row in (*clips, *tethers) for x in row]

    @property
    def example_clips(self) -> str:
        """Clips for the pose in example.c, evenly spaced along its chord."""
        node, chord = self.model.node, (0.6, 0.1, 0.1)[: self.model.node.dimension]
        frame = [f"{x:g}" for x in node.identity] if self.model.clamped_between else []
        direction = [_braces(frame)] if len(frame) > 1 else frame
        clips = [
            _braces([f"{s:.4g}", _braces(f"{s * x:.4g}" for x in chord), *direction])
            for s in np.linspace(0.0, self.length, len(self.model.clips) + 2)[1:-1]
        ]
        return f",\n                           {_braces(clips)}" if clips else ""

    @property
    def compliances(self) -> list[float]:
        """Rotation of the start and end clamp, or swivel, per moment on it [rad/(N m)]."""
        turns = np.array(self.lagrangian.compliances(self.p)).ravel()
        found = zip(self.lagrangian.compliant, turns, strict=True)
        named = {self.model.condition_names[k]: float(c) for k, c in found}
        turn = self.model.node.turns[-1]  # a swivel has no first one, about the cable's axis
        return [named.get(f"{side}_{turn}", 0.0) for side in ("start", "end")]

    @property
    def stiffnesses(self) -> list[float]:
        """Stiffness of the start and end clamp [N m/rad], 0 for rigid ones."""
        return [1 / c if c > 0 else 0.0 for c in self.compliances]

    @cached_property
    def tethers(self) -> list[FloatArray]:
        """Per tether: arc length over length, anchor [m] and inverse stiffness [m/N], (d + 2,).

        V = k |r|^2 / 2 - f . r + constant, with the anchor f / k. A tether without stiffness gets a
        billionth of the cable's.
        """
        terms, length = self.lagrangian, self.model.cable.length
        least = 1e-9 * self.p[self.model.stiffness_indices[0]] / length**3
        rows = []
        for spring in terms.springs:
            k = ca.fmax(spring.stiffness, least)
            rows.append(ca.vertcat(spring.position / length, spring.force / k, 1 / k))
        found = ca.Function("tethers", [terms.p], [ca.horzcat(ca.SX(0, 0), *rows)])
        return list(np.array(found(self.p)).T)

    @property
    def clamps(self) -> tuple[FloatArray, FloatArray]:
        """True minus declared place of the end [m], and the true clamps in the declared ones."""
        raise NotImplementedError

    @property
    def resting(self) -> FloatArray:
        """The cable at rest as first guesses need it, see the templates."""
        raise NotImplementedError

    @property
    def numbers(self) -> list[float]:
        """Numbers outside the kernels, in the order of the template's macros."""
        model, chain = self.model, self.model.chain
        offset, turned = self.clamps
        stretch = self.length / model.cable.length
        found = [self.length, model.cable.length, *model.gravity, *self.load, *offset, *turned]
        found += [*self.stiffnesses, *(chain.places / model.cable.length)]
        found += [*(1 / (np.diff(chain.cells, axis=1).ravel() * stretch)), *self.resting]
        compliance = ca.Function(
            "compliance", [self.lagrangian.p], [self.lagrangian.axial_compliance]
        )
        axial = [float(compliance(self.p))] * model.slides
        return [*found, *self.holding, *axial]

    @property
    def rows(self) -> tuple[GuessRow, ...]:
        """First guesses by spans."""
        model = self.model
        return guess_table(len(model.clips) + 1, model.in_space, bool(self.eyelets))

    @property
    def guesses(self) -> int:
        """Number of first guesses."""
        raise NotImplementedError

    @property
    def descents(self) -> int:
        """Descents of a solve, as in the template, which checks it: MOST_STEPS.

        One from a warm start. Each first guess starts one; in a plane, one more guided by springs
        in 15 stages; with a coarse mesh one there and one that goes on, and three of these are
        followed until their energy is known. All may land on obstacles, pushed aside or not.
        """
        most, coarse = self.obstacles.most, bool(self.coarse_elements)
        each = 1 + (2 * coarse if self.model.in_space else 15)
        return 1 + each * self.guesses + 3 * coarse + bool(most) * (2 + 4 * (self.guesses + most))

    @property
    def values(self) -> dict[str, int | str]:
        """Values that replace the templates' marks."""
        model, chain, coefficients = self.model, self.model.chain, map(c_number, HALF_ANGLE)
        joined = not (model.in_space or model.slides or self.obstacles.most)
        joined = joined and model.clamped_between
        table = (
            _braces([str(row.slack), str(int(row.rolled)), _braces(map(str, row.sides))])
            for row in self.rows
        )
        return {
            "COARSE": self.coarse_elements,
            "SHAPES": self.guesses if self.coarse_elements else 0,
            "ELEMENTS": chain.n_segments,
            "FIRST": chain.layout.advancing[0],
            "RESTING": len(self.resting),
            "STEPS": self.descents * ITERATIONS + 10 * joined,
            "GUESSES": self.guesses,
            "GUESS_TABLE": ",\n    ".join(table),
            "SLACKS": ", ".join(map(c_number, SLACKS)),
            "HALF_ANGLE": ", ".join(coefficients),
            "MOST_SHED": c_number(MOST_SHED),
            "NEAR_BAR": c_number(NEAR_BAR),
            **{name: c_number(number) for name, number in NUMBERS.items()},
            **feed_marks(model, self.border),
        }

    @property
    def table(self) -> list[float]:
        """Numbers of the kernels of all meshes, then the others."""
        rows = [number for kernels in self.meshes.values() for number in kernels.table]
        return [*rows, *self.numbers]

    @property
    def words(self) -> dict[str, str]:
        """Text parts of the templates, by mark."""
        text = template(f"{self.name}_words.in")
        _, *parts = re.split(r"^@([A-Z_]+)@\n", text, flags=re.MULTILINE)
        found = {mark: part[:-1] for mark, part in zip(parts[::2], parts[1::2], strict=True)}
        return found | self.obstacles.words | STATUS_TEXTS

    @property
    def lagrangian(self) -> Lagrangian:
        """Expressions of the model."""
        return lagrangian_of(self.model)

    @property
    def length(self) -> float:
        """True length of the cable [m]."""
        return float(self.lagrangian.true_ends_and_length(self.p, 0, 0)[1])

    @property
    def load(self) -> FloatArray:
        """Sum of the dead loads [N]."""
        return np.array(functions_of(self.model).dead_load(self.p)).ravel()


def _braces(parts: Iterable[str]) -> str:
    return f"{{{', '.join(parts)}}}"


class _PlaneCase(Case):
    name = "plane"

    @property
    def clamps(self) -> tuple[FloatArray, FloatArray]:
        offsets, _ = self.lagrangian.true_ends_and_length(self.p, 0, 0)
        found = np.array(offsets).ravel()[2:]
        return found[:2], found[2:]

    @property
    def resting(self) -> FloatArray:
        return resting_headings(self.model.chain, self.rest)

    @property
    def guesses(self) -> int:
        pinned = self.model.start.turns and self.model.end.turns
        return len(self.rows) if self.model.clips else 4 + pinned

    @property
    def values(self) -> dict[str, int | str]:
        # Elimination and solution take about 30 operations per node; the kernels run twice.
        kernels, count = self.meshes["kernel"], self.model.chain.n_nodes
        return super().values | {"OPERATIONS": 2 * kernels.operations + 30 * count}


class _SpaceCase(Case):
    name = "space"
    # Fewest arcs of the coarse mesh, and fine elements per arc. Of 3,000 random clamped problems
    # with n = 12, 10 lead to a higher and 4 to a lower equilibrium than with all first guesses on
    # the fine mesh.
    least_coarse, coarsening = 6, 2.0
    # Arcs of the coarse mesh in a span between clips. An eyelet beside a clamp ends no span; each
    # adds as many arcs to all spans. Without these arcs, of 2,400 random cables in a saddle and an
    # eyelet, 80 lead to a higher and 9 to a lower equilibrium.
    coarse_span = 3

    @property
    def coarse_elements(self) -> int:  # type: ignore[override]
        model = self.model
        eyelets = len(self.eyelets) if model.clamped_between else 0
        spans = len(model.clips) - eyelets + 1
        if not (model.end.place or model.clips):
            return 0
        least = max(self.least_coarse, round(model.n / self.coarsening))
        if model.clips:
            each = max(self.coarse_span * (1 + eyelets), self.least_coarse // spans)
            least = spans * min(each, model.n // spans)
        count = min(model.n, least)
        return 0 if count == model.n and model.element == "arc" else count

    @cached_property
    def meshes(self) -> dict[str, Kernels]:
        found = super().meshes
        if not self.coarse_elements:
            return found
        coarse = self.model.with_mesh(self.coarse_elements, "arc")
        rest = coarse_rest(self.model, coarse, self.rest)
        moved = Moved.ALL if self.model.moves_nodes else Moved.NONE
        return found | {"coarse_kernel": self.kernels(coarse, rest, moved)}

    @property
    def clamps(self) -> tuple[FloatArray, FloatArray]:
        def held(frames: FloatArray) -> FloatArray:
            ends = np.concatenate([np.zeros(6), frames.ravel()])
            return np.array(self.lagrangian.true_ends_and_length(self.p, ends, 0)[0]).ravel()

        found = held(np.tile(self.model.node.identity, 2))
        anywhere = np.random.default_rng(0).normal(size=(2, 4))
        anywhere /= np.linalg.norm(anywhere, axis=1)[:, None]
        turns = Rotation.from_quat(found[6:].reshape(2, 4))
        expected = (Rotation.from_quat(anywhere) * turns).as_quat()
        turned = held(anywhere)[6:].reshape(2, 4)
        if np.abs(np.abs((turned * expected).sum(axis=1)) - 1).max() > 1e-12:
            raise DloError(
                "no solver can be generated: an effect moves the clamps in another way than about "
                "their own axes\n  Try: dlo predict, or dlo_casadi.predict, which know it."
            )
        return found[3:6], found[6:]

    @property
    def resting(self) -> FloatArray:
        chain = self.model.chain
        bends = chain.curvatures(self.rest) * np.diff(chain.cells, axis=1).ravel()
        return np.asarray(bends.T.ravel())

    @property
    def guesses(self) -> int:
        return len(self.rows) if self.model.end.place or self.model.clips else 3

    @property
    def values(self) -> dict[str, int | str]:
        # Elimination and solution: about 500 operations a node.
        operations = self.meshes["kernel"].operations + 500 * (self.model.n + 1)
        return super().values | {"OPERATIONS": operations}
