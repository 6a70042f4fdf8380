"""What the paper's equations leave out, each shown once."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.estimation.constrained import (
    Interval,
    profile_interval,
    stiffness_profile,
    threshold,
)
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.paper.algorithm1 import gravity_slopes, run_algorithm1
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.session.stages import rest_curvature_of
from dlo_casadi.show.style import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILLION
from dlo_casadi.thresholds import NORMAL_95
from paper import branches, chords, published
from paper.content import Claim, Part, Section, Table, drawing, number
from paper.fits import FIRST, REST_COEFFICIENTS
from paper.replica import Replica, all_three

FloatArray = NDArray[np.floating]

# Stiffnesses of the profile, in decades about the truth.
DECADES = np.linspace(-1.0, 2.0, 25)
# Rise of -2 log L at the ends of a 95 % interval.
STEEP = NORMAL_95**2


def run(executor: Executor) -> Part:
    """All sections."""
    replicas = all_three()
    part = Part("equations")
    reaction(part, replicas[:2])
    rest_angles(part, replicas[2])
    identifiability(part, replicas[:2], executor)
    chords.add(part, executor)
    branches.add(part)
    return part


# ---- Eq. 14 and the reaction ------------------------------------------------------------------


@dataclass(frozen=True)
class Balance:
    """Moments at the interior joints of all poses (m, n - 1), from exact equilibria."""

    bends: FloatArray
    elastic: FloatArray
    gravity: FloatArray
    reaction: FloatArray

    @property
    def inverse_stiffness(self) -> float:
        """1 / k_theta [rad/(N m)] of Eq. 15's minimum over theta_0 and every real 1 / k_theta."""
        bends = self.bends - self.bends.mean(axis=0)
        gravity = self.gravity - self.gravity.mean(axis=0)
        return float(-(bends * gravity).sum() / (gravity**2).sum())


def balance(stiffness: float, n: int = FIRST) -> Balance:
    """Exact equilibria of n links with the rest angles of Table 3."""
    model = CableModel(published.cable(stiffness), n=n, element="link")
    rest = published.RestShape(published.rest_angles()).on(model)
    h = model.chain.h
    found = [solve_equilibrium(model, model.nominal, rest, pose) for pose in published.poses()]
    bends = np.array([np.diff(eq.phi) for eq in found])
    weight = published.MASS / n * np.array(published.GRAVITY)
    gravity = np.array([gravity_slopes(eq.phi, weight, h)[1:] for eq in found])
    pull = []
    for eq in found:
        # lam . d r(L) / d theta_a, summed over the headings behind the joint.
        by_heading = h * (-eq.end_force[0] * np.sin(eq.phi) + eq.end_force[1] * np.cos(eq.phi))
        pull.append(np.cumsum(by_heading[::-1])[::-1][1:])
    elastic = stiffness / h * (bends - rest * h)
    return Balance(bends, elastic, gravity, np.array(pull))


def reaction(part: Part, replicas: tuple[Replica, ...]) -> None:
    """Eq. 14 without J^T lambda."""
    section = Section("reaction", "The missing reaction in Eq. 14")
    part.sections.append(section)
    rows, sizes, data = [], [], {}
    for replica in replicas:
        exact = balance(replica.stiffness)
        inverse = exact.inverse_stiffness
        loop = run_algorithm1(replica.guess, replica.measured, published.GRAVITY, n=FIRST)
        fit = first_fit(replica)
        closure = np.abs(exact.elastic + exact.gravity + exact.reaction).max()
        share = np.abs(exact.reaction).max() / np.abs(exact.gravity).max()
        sizes.append(share)
        rows.append(
            [
                f"{replica.stiffness * FIRST / published.LENGTH:.4g}",
                f"{share:.3g}",
                f"{closure:.0e}",
                number(inverse, 4),
                f"{loop.k_theta:.3g}",
                f"{fit.p[0] / fit.model.chain.h:.4g}",
            ]
        )
        data[replica.name] = {
            "reaction_over_gravity": share,
            "inverse_k_theta_of_exact_shapes": inverse,
            "k_theta_loop": loop.k_theta,
            "k_theta_batch": float(fit.p[0] / fit.model.chain.h),
        }
    part.data["reaction"] = data
    section.text = [
        "A cable held at its end balances k_θ (θ − θ₀) + gravity + Jᵀλ = 0 with the force λ on "
        "the end's holder; Eqs. 7 and 14 set the first two to zero. In exact shapes, without "
        f"noise, the neglected term is up to {max(sizes):.0f} times the largest gravity term. "
        "Eq. 15 then asks for a negative 1/k_θ, nearly the same for both stiffnesses, because "
        "it compares bends with gravity's slopes and never meets the true stiffness; kept "
        "positive, k_θ runs to infinity. The batch problem carries λ of every pose as an unknown.",
    ]
    section.tables.append(
        Table(
            "n = 10, twelve poses",
            [
                "true k_θ [N m/rad]",
                "reaction / gravity",
                "imbalance with reaction [N m]",
                "1/k_θ of Eq. 15, exact shapes",
                "k_θ, the loop",
                "k_θ, batch arcs",
            ],
            rows,
        )
    )
    _draw_balance(section, replicas[1])
    part.claims.append(
        Claim(
            "Eq. 14",
            "the gradient of the energy is zero in a static shape",
            "not at a held end: the reaction is missing, and Eq. 15's minimum lies at a negative "
            f"stiffness (1/k_θ = {rows[0][3]} and {rows[1][3]} for true {rows[0][0]} and "
            f"{rows[1][0]} N m/rad)",
            "does not hold",
        )
    )


def _draw_balance(section: Section, replica: Replica) -> None:
    exact = balance(replica.stiffness)
    caption = (
        f"Moments at the joints of ten links in two poses, EI = {replica.stiffness:.3f} N m². "
        "Eq. 14 says that elastic moment and gravity cancel."
    )
    joints = np.arange(2, FIRST + 1)
    with drawing(section, "reaction", caption, (8.0, 3.4)) as figure:
        for axes, pose in zip(figure.subplots(1, 2), (3, 8), strict=True):
            for values, color, marker, label in (
                (exact.elastic, BLUE, "o", "k_θ (θ − θ₀)"),
                (exact.gravity, GREEN, "v", "gravity"),
                (exact.elastic + exact.gravity, VERMILLION, "s", "their sum, 0 in Eq. 14"),
                (-exact.reaction, BLACK, "x", "minus the reaction"),
            ):
                axes.plot(joints, values[pose], marker=marker, color=color, label=label, ms=5)
            axes.set_title(f"{published.poses()[pose].name} m")
            axes.set_xlabel("joint")
        figure.axes[0].set_ylabel("moment [N m]")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=4)


def first_fit(replica: Replica) -> Fit:
    """Batch arcs from prior knowledge."""
    model = CableModel(replica.guess, n=FIRST, element="arc", n_rest=REST_COEFFICIENTS)
    return fit_model(model, replica.measured, Tolerances())


# ---- where Table 3's rest angles come from ----------------------------------------------------


def rest_angles(part: Part, straight: Replica) -> None:
    """theta_0 of the loop is the mean bend of the poses, whatever the cable's rest shape."""
    section = Section("rest-angles", "Where the rest angles of Table 3 come from")
    part.sections.append(section)
    printed = published.rest_angles()
    model = CableModel(published.cable(), n=FIRST, element="link")
    means = {}
    for name, angles in (("at α⁰, straight", 0 * printed), ("at αᶠ", printed)):
        found = [
            solve_equilibrium(model, model.nominal, angles / model.chain.h, pose)
            for pose in published.poses()
        ]
        means[name] = np.mean([np.diff(eq.phi) for eq in found], axis=0)
    loop = run_algorithm1(straight.guess, straight.measured, published.GRAVITY, n=FIRST)
    fit = first_fit(straight)
    joints = np.arange(1, FIRST) * model.chain.h
    batch = fit.model.rest.basis(joints) @ fit.coefficients * model.chain.h
    known = rest_curvature_of(fit)
    spread = np.interp(joints, known.s, known.std) * model.chain.h
    rows = {
        "printed αᶠ": printed,
        "mean bend of the twelve equilibria at αᶠ": means["at αᶠ"],
        "mean bend of the twelve equilibria at α⁰": means["at α⁰, straight"],
        "control, a straight cable: the loop": loop.theta_0,
        "control, a straight cable: batch arcs": batch,
        "± 95 %": NORMAL_95 * spread,
        "control, truth": straight.theta_0,
    }
    gap = float(np.abs(means["at αᶠ"] - printed).max())
    fooled = float(np.abs(loop.theta_0 - means["at α⁰, straight"]).max())
    section.text = [
        "With a stiffness that gravity cannot bend, Eq. 14 reads θ̂ = θ₀, and Eq. 15 makes θ₀ the "
        f"mean of the bends in the twelve poses. The printed θ₀ are that mean to {gap:.3f} rad; "
        "the print rounds by up to 0.005.",
        "All twelve poses bend the cable one way, so their mean has the shape of an arc for any "
        "cable. A control shows it: simulated data of a cable that is straight at rest make the "
        f"loop return its mean bend to {fooled:.3f} rad, a rest shape that is not there; the "
        f"batch problem finds θ₀ within {np.abs(batch).max():.3f} rad of zero, and says that it "
        f"knows it to ±{NORMAL_95 * spread.max():.3f} rad.",
        "So Table 3 does not show that the cable was bent at rest.",
    ]
    section.tables.append(
        Table(
            "θ₀ of joints 2 to 10 [rad], n = 10",
            ["", *(f"θ₀,{i}" for i in range(2, FIRST + 1))],
            [[name, *(number(x, 3) for x in values)] for name, values in rows.items()],
        )
    )
    part.data["rest_angles"] = {name: values.tolist() for name, values in rows.items()}
    part.claims.append(
        Claim(
            "Table 3",
            "θ₀ is the cable's rest shape",
            f"it equals the mean bend of the twelve poses to {gap:.3f} rad; a straight cable "
            f"gives the loop much the same (within {np.abs(loop.theta_0 - printed).max():.2f} rad)",
            "does not hold",
        )
    )


# ---- identifiability ---------------------------------------------------------------------------


def identifiability(part: Part, replicas: tuple[Replica, ...], executor: Executor) -> None:
    """Profile likelihood of the stiffness."""
    section = Section("identifiability", "Whether the stiffness can be told")
    part.sections.append(section)
    found = map_in_order(executor, _profile, list(replicas))
    caption = (
        "Rise of −2 log likelihood when the stiffness is held and all else refitted (batch arcs, "
        "n = 10). Below the dotted line lies the 95 % interval."
    )
    with drawing(section, "profile", caption, (6.6, 3.8)) as figure:
        axes = figure.subplots()
        for replica, (rise, _, _), color in zip(replicas, found, (ORANGE, BLUE), strict=True):
            label = f"true EI = {replica.stiffness:.3g} N m²"
            axes.plot(10**DECADES, rise, "o-", ms=3, color=color, label=label)
        axes.axhline(STEEP, color=GREY, ls=":")
        axes.set_xscale("log")
        axes.set_yscale("symlog", linthresh=STEEP)
        axes.set_ylim(bottom=-0.5)
        axes.set_xlabel("stiffness held / true stiffness")
        axes.set_ylabel("rise of −2 log L")
        axes.legend()
    (stiff, limit, _), (_, _, interval) = found
    flat = float(np.nanmax(stiff[DECADES > 0]))
    ends = " to ".join(
        "unbounded" if x is None else f"{x:.3f}" for x in (interval.low, interval.high)
    )
    section.text = [
        f"With the paper's stiffness the profile is flat: a hundred times as stiff costs "
        f"{flat:.1f} of the {limit:.1f} that count as evidence, because gravity moves such a "
        "cable by less than the noise. With the smaller stiffness the 95 % interval is "
        f"{ends} N m², the truth {replicas[1].stiffness:.3f}.",
        "A fit must therefore say that a stiff cable's EI is not identifiable, instead of "
        "printing the initial guess as an estimate; the shapes are predicted well without it.",
    ]
    part.data["profile"] = {
        "stiffness_over_truth": (10**DECADES).tolist(),
        **{
            replica.name: [None if np.isnan(x) else float(x) for x in rise]
            for replica, (rise, _, _) in zip(replicas, found, strict=True)
        },
    }
    part.claims.append(
        Claim(
            "Section 3.2",
            "the change in stiffness is minimal across discretization levels",
            f"these shapes cannot tell it: a hundred times as stiff costs {flat:.1f} of "
            f"{limit:.1f} in −2 log L",
            "cannot be told",
        )
    )


def _profile(replica: Replica) -> tuple[FloatArray, float, Interval]:
    fit = first_fit(replica)
    rises = stiffness_profile(fit, replica.stiffness * 10**DECADES)
    return rises, threshold(fit), profile_interval(fit)
