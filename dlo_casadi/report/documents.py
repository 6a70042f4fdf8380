"""Write what a run or a check has found for other programs.

Parts of report.json (schema "dlo-report/1"), whose keys the `sections` give it, and
parameters.yaml, a fitted cable that is complete enough to compute with.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray, length_of
from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.cable.file import metadata_of
from dlo_casadi.cable.fitted_cable import FittedCable
from dlo_casadi.cable.saved import cable_document, parameters_hash
from dlo_casadi.config import Config, Limits, dump_yaml
from dlo_casadi.config.values import AXES
from dlo_casadi.diagnosis.if_hidden import IfHidden
from dlo_casadi.diagnosis.next_motion import NextMotion
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.estimation.prediction import uncertainty_of
from dlo_casadi.estimation.result import Fit
from dlo_casadi.io.files import finite
from dlo_casadi.model.cable_model import STIFFNESSES
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.rod.quantities import QUANTITIES
from dlo_casadi.runtime.executors import software
from dlo_casadi.runtime.work import Part
from dlo_casadi.session.checked_motions import CheckedMotion
from dlo_casadi.session.fitting import Declared
from dlo_casadi.session.in_motion import MotionStage
from dlo_casadi.session.outcome import Outcome, PoseInput, RestCurvatureEstimate, Stage
from dlo_casadi.session.questions import Suspicion


def work_list(part: Part) -> list[dict[str, Any]]:
    """What the parts of a run took: calls, steps of fits, seconds, and their own parts."""
    return [
        {"name": name, **fields_of(one, "calls", "steps", "seconds"), "parts": work_list(one)}
        for name, one in part.parts.items()
    ]


def fields_of(item: object, *names: str) -> dict[str, Any]:
    """Fields of an object that have the same names in the file."""
    return {name: getattr(item, name) for name in names}


def hidden_dict(found: IfHidden) -> dict[str, Any]:
    """What one effect that the data do not exclude could do to a stiffness."""
    return fields_of(found, "effect", "interval") | {
        "parameters": {name: size._asdict() for name, size in found.values.items()},
        "telling": found.telling and asdict(found.telling),
        "motion": motion_proposal(found.motion),
    }


def motion_proposal(found: NextMotion | None) -> dict[str, Any] | None:
    """The motion that would tell models of the same still shapes apart."""
    if found is None:
        return None
    return {
        **fields_of(found, "pose", "of"),
        "at_m": found.at,
        "aside_m": found.aside,
        "duration_s": found.duration,
        "frequencies_hz": found.frequencies,
        "rivals": {
            name: {
                "frequencies_hz": one.frequencies,
                "expected_difference_std": one.separation,
            }
            for name, one in found.rivals.items()
        },
    }


def stage_dict(stage: Stage, outcome: Outcome) -> dict[str, Any]:
    """One stage; all numbers are None where it does not apply."""
    held_out = asdict(outcome.held_out(stage)) if stage.parameters else None
    if not stage.parameters:
        nothing = RestCurvatureEstimate(*np.zeros((3, 0)))
        unknown = {"bending_stiffness": Estimate(math.nan, math.nan, "N m^2")}
        stage = replace(stage, parameters=unknown, rest_curvature=nothing)
    rest = stage.rest_curvature
    known = rest.known
    curvature: dict[str, Any] = {"s": rest.s, "value": known[0], "std": known[1]}
    if rest.value.ndim > 1:  # in space one row per material axis
        about = zip(("k_y", "k_z"), *known, strict=True)
        own = {axis: {"value": value, "std": std} for axis, value, std in about}
        curvature = {"s": rest.s, **own}
    kept = ("value", "std", "unit", "interval_95", "interval_95_if_hidden", "identifiable")
    return {
        **fields_of(stage, "name", "explains", "rmse_fit", "rmse_held_out"),
        **motion_dict(stage.motion),
        **{
            f"{quantity.name}_rmse_{role}": errors.of(quantity)
            for quantity in QUANTITIES
            for role, errors in (
                ("fit", stage.readings_fit),
                ("held_out", stage.readings_held_out),
            )
        },
        "readings": {
            pose: {
                key: {"measured": known, "predicted": model}
                for key, (known, model) in shape.readings.items()
            }
            for pose, shape in stage.shapes.items()
            if shape.readings
        },
        "clips": {pose: shape.clips for pose, shape in stage.shapes.items() if shape.clips},
        "fed": {pose: shape.fed for pose, shape in stage.shapes.items() if shape.fed},
        "contacts": {pose: one.contacts for pose, one in stage.shapes.items() if one.contacts},
        **fields_of(stage, "rmse_fit_measured_branch", "rmse_held_out_measured_branch"),
        "other_branch": {
            pose: {
                "rmse": stage.shapes[pose].rmse,
                "rmse_measured_branch": found.rmse,
                **fields_of(found, "branch", "turns"),
            }
            for pose, found in stage.other_branch.items()
        },
        "measured_side": {pose: asdict(found) for pose, found in stage.measured_side.items()},
        "held_out": held_out,
        "chi2_per_dof": stage.chi2_per_dof,
        "parameters": {
            **{key: fields_of(found, *kept) for key, found in stage.parameters.items()},
            "rest_curvature": curvature,
        },
    }


def motion_dict(motion: MotionStage | None) -> dict[str, Any]:
    """Errors [m] of the recorded motions in a stage; no keys without motions."""
    if motion is None:
        return {}
    return {
        "motion_rmse_fit": motion.rmse_fit,
        "motion_rmse_held_out": motion.rmse_held_out,
        "motion_chi2_per_dof": motion.chi2_per_dof,
        "motions": {item.name: {"role": item.role, "rmse": item.rmse} for item in motion.shown},
    }


# ---- a check -----------------------------------------------------------------------------------


def check_dict(
    config: Config,
    inputs: Sequence[PoseInput],
    found: Sequence[Suspicion],
    motions: Sequence[CheckedMotion] = (),
) -> dict[str, Any]:
    """Results of `dlo check` in SI units: ok, mistakes, warnings, a row for each pose, motion."""
    unread = [f"{item.name}: {item.problem}" for item in inputs if item.problem]
    known = {item.name for item in inputs}
    left_out = [f"{item.name}: {item.reason}" for item in config.skipped if item.name not in known]
    mistakes = [*(item.message for item in found), *left_out, *unread]
    mistakes += [f"{one.name}: {one.problem}" for one in motions if one.problem]
    warnings = [*config.warnings, *(f"{x.name}: {text}" for x in motions for text in x.warnings)]
    seen = [item for item in inputs if item.readable and not item.unseen]
    if seen and not any(len(item.points) for item in seen):
        warnings.append(
            "no pose has a line in space, so lengths and fixtures are compared with nothing. Try: "
            "two or more photographs of each pose; camera.matrix, which `dlo calibrate` finds."
        )
    return finite(
        {
            "config": config.name,
            "ok": not mistakes,
            "mistakes": mistakes,
            "warnings": warnings,
            "poses": [_checked(config, item) for item in inputs],
            **({"motions": [asdict(one) for one in motions]} if motions else {}),
        }
    )


def _checked(config: Config, item: PoseInput) -> dict[str, Any]:
    """Results of one pose; None for what was not found."""
    declared = {pose.name: pose for pose in config.experiment.poses}[item.name]
    length, away = None, []
    if len(item.points):
        length = length_of(item.points)
        ends = ((item.points[0], declared.start), (item.points[-1], declared.end))
        away = [float(np.linalg.norm(x - place)) for x, place in ends if place is not None]
    return {
        "name": item.name,
        "role": item.role,
        "points": len(item.points),
        "length": length,
        "length_over_declared": None if length is None else length / config.cable.length,
        "largest_distance_from_fixture": max(away, default=None),
        **fields_of(item, "coverage", "confidence", "pixel", "markers"),
        "problem": item.problem or None,
        "advice": item.messages,
    }


# ---- parameters.yaml -----------------------------------------------------------------------------


def parameters_text(outcome: Outcome) -> str:
    """The text of parameters.yaml; equal results give equal bytes."""
    head = (
        f"# {outcome.config.cable.name}: parameters fitted by dlo_casadi. SI units: m, kg, s, N, "
        "rad.\n# null: a bound or an end of an interval that does not exist. fitted: false: as "
        "declared.\n"
    )
    return head + dump_yaml(parameters_dict(outcome))


def fitted_cable(outcome: Outcome) -> FittedCable:
    """The fitted cable of a run, the same that `load` reads from the run's file."""
    fit, metadata = outcome.fit, metadata_of(parameters_dict(outcome), outcome.config.path)
    # The supports of the session are no part of a cable.
    return FittedCable(replace(fit.model, clips=(), obstacles=()), fit.p, fit.rest_now, metadata)


def cable_of_known(known: Declared, coefficients: FloatArray, limits: Limits) -> FittedCable:
    """A cable without uncertainty, with rest coefficients [1/m], in the form of a fitted one."""
    model, p, rest = known.model, known.start, known.model.rest_basis @ coefficients
    nothing = Uncertainty((), np.zeros((0, 0)), {}, PoseScatter())
    document = cable_document(model, p, coefficients, rest, nothing)
    document |= {"limits": limits.given, "config": model.cable.name, "versions": software()}
    document["model_hash"] = parameters_hash(document)
    return FittedCable(model, p, rest, metadata_of(document, None))


def parameters_dict(outcome: Outcome) -> dict[str, Any]:
    """Everything that parameters.yaml holds, as plain data."""
    config = outcome.config
    document = fit_dict(outcome.fit)
    for name in STIFFNESSES:
        stiffness = outcome.stages[-1].parameters.get(name)
        if stiffness is not None:
            document["parameters"][name] |= {
                "interval_95": finite(stiffness.interval_95),
                "interval_95_if_hidden": finite(stiffness.interval_95_if_hidden),
                "hidden": stiffness.hidden,
                "identifiable": stiffness.identifiable,
            }
    if config.cable.youngs_modulus is not None:
        document["cable"]["youngs_modulus"] = config.cable.youngs_modulus
    document["explains"] = outcome.stages[-1].explains
    document["fixtures"] = shared_fixtures(config)
    document |= {"limits": config.limits.given} if config.limits.given else {}
    document["model_hash"] = parameters_hash(document)
    document["config"] = config.name
    document["config_hash"] = _hash(config)
    document["versions"] = dict(outcome.versions)
    return document


def scatter_dict(fit: Fit) -> dict[str, Any] | None:
    """What differs from pose to pose, and which sources cannot be distinguished from it."""
    found = fit.problem.priors.pose_scatter
    if not found.std or not found.shown:
        return None
    others = [other.source for other in found.rivals]
    std, unit = found.size(fit.model, float(fit.p[0]))
    return {"source": found.source, "std": std, "unit": unit, "or": others}


def fit_dict(fit: Fit) -> dict[str, Any]:
    """Results of the fit alone: model, parameters, covariance and state."""
    return cable_document(fit.model, fit.p, fit.coefficients, fit.rest_now, uncertainty_of(fit))


def shared_fixtures(config: Config) -> dict[str, Any]:
    """Start and clamp directions that all poses share."""
    shared: dict[str, Any] = {}
    direction = AXES[len(config.experiment.gravity)].direction
    for key in ("start", f"start_{direction}", f"end_{direction}"):
        values = {getattr(pose, key) for pose in config.experiment.poses}
        shared[key] = finite(values.pop()) if len(values) == 1 else None
    return shared


def _hash(config: Config) -> str | None:
    """SHA-256 of the configuration; None if its file is no longer readable."""
    try:
        known = config.text.encode() if config.path is None else config.path.read_bytes()
    except OSError:
        return None
    return hashlib.sha256(known).hexdigest()
