"""Small sessions, each run once, that all tests of the report look at."""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # before numpy: the matrices are small

import pickle  # noqa: E402
from contextlib import redirect_stdout  # noqa: E402
from io import StringIO  # noqa: E402

import pytest  # noqa: E402
from filelock import FileLock  # noqa: E402
from small_sessions import BARE, in_space, photographs, small  # noqa: E402

from dlo_casadi.cli import main  # noqa: E402
from dlo_casadi.report import writer  # noqa: E402
from dlo_casadi.session import run_session  # noqa: E402


@pytest.fixture(scope="session")
def run_once(tmp_path_factory):
    """Function that runs a session once for all processes of the tests, and names its outcome."""
    parallel = "PYTEST_XDIST_WORKER" in os.environ
    own = tmp_path_factory.getbasetemp()
    folder = own.parent if parallel else own

    def run(name, config):
        path = folder / f"{name}.pickle"
        with FileLock(path.with_suffix(".lock")):
            if not path.exists():
                path.write_bytes(pickle.dumps(run_session(config)))
            return pickle.loads(path.read_bytes())

    return run


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
