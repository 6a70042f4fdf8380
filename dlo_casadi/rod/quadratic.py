"""Arcs that bow: elements of fourth order whose bow is eliminated inside the element."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from dlo_casadi.rod.arc import Arc
from dlo_casadi.rod.element import Condensed, Section, Segment
from dlo_casadi.rod.node import Heading


class Quadratic(Arc):
    """An arc whose heading in the middle lies by the angle `bow` beyond the mean of its ends.

    Positions and energy are taken to second order in the bow, which leaves out what is of fourth
    order in the element's length. The bow is the minimum for given nodes and multipliers.
    """

    name = "quadratic"
    order = 4
    n_inner = 1

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """The arc's, turned by the bow to second order."""
        c, s = ca.vertsplit(Heading.tangent(self.heading(segment, u)))
        form = 4 * u * (1 - u)
        across, back = form * segment.inner, form**2 * segment.square / 2
        bowed = ca.vertcat(-across * s - back * c, across * c - back * s)
        return segment.ratio * ca.vertcat(c, s) + segment.stretch * bowed

    def elastic(self, segment: Segment, section: Section) -> ca.SX:
        """Energy of the bend at two Gauss points, one a half, to second order in the bow."""
        (bend,), q = self.bends(segment), ca.SX.sym("q")
        moment = bend * ca.substitute(ca.gradient(section.of_bend(q) * q, q), q, bend**2)
        first, second = (section.along(half) for half in segment.cell.halves)
        # The bow's own curvature is 4 bow (1 - 2u) / h: at Gauss points, +- 4/sqrt(3) bow / h.
        bowed = 4 / np.sqrt(3) * segment.inner * (1 / (segment.length * segment.stretch))
        mean = section.of_bend(bend**2) * bend**2 + section.tangent(bend**2) * bowed**2
        # Where the halves resist differently, a mean bend bows the cell.
        density = (first + second) / 2 * mean + (first - second) * moment * bowed
        return segment.cell.width * section.bending / 2 * density * segment.stretch

    def condensed(
        self, segment: Segment, lagrangian: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> Condensed:
        """Second-order minimum over the bow, its stiffness kept positive under compression."""
        torque = ca.gradient(lagrangian, segment.inner)
        own = ca.jacobian(ca.gradient(elastic(segment), segment.inner), segment.inner)
        whole = [lagrangian, torque, ca.jacobian(torque, segment.inner), own]
        given, torque, stiffness, own = ca.substitute(whole, [segment.inner], [ca.SX(0)])
        factor, slope = _stiffening(stiffness / own - 1)
        bow = -torque / (own * factor)
        return Condensed(given + torque * bow / 2, bow, bow**2 * slope)

    def expanded(
        self, segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> ca.SX:
        """To second order in the bow, as in `condensed`."""
        torque = ca.gradient(energy, segment.inner)
        stiffness = ca.jacobian(torque, segment.inner)
        zero = ca.SX(0)
        given, torque, stiffness = ca.substitute(
            [energy, torque, stiffness], [segment.inner], [zero]
        )
        return given + torque * segment.inner + stiffness * segment.inner**2 / 2


def _stiffening(x: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Stiffness 1 + x of a bow under tension and its slope; compressed, x < 0, it stays above 1/4.

    Elements of a limp cable would buckle one by one on the way to an equilibrium. Twice
    differentiable, and 1 + x + O(x^3) everywhere.
    """
    a = 4 / 3 * ca.fmin(x, 0)
    pressed = 1 - a + a**2
    return ca.fmax(x, 0) + 0.25 + 0.75 / pressed, (1 - 2 * a) / pressed**2
