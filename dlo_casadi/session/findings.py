"""A diagnosis in the report's own terms: effects, candidates, what is unexplained, what next."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from dlo_casadi.diagnosis.diagnose import Diagnosis, separating_pose
from dlo_casadi.diagnosis.pull import Pull
from dlo_casadi.diagnosis.selection import AddedEffect, Ranked
from dlo_casadi.effects import Effect
from dlo_casadi.estimation.result import Fit


def findings_of(diagnosis: Diagnosis) -> dict[str, Any]:
    """What an outcome holds of a diagnosis, by its fields."""
    structure = {"before": diagnosis.structure_before, "after": diagnosis.structure_after}
    return {
        "verdict": diagnosis.verdict,
        "effects": tuple(_effect_row(item, diagnosis.after) for item in diagnosis.added),
        "candidates": tuple(_candidate_row(row) for row in diagnosis.ranked),
        "unexplained": None if diagnosis.pull is None else _unexplained_row(diagnosis.pull),
        "structure": {when: asdict(tests) for when, tests in structure.items()},
        "hidden_weight": None if diagnosis.weight is None else asdict(diagnosis.weight),
        "diagnosis": diagnosis,
    }


def _effect_row(item: AddedEffect, fit: Fit) -> dict[str, Any]:
    return {
        "name": item.candidate.name,
        "parameters": effect_parameters(fit, item.candidate.effect),
        "p_value": item.p_value,
        "rmse_cross_validated_before": item.before.rmse if item.before.complete else None,
        "rmse_cross_validated_after": item.after.rmse,
        "indistinguishable_from": list(
            dict.fromkeys([*(rival.candidate.name for rival in item.rivals), *item.equivalents])
        ),
    }


def effect_parameters(fit: Fit, effect: Effect) -> dict[str, dict[str, Any]]:
    """Value, standard deviation and unit of an effect's parameters.

    Parameters that vanish at infinity are estimated as their inverse; both are given.
    """
    rows: dict[str, dict[str, Any]] = {}
    for q in effect.parameters(fit.model.cable):
        full = f"{effect.label}.{q.name}"
        value, std = fit.value(full), fit.std(full)
        rows[q.name] = {"value": value, "std": std, "unit": q.unit}
        if q.name in effect.inverses:
            name, unit = effect.inverses[q.name]
            known = value > 0
            rows[name] = {
                "value": 1 / value if known else None,
                "std": std / value**2 if known else None,
                "unit": unit,
            }
    return rows


def _candidate_row(row: Ranked) -> dict[str, Any]:
    kept = ("name", "score", "p_value", "rmse_cross_validated")
    return {key: getattr(row, key) for key in kept} | {"reason": row.reason or None}


def _unexplained_row(pull: Pull) -> dict[str, Any]:
    """The load that assumes no cause."""
    problem = pull.fit.problem
    return {
        "force": [float(x) for x in pull.force_per_pose.mean(axis=0)],
        "force_per_pose": np.asarray(pull.force_per_pose).tolist(),
        "poses": [problem.measured[j].pose.name for j in problem.used],
        "position": pull.position,
        "interval_95": list(pull.interval),
    }


def next_pose_row(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """The pose that separates rival explanations, or None."""
    told = separating_pose(diagnosis)
    if told is None:
        return None
    pose, rivals = told
    return {
        "end": list(pose.end),
        "separates": list(rivals),
        "expected_difference_m": pose.difference,
        # In standard deviations of one measured line.
        "expected_difference_std": pose.separation,
        # Of a sensor of forces and moments: in N or N m, and in standard deviations of one reading.
        "reading": asdict(pose.reading),
    }
