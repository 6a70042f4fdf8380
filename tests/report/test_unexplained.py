"""Where the model does not explain what was measured, nothing hands out an interval."""

from dataclasses import replace

import pytest
from small_sessions import context

from dlo_casadi.cable.file import load
from dlo_casadi.cli import main
from dlo_casadi.diagnosis.diagnose import Verdict
from dlo_casadi.report.documents import parameters_text
from dlo_casadi.report.sections import report_dict
from dlo_casadi.report.tables import NO_FIT, fitted_rows, footnotes
from dlo_casadi.session import run
from dlo_casadi.session.outcome import Outcome


def judged(outcome: Outcome, verdict: Verdict | None) -> Outcome:
    """The session with another verdict of its diagnosis."""
    return run.judged(replace(outcome, verdict=verdict))


@pytest.fixture(scope="module")
def unexplained(outcome):
    return judged(outcome, "unexplained")


def test_the_last_stage_says_that_it_does_not_explain(outcome, unexplained):
    *before, last = report_dict(unexplained)["stages"]
    assert last["explains"] is False
    assert last["parameters"]["bending_stiffness"]["interval_95"] is None
    assert all(stage["explains"] is None for stage in before)
    assert report_dict(judged(outcome, "complete"))["stages"][-1]["explains"] is True
    assert judged(outcome, None).stages[-1].explains is None


@pytest.mark.parametrize("verdict", ["complete", "effect_found"])
def test_a_doubt_takes_the_verdict_and_the_intervals(outcome, verdict, monkeypatch):
    monkeypatch.setattr(run.remarks, "doubts_of", lambda *_: ("not converged",))
    found = judged(outcome, verdict)
    assert (found.verdict, found.doubts) == ("unexplained", ("not converged",))
    assert found.stages[-1].parameters["bending_stiffness"].interval_95 is None
    # Also where nothing was diagnosed: report.json says what page and terminal say.
    assert judged(outcome, None).verdict == "unexplained"


def test_tables_and_page_have_no_interval(unexplained):
    for name, value, interval, remark in fitted_rows(unexplained):
        assert (interval, remark) == ("", NO_FIT), name
        assert "+" not in value.replace("e+", "")
    assert any("does not explain" in line for line in footnotes(unexplained))
    fitted = [
        row for row in context("parameters", unexplained)["parameters"] if row["remark"] == NO_FIT
    ]
    assert fitted
    assert not any(row["interval"] for row in fitted)


def test_predict_says_so(unexplained, tmp_path, capsys):
    file = tmp_path / "parameters.yaml"
    file.write_text(parameters_text(unexplained))
    assert load(file).metadata.explains is False
    assert load(file).params["bending_stiffness"].interval_95 is None
    assert main(["predict", str(file), "--end", "0.3", "-0.1"]) == 0
    assert "verdict: unexplained" in capsys.readouterr().out.replace("\n", " ")
