"""Folds, candidates and pulls of one session give the same digits in other processes."""

import pytest
from tiny_sessions import write_session

from dlo_casadi.config import load_config
from dlo_casadi.effects import EFFECTS
from dlo_casadi.report.sections import report_dict
from dlo_casadi.runtime.parallel import open_executor
from dlo_casadi.session import run_session


@pytest.fixture(scope="module")
def fit(tiny):
    return tiny.fit


@pytest.fixture(scope="module")
def pool():
    with open_executor(jobs=2, here=True) as executor:
        yield executor


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "tried", "verdict"),
    [
        ("thin", "gravity_tilt", "unexplained"),
        ("softening", "bending_softening", "effect_found"),
    ],
)
def test_a_whole_session(tmp_path, pool, name, tried, verdict):
    """One that ends with a pull, and one with an effect."""
    config = load_config(write_session(tmp_path / "cable", name))
    few = {tried, "rest_curvature_drift"}
    limits = {"enabled": True, "max_effects": 1, "exclude": tuple(sorted(set(EFFECTS) - few))}
    config = config.changed(
        estimation=config.estimation.changed(algorithm1=True),
        diagnosis=config.diagnosis.changed(**limits),
    )
    both = [report_dict(run_session(config, executor=where)) for where in (None, pool)]
    for report in both:
        del report["timing_s"]
        for stage in report["stages"]:
            stage.pop("note", None)  # the loop's tells its seconds
    assert both[0] == both[1]
    assert both[0]["verdict"] == verdict
    assert both[0]["stages"][2]["rmse_fit"], "the paper's loop has run"
    assert tried in {row["name"] for row in both[0]["candidates"]}
    assert any(row["rmse_cross_validated"] for row in both[0]["candidates"]), "some were refitted"
    assert (verdict == "unexplained") == bool(both[0]["unexplained"])
