"""Small sessions, each run once, that all tests of the report look at."""

from contextlib import redirect_stdout
from io import StringIO

import pytest
from small_sessions import BARE, in_space, photographs, small

from dlo_casadi.cli import main
from dlo_casadi.report import writer


@pytest.fixture(scope="session")
def outcome(run_once):
    return run_once("outcome", small("short_clean"))


@pytest.fixture(scope="session")
def photographed(run_once):
    poses = ("pose_01", "pose_03", "pose_04", "pose_05", "pose_09")
    return run_once("photographed", photographs(poses))


@pytest.fixture(scope="session")
def in_room(run_once):
    return run_once("in_room", in_space(("pose_01", "pose_02", "pose_04")))


@pytest.fixture(scope="session")
def written(outcome, tmp_path_factory):
    """Folder of the small session's results, and what `dlo fit --json` printed."""
    folder = tmp_path_factory.mktemp("written") / "rope"
    command = ["fit", str(outcome.config.path), "--json", "--quiet", "--output", str(folder)]
    printed = StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.setattr("dlo_casadi.session.run_session", lambda *_: outcome)
        assert main([*command, "--jobs", "1"]) == 0
    return folder, printed.getvalue()


@pytest.fixture(scope="session")
def page(written):
    """Its report.html."""
    folder, _ = written
    return (folder / "report.html").read_text()


@pytest.fixture
def quick(monkeypatch):
    """Figures take seconds and have their own tests: empty ones stand in."""
    monkeypatch.setattr(writer, "figures_of", lambda outcome: BARE)
    monkeypatch.setattr(writer, "write_figures", lambda folder, outcome: None)
    monkeypatch.setattr(
        writer, "draw_poses", lambda folder, outcome: (folder / "poses.png").touch()
    )
