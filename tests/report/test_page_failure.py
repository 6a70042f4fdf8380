"""failed.html: written where a run fails, beside what is there, and removed by the next success."""

from dataclasses import replace

import numpy as np
import pytest
from test_writer import tree

from dlo_casadi.errors import DloError, EstimationError, MeasurementError, OutputError
from dlo_casadi.io.files import write_file
from dlo_casadi.report import writer
from dlo_casadi.report.page import GENERATOR, failure_page, hints
from dlo_casadi.report.writer import ResultsFolder
from dlo_casadi.session import run_session
from dlo_casadi.session.outcome import PoseInput


@pytest.fixture
def failed(photographed):
    """An error with what had been read: one photograph without a cable."""
    lost = replace(
        photographed.poses[0],
        points=np.zeros((0, 2)),
        to_pixels=None,
        problem="no cable found. Try: another background.",
    )
    error = EstimationError("no fit comes near\n  not once. Try: other units.")
    error.poses = (lost, *photographed.poses[1:])
    return error


def test_the_page_tells_the_message_what_to_try_and_every_pose(photographed, failed):
    page = failure_page(photographed.config, failed, failed.poses)

    assert '<p class="sentence">No fit comes near</p>' in page
    assert "<li>Other units.</li>\n<li>Another background.</li>" in page
    assert "<strong>Not read.</strong> no cable found." in page
    assert page.count("data:image/jpeg;base64,") == 5
    assert page.count('<polyline id="measured-') == 4
    assert "4 of 5 poses could be read" in page


def test_a_run_that_fails_before_the_poses_are_read_shows_the_photographs(photographed):
    page = failure_page(photographed.config, DloError("too early"))

    assert "The run failed before the poses were read." in page
    assert page.count("data:image/jpeg;base64,") == 5
    assert "Compare the configuration below" in page


def test_a_run_in_space_that_fails_before_the_poses_are_read_has_its_page(in_room):
    page = failure_page(in_room.config, DloError("too early"))

    assert "The run failed before the poses were read." in page
    assert page.count('<li class="pose"') == 3


def test_a_lost_pose_in_space_is_listed(in_room):
    lost = PoseInput.unread(in_room.config, in_room.poses[0], "no such file")
    page = failure_page(in_room.config, DloError("wrong"), (lost, *in_room.poses[1:]))

    assert "<strong>Not read.</strong> no such file" in page
    assert page.count('<li class="pose"') == 3


def test_a_pose_given_as_points_needs_no_photograph(photographed):
    config, poses = photographed.config, photographed.config.experiment.poses
    points = poses[0].changed(file=None, points=((0.0, 0.0), (0.1, 0.0)))
    experiment = config.experiment.changed(poses=(points, *poses[1:]))
    page = failure_page(config.changed(experiment=experiment), DloError("too early"))

    assert page.count("data:image/jpeg;base64,") == 4


def test_centre_lines_are_drawn_with_their_declared_fixtures(outcome):
    page = failure_page(outcome.config, DloError("wrong"), outcome.poses)

    assert page.count('<polyline id="measured-') == 12
    assert page.count('class="fixture start"') == 12 + 2  # and in the two keys
    assert "data:image" not in page


def test_hints_are_told_once():
    messages = ["a. Try: this.\n  b. Try: that.", "c. Try: this.", "nothing"]
    assert hints(messages) == ["This.", "That."]


def test_a_failed_session_carries_what_was_read(outcome):
    """Of a configuration whose files have gone."""
    first, *others = outcome.config.experiment.poses
    gone = [first] + [p.changed(role="held_out") for p in others]
    gone[0] = first.changed(file=first.file.with_name("gone.csv"), name="gone")
    experiment = outcome.config.experiment.changed(poses=tuple(gone))
    with pytest.raises(MeasurementError, match="no fit pose") as caught:
        run_session(outcome.config.changed(experiment=experiment))

    assert [pose.name for pose in caught.value.poses] == [pose.name for pose in gone]
    assert "cannot be read" in caught.value.poses[0].problem
    assert len(caught.value.poses[1].points) > 0


def fail(path, config, error):
    with pytest.raises(type(error)), ResultsFolder(path, config):
        raise error


def test_earlier_results_stay_and_the_user_is_told_of_the_page(outcome, tmp_path):
    target = tmp_path / "results"
    target.mkdir()
    (target / "report.json").write_text('{"schema": "dlo-report/1"}')
    (target / "report.html").write_text("earlier")
    before = tree(target)
    error = DloError("broken")
    fail(target, outcome.config, error)

    after = tree(target)
    assert GENERATOR.encode() in after.pop("failed.html")
    assert after == before
    assert error.__notes__ == [f"Pose by pose: {target / 'failed.html'}"]


def test_the_next_success_removes_the_page(outcome, quick, tmp_path):
    target = tmp_path / "results"
    fail(target, outcome.config, DloError("broken"))
    assert [path.name for path in target.iterdir()] == ["failed.html"]
    with ResultsFolder(target, outcome.config) as folder:
        folder.write(outcome)

    assert {path.name for path in target.iterdir()} == set(writer.OWNED)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("a bug")])
def test_an_interrupt_and_a_bug_write_nothing(outcome, tmp_path, error):
    fail(tmp_path / "results", outcome.config, error)

    assert list(tmp_path.iterdir()) == []


def test_without_a_configuration_there_is_no_page(tmp_path):
    fail(tmp_path / "results", None, DloError("broken"))

    assert list(tmp_path.iterdir()) == []


def test_a_page_that_cannot_be_written_does_not_hide_the_error(outcome, tmp_path, monkeypatch):
    def refuse(*_):
        raise OutputError("cannot be written: Permission denied")

    monkeypatch.setattr(writer, "write_file", refuse)
    error = DloError("broken")
    fail(tmp_path / "results", outcome.config, error)

    assert not hasattr(error, "__notes__")


def test_a_fault_of_the_page_is_noted_beside_the_error(outcome, tmp_path, monkeypatch):
    def broken(*_):
        raise ValueError("no such scale")

    monkeypatch.setattr(writer, "failure_page", broken)
    error = DloError("broken")
    fail(tmp_path / "results", outcome.config, error)

    assert error.__notes__ == ["Without failed.html, which cannot be made: no such scale"]


def test_a_page_of_that_name_from_elsewhere_is_not_replaced(outcome, tmp_path):
    (tmp_path / "failed.html").write_text("<p>mine")
    with (
        pytest.raises(DloError, match=r"holds failed.html from elsewhere"),
        ResultsFolder(tmp_path, outcome.config),
    ):
        pass
    assert (tmp_path / "failed.html").read_text() == "<p>mine"


def test_a_page_is_whole_or_not_there(outcome, tmp_path, monkeypatch):
    fail(tmp_path, outcome.config, DloError("first"))
    before = tree(tmp_path)

    def stop(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", stop)
    with pytest.raises(OutputError, match="No space"):
        write_file(tmp_path / "failed.html", failure_page(outcome.config, DloError("second")))
    fail(tmp_path, outcome.config, DloError("third"))
    assert tree(tmp_path) == before
