"""The distance that noise alone gives, wherever it stands beside the points' distances."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from small_sessions import BARE
from test_terminal import said

from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.prediction import noise_distance
from dlo_casadi.report import figures
from dlo_casadi.report.page import report_page
from dlo_casadi.report.sections import report_dict
from dlo_casadi.report.tables import outcome_html, outcome_text
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.show.style import BLACK
from dlo_casadi.show.text import millimetres

STD = 3e-4


@pytest.mark.parametrize("d", [2, 3])
def test_a_line_is_compared_across_and_a_marker_in_all_directions(d):
    """Of a line of 3 points and 5 markers: the RMS over all of them."""
    pose = HeldPose((0.0,) * d)
    line = MeasuredPose.of_points(pose, np.zeros((3, d)))
    markers = MeasuredPose.of_points(pose, np.zeros((5, d)), s=np.arange(5.0))
    assert noise_distance([line], STD) == pytest.approx(np.sqrt(d - 1) * STD)
    assert noise_distance([markers], STD) == pytest.approx(np.sqrt(d) * STD)
    both = np.sqrt((3 * (d - 1) + 5 * d) / 8)
    assert noise_distance([line, MeasuredPose(pose), markers], STD) == pytest.approx(both * STD)


def test_markers_in_space_have_one_floor_everywhere(in_room, monkeypatch):
    """sqrt(3) of the std of one coordinate, which report.json keeps."""
    legends = []
    monkeypatch.setattr(Figure, "legend", lambda *_, handles, **__: legends.extend(handles))
    floor = np.sqrt(3) * in_room.measurement.std
    shown = [figures.errors_figure(in_room), figures.pose_errors_figure(in_room)]
    assert f"noise alone {millimetres(floor)}" in [item.get_label() for item in legends]
    for drawing in shown:
        (line,) = (item for item in drawing.axes[0].lines if item.get_color() == BLACK)
        assert line.get_xdata() == pytest.approx([1e3 * floor] * 2)
    row = f"noise alone ({in_room.measurement.std_source})"
    assert f"{row} {millimetres(floor)}" in said(in_room)
    assert f"{row}  {1e3 * floor:.3g} mm" in outcome_text(in_room)
    assert f"<td>{row}</td><td>{1e3 * floor:.3g} mm</td>" in outcome_html(in_room)
    page = report_page(in_room, BARE | dict(zip(("errors", "pose_errors"), shown, strict=True)))
    assert f"noise alone, {millimetres(floor)}" in page
    assert "noise floor" not in page
    assert report_dict(in_room)["measurement"]["std"] == in_room.measurement.std
