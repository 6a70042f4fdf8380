"""The Python API: results that show themselves, predict and write themselves."""

import copy
import dataclasses
import json
import pickle
import re
import sys
from io import StringIO
from pathlib import Path

import casadi as ca
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from test_figures import EFFECT

import dlo_casadi as dlo
from dlo_casadi.cli import main
from dlo_casadi.diagnosis.found import Ranked
from dlo_casadi.effects.nuisances import EdgeBias
from dlo_casadi.report.terminal import candidate_table


@pytest.fixture(scope="module")
def result(outcome):
    """The small session's outcome as `fit` returns it."""
    values = {field.name: getattr(outcome, field.name) for field in dataclasses.fields(outcome)}
    return dlo.Result(**values)


def test_a_path_is_a_configuration(tmp_path):
    with pytest.raises(dlo.ConfigError, match="no such file"):
        dlo.fit(str(tmp_path / "rope.yaml"))


def test_a_fitted_cable_is_no_configuration(written):
    with pytest.raises(
        dlo.ConfigError, match=r"a fitted cable, no configuration\.\n  Try: dlo_casa"
    ):
        dlo.fit(written[0] / "parameters.yaml")


def test_a_number_is_no_configuration():
    with pytest.raises(dlo.ConfigError, match=r"3 is no configuration.\n  Try: the path of a YAML"):
        dlo.fit(3)


def test_text_says_what_was_found(result):
    text = str(result)
    assert text.startswith("short_clean: ")
    assert re.search(r"bending_stiffness  0\.\d+ ± 0\.\d+ N m\^2", text)
    assert "held out  0." in text
    assert re.search(r"noise alone \(estimated\)  0\.\d+ mm", text)
    assert repr(result) == text
    assert len(text.splitlines()) < 12


def test_held_out_poses_without_a_line_are_named(result):
    measurement = dataclasses.replace(result.measurement, held_out_missing=("pose_09",))
    lost = dataclasses.replace(result, measurement=measurement)
    assert "  held out, not measured  pose_09" in str(lost).splitlines()


def test_parameters_have_names_and_quality(result):
    stiffness = result.params["bending_stiffness"]
    assert stiffness == result.stages[-1].parameters["bending_stiffness"]
    assert stiffness.interval_95[0] < stiffness.value < stiffness.interval_95[1]
    assert not stiffness.fixed
    assert re.fullmatch(
        r"<Estimate 0\.\d+ ± 0\.\d+ N m\^2 \(95 %: 0\.\d+ to 0\.\d+\)>", repr(stiffness)
    )
    offset = result.params["end_offset.dx"]
    assert (offset.unit, offset.interval_95) == ("m", None)
    assert offset.std == pytest.approx(result.covariance.std["end_offset.dx"])
    variance = result.covariance["end_offset.dx", "end_offset.dx"]
    assert variance == pytest.approx(offset.std**2)
    assert np.diag(result.covariance.correlation) == pytest.approx(1.0)
    with pytest.raises(dlo.DloError, match="'mass' was not fitted; fitted are bending_stiffness, "):
        result.covariance["mass", "mass"]
    told = dataclasses.replace(stiffness, fixed=True, interval_95=(0.1, None), identifiable=False)
    assert str(told).endswith("(95 %: 0.1 to unbounded), fixed, not identifiable")


def test_residuals_are_distances_to_the_prediction(result):
    """Of all poses, held-out ones too; their RMS across the prediction is the error of the fit."""
    assert {name: len(gap) for name, gap in result.residuals.items()} == {
        pose.name: len(pose.points) for pose in result.poses
    }
    fitted = [result.residuals[pose.name] for pose in result.poses if pose.role == "fit"]
    squares = np.concatenate([(gap**2).sum(axis=1) for gap in fitted])
    assert np.sqrt(squares.mean()) == pytest.approx(result.stages[-1].rmse_fit)


def test_a_summary_names_all_parameters(result):
    text = result.summary()
    assert all(f"\n  {name} " in text for name in result.params)
    assert f"{len(result.poses)} poses (" in text


def test_parameters_are_a_table_of_pandas(result, monkeypatch):
    pandas = pytest.importorskip("pandas")
    table = result.to_dataframe()
    assert isinstance(table, pandas.DataFrame)
    assert list(table.index) == list(result.params)
    row = table.loc["bending_stiffness"]
    known = result.params["bending_stiffness"]
    assert (row["value"], row["low_95"], row["unit"]) == (
        known.value,
        known.interval_95[0],
        "N m^2",
    )
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(dlo.DloError, match=r"pandas is not installed.\n  Try: pip install"):
        result.to_dataframe()


def test_a_result_is_kept_and_copied(result):
    for other in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert other.params == result.params
        assert np.array_equal(other.covariance.values, result.covariance.values)
        assert np.array_equal(other.cable.p, result.cable.p)
    shape = result.cable.solve((0.3, -0.1))
    assert str(pickle.loads(pickle.dumps(shape))) == str(shape)


def test_what_a_result_holds_is_printed_in_a_line(result):
    """A stage had 5,000 lines: arrays are shown by their shapes, many items by their number."""
    stage = result.stages[-1]
    shape = next(iter(stage.shapes.values()))
    for one in (stage, shape, stage.rest_curvature, result.fit, result.poses[0], result.stages):
        assert len(repr(one).splitlines()) == 1
        assert len(repr(one)) < 2500
    assert repr(stage).startswith(f"Stage(name='batch', rmse_fit={stage.rmse_fit:.4g}")
    assert "parameters={bending_stiffness}" in repr(stage)
    assert f"points=<array {result.poses[0].points.shape}>" in repr(result.poses[0])


def test_a_summary_has_the_errors_of_all_stages_and_the_rest_curvature(result):
    lines = [re.split(r"  +", line.strip()) for line in result.summary().splitlines()]
    rows = {line[0]: line[1:] for line in lines}
    last, first = result.stages[-1], result.stages[0]
    assert rows["stage"] == ["fit", "cross-validated", "held out", "chi2 per dof"]
    assert rows["initial guess"][:2] == ["before", f"{1e3 * first.rmse_fit:.3g} mm"]
    after = [f"{1e3 * x:.3g} mm" for x in (last.rmse_fit, last.rmse_held_out)]
    assert rows["declared model, fitted"] == [
        *("after", after[0], "-", after[1], f"{last.chi2_per_dof:.3g}")
    ]
    value = last.rest_curvature.value
    assert rows["rest curvature"][0] == f"{value.min():.3g} to {value.max():.3g} 1/m"


def test_a_summary_has_added_effects_with_their_names_in_params(result):
    label, value = "tether", dlo.Estimate(2.0, 0.1, "N/m")
    added = dataclasses.replace(EFFECT, name=label, label=label, p_value=1e-9)
    stage = dataclasses.replace(result.stages[-1], parameters={"tether.stiffness": value})
    found = dataclasses.replace(result, effects=(added,), stages=(*result.stages[:-1], stage))
    (line,) = (x for x in found.summary().splitlines() if x.startswith("  tether: p 1e-09, "))
    assert line.endswith("; tether.stiffness")
    assert "  tether.stiffness  " in found.summary()


def test_params_are_a_table_in_a_notebook_and_have_the_names_of_lmfit(result):
    html, text = result.params._repr_html_(), repr(result.params)
    stiffness = result.params["bending_stiffness"]
    value = f"{stiffness}".partition(" (95 %")[0]
    assert f"<tr><td>bending_stiffness</td><td>{value}</td>" in html
    assert html.count("<tr>") == 1 + len(result.params) == 1 + len(text.splitlines())
    assert stiffness.stderr == stiffness.std
    assert dataclasses.replace(stiffness, fixed=True).stderr is None
    assert result.cable.params._repr_html_().count("<tr>") == 1 + len(result.cable.params)


def test_a_notebook_gets_a_table_with_everything_escaped(result):
    cable = result.config.cable.changed(name="<script>&")
    shown = dataclasses.replace(result, config=result.config.changed(cable=cable))
    html = shown._repr_html_()
    assert "<table><tr><td>bending_stiffness</td>" in html
    assert "&lt;script&gt;&amp;" in html
    assert "<script>" not in html


def test_plots_are_figures_that_leave_pyplot_alone(result):
    before = dict(mpl.rcParams)
    figure = result.plot()
    assert isinstance(figure, Figure)
    lines = figure.axes[0].get_lines()
    drawn = [line for line in lines if len(line.get_xdata()) > 100]
    assert len(drawn) == len(result.poses)
    assert "held out of the fit" in {line.get_label() for line in lines}
    assert isinstance(result.cable.solve((0.3, -0.1)).plot(), Figure)
    assert dict(mpl.rcParams) == before


def test_fit_prints_its_report_and_nothing_else(written):
    folder, printed = written
    assert json.loads(printed) == json.loads((folder / "report.json").read_text())


def test_a_result_predicts_as_its_file_does(result, written):
    folder, _ = written
    direct, from_file = result.cable.solve((0.3, -0.1)), dlo.predict(folder, (0.3, -0.1))
    assert np.array_equal(direct.points, from_file.points)
    assert str(direct) == str(from_file)
    text = str(direct)
    assert "end: (0.3, -0.1) m" in text
    assert "stable: yes" in text
    assert "<tr><td>end</td><td>(0.3, -0.1) m</td></tr>" in direct._repr_html_()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda r: r.params["EI"], "nothing is called 'EI'; there are bending_stiffness"),
        (lambda r: r.cable.params["EI"], "nothing is called 'EI'; there are bending_stiffness"),
        (lambda r: r.residuals["pose_99"], "nothing is called 'pose_99'; there are pose_01"),
        (lambda r: r.covariance["a", "b", "c"], "a covariance is of two names, found"),
        (lambda r: r.covariance["bending_stiffness"], "two names, found 'bending_stiffness'"),
        (lambda r: r.write(None), "a path belongs here, found None"),
        (lambda r: r.cable.with_mesh(2.5), "n: a whole number, 2 to 2000 .* found 2.5"),
        (lambda r: r.cable.with_mesh(0), "n: a whole number, .* found 0"),
        (lambda r: r.cable.with_mesh(element="foo"), "element: one of .* found 'foo'"),
        (lambda r: r.cable.initial("abc"), "pose: numbers belong here, found 'abc'"),
        (lambda r: r.cable.function(search="x"), "search is a casadi.Function, found 'x'"),
        (lambda r: r.cable.function(parameters=5), "parameters: True, False or names .* found 5"),
        (lambda r: r.cable.function(parameters="EI"), "no parameter 'EI'"),
        (lambda r: r.cable.compile(flags="-O2 -g"), r"Try: \['-O2', '-g'\]"),
    ],
)
def test_mistakes_with_a_result_are_told(wrong, message, result):
    with pytest.raises(dlo.DloError, match=message):
        wrong(result)


def test_one_name_is_no_list_of_letters(result):
    function = result.cable.function(parameters="bending_stiffness")
    assert function.size_in("parameters") == (1, 1)


def test_cables_and_covariances_are_short(result):
    """A line for each parameter, and no matrix."""
    fitted = [name for name, found in result.cable.params.items() if not found.fixed]
    assert len(repr(result.cable).splitlines()) == 1 + len(fitted)
    assert len(repr(result.covariance).splitlines()) == 1 + len(result.covariance.names)
    cable, value = result.cable, dlo.Estimate(1e-5, 1e-6, "m")
    params = cable.metadata.params | {"edge_bias.a1": value}  # a nuisance that is not shown
    metadata = dataclasses.replace(cable.metadata, params=params)
    model = cable.model.with_effect(EdgeBias())
    seen = dataclasses.replace(cable, model=model, metadata=metadata)
    assert repr(seen) == repr(cable)


def test_a_number_is_no_executor(outcome):
    with pytest.raises(dlo.DloError, match=r"executor=2 is no Executor.\n  Try: with dlo_casadi"):
        dlo.fit(outcome.config.path, executor=2)


def test_the_solver_of_a_folder_of_results(written, tmp_path, capsys):
    folder, _ = written
    command = ["generate-solver", str(folder), "--output"]
    assert main([*command, str(tmp_path / "c"), "--json"]) == 0
    files = json.loads(capsys.readouterr().out)
    assert {Path(file).name for file in files["files"]} >= {"dlo_solver.c", "dlo_solver.h"}
    assert len(files["solver_hash"]) >= 16
    (tmp_path / "file").touch()
    assert main([*command, str(tmp_path / "file")]) == 2
    assert "file cannot be written: it is a file" in capsys.readouterr().err


def test_the_candidates_are_printed_in_their_order(outcome):
    diagnosed = dataclasses.replace(
        outcome,
        effects=(EFFECT,),
        candidates=(
            Ranked("lumped_mass", 12.34, 1e-9, 2e-4),
            Ranked("point_force", 12.34, 1e-9, 2e-4),
            Ranked("side_load", 0.5, 0.7, None),
        ),
    )
    printed = StringIO()
    Console(file=printed, width=120).print(candidate_table(diagnosed))
    text = " ".join(printed.getvalue().split())
    assert "tried: first those that were refitted, by log likelihood" in text
    assert "under the noise left once it is in the model" in text
    rows = [" ".join(line.split()) for line in printed.getvalue().splitlines()]
    assert "lumped_mass 12.3 1e-09 0.2 mm added to the model" in rows
    assert "point_force 12.3 1e-09 0.2 mm cannot be told apart from lumped_mass" in rows
    assert "side_load 0.5 0.7 - not refitted" in rows
    order = [row.split()[0] for row in rows if "_" in row]
    assert order == ["lumped_mass", "point_force", "side_load"]


def test_every_public_name_is_there():
    for name in dlo.__all__:
        assert getattr(dlo, name).__doc__ or name == "EFFECTS", name
    assert set(dlo.__all__) < set(dir(dlo))
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        dlo.fitt  # noqa: B018


LINE = [[0.0, 0.0], [0.1, -0.1], [0.2, 0.0]]


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ("pose_01.csv", "found 'pose_01.csv'. Try: file, for the name of a file"),
        (np.ma.masked_less(LINE, 0.0), "[0.1, nan] in place 2 is not finite; leave out the points"),
        ([[0, 0], [1, None], [2, 0]], "[1.0, nan] in place 2 is not finite"),
        (ca.SX.sym("points", 3, 2), "points: numbers [[x, y], ...], in space"),
        ([[10**400, 0], [1, 0]], "points: numbers [[x, y], ...], in space"),
    ],
)
def test_points_that_are_none_say_what_to_try(points, said):
    with pytest.raises(dlo.ConfigError) as refused:
        dlo.Pose((0, 0), (0.2, 0), points=points)
    assert said in str(refused.value)


def test_a_masked_array_without_masked_values_has_points():
    assert dlo.Pose((0, 0), (0.2, 0), points=np.ma.masked_less(LINE, -1.0)).points[1] == (0.1, -0.1)


def test_a_table_of_pandas_has_points():
    pandas = pytest.importorskip("pandas")
    pose = dlo.Pose((0, 0), (0.2, 0), points=pandas.DataFrame(LINE, columns=["x_m", "y_m"]))
    assert pose.points == tuple(map(tuple, LINE))
