"""CasADi functions of a whole cable: where supports are, its section, its loads."""

from functools import cached_property

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.model.lagrangian import Lagrangian
from dlo_casadi.rod.element import Cell


class CableFunctions:
    """CasADi functions of a whole cable, from the expressions of its model."""

    def __init__(self, terms: Lagrangian) -> None:
        self.model, self.terms = terms.model, terms
        self.node, self.kind = terms.node, terms.kind

    @cached_property
    def spring_places(self) -> ca.Function:
        """(p) -> arc lengths (n_springs,) [m] of the springs on the cable."""
        places = [spring.position for spring in self.terms.springs]
        return ca.Function("spring_places", [self.terms.p], [ca.vertcat(ca.SX(0, 1), *places)])

    @cached_property
    def true_clips(self) -> ca.Function:
        """(p, pose) -> true places (dimension, n_clips), arc lengths [m] and turns [rad] of clips.

        The arc lengths are (n_clips,), those of eyelets zero. The turns (increment, n_clips) are of
        clamped clips, from their declared frames, and mean nothing for others. A pose's own
        deviations are excluded.
        """
        clips = self.terms.true_ends.clips
        places = ca.horzcat(ca.SX(self.node.dimension, 0), *(clip.place for clip in clips))
        at = ca.vertcat(ca.SX(0, 1), *(clip.at for clip in clips))
        turns = ca.horzcat(ca.SX(self.node.increment, 0), *(clip.turn for clip in clips))
        still = ca.SX.zeros(self.terms.deviation.shape)
        outputs = ca.substitute([places, at, turns], [self.terms.deviation], [still])
        return ca.Function("true_clips", [self.terms.p, self.terms.pose], outputs)

    @cached_property
    def clip_slopes(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives of clips' arc lengths (n_clips, n_parameters) and turns, as numbers.

        The turns' derivatives are (n_clips, n_parameters, increment).
        """
        p = self.terms.p
        _, at, turns = self.true_clips(p, self.terms.pose)
        slips, by_p = (np.array(ca.evalf(ca.jacobian(ca.vec(x), p))) for x in (at, turns))
        return slips, by_p.reshape((-1, self.node.increment, p.numel())).swapaxes(1, 2)

    @cached_property
    def section_moment(self) -> ca.Function:
        """(bend [1/m], p) -> moment [N m] of the section in the middle of the cable.

        M = dW/dk of the energy W per length; in space about the material axis z.
        """
        bend, length = ca.SX.sym("bend"), self.model.cable.length
        cell = Cell(ca.SX(0.499 * length), ca.SX(0.002 * length), 0.002 * length)
        strain = ca.vertcat(ca.SX.zeros(len(self.node.strains) - 1), bend)
        energy = self.terms.section.density(strain, cell)
        return ca.Function("section_moment", [bend, self.terms.p], [ca.gradient(energy, bend)])

    @cached_property
    def bent_stiffness(self) -> ca.Function:
        """(p) -> log of the bending stiffness M / k at one turn per length; its gradient by p."""
        p, bend = self.terms.p, self.model.cable.curvature_scale
        stiffness = ca.log(self.section_moment(bend, p) / bend)
        return ca.Function("bent_stiffness", [p], [stiffness, ca.gradient(stiffness, p)])

    @cached_property
    def stretch(self) -> ca.Function:
        """(p) -> true length without load over the declared one."""
        return ca.Function("stretch", [self.terms.p], [self.terms.stretch])

    @cached_property
    def dead_load(self) -> ca.Function:
        """(p) -> sum of the dead loads (dimension,) [N], excluding forces of single poses.

        These are the loads on the declared length, whatever is fed through ends.
        """
        still = ca.SX.zeros(len(self.model.deviation_names))
        forces = (force.force for force in self.terms.dead_forces)
        load = sum(forces, start=self.terms.resultant(0.0))
        load = ca.substitute(load, self.terms.deviation, still)
        return ca.Function("dead_load", [self.terms.p], [ca.densify(load)])
