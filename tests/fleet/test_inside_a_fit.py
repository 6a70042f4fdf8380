"""Starts, folds, candidates and pulls of one fit give the same digits in other processes."""

from dataclasses import replace

import numpy as np
import pytest
from tiny_sessions import write_session

from dlo_casadi.config import load_config
from dlo_casadi.diagnosis.confirm import confirm
from dlo_casadi.diagnosis.crossval import cross_validate
from dlo_casadi.diagnosis.pull import estimate_pull
from dlo_casadi.diagnosis.search import screen
from dlo_casadi.effects import EFFECTS, RestCurvatureDrift
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.parallel import map_in_order, open_executor
from dlo_casadi.report.json_report import report_dict
from dlo_casadi.session import run_session


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    config = load_config(write_session(tmp_path_factory.mktemp("one") / "cable"))
    return run_session(config).fit


@pytest.fixture(scope="module")
def pool():
    with open_executor(jobs=2) as executor:
        yield executor


def test_a_whole_session(tmp_path):
    config = load_config(write_session(tmp_path / "cable", "thin"))
    few = {"lumped_mass", "point_force", "rest_curvature_drift"}
    limits = {"enabled": True, "max_effects": 1, "exclude": tuple(sorted(set(EFFECTS) - few))}
    asked = config.diagnosis.model_copy(update=limits)
    config = replace(config, diagnosis=asked)
    with open_executor(jobs=2, here=True) as executor:
        both = [report_dict(run_session(config, executor=where)) for where in (None, executor)]
    for report in both:
        del report["timing_s"]
    assert both[0] == both[1]
    assert {row["name"] for row in both[0]["candidates"]} >= few


class _Confirm:
    """`confirm` of one fit, without what cannot be compared."""

    def __init__(self, fit):
        self.fit = fit

    def __call__(self, screened):
        found = confirm(self.fit, screened)
        return None if found is None else (found.fit.p, found.validation.squares, found.bic)


def test_folds_where_a_state_is_carried(fit, pool):
    model = fit.model.with_effect(RestCurvatureDrift())
    drifting = fit_model(model, fit.problem.history, fit.problem.tolerances, start=fit)
    here, there = cross_validate(drifting), cross_validate(drifting, pool)
    assert here.complete
    assert np.array_equal(here.squares, there.squares)


def test_refits_of_candidates(fit, pool):
    best = screen(fit, None, ())[:2]
    work = _Confirm(fit)
    here, there = [work(item) for item in best], map_in_order(pool, work, best)
    assert any(item is not None for item in here)
    for one, other in zip(here, there, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_places_of_a_pull(fit, pool):
    here, there = estimate_pull(fit), estimate_pull(fit, pool)
    assert here is not None
    assert here.position == there.position
    assert np.array_equal(here.force_per_pose, there.force_per_pose)
