"""A table of shapes holds what single predictions give, in order, whatever interrupts it."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="tables need pyarrow: pip install 'dlo-casadi[table]'")

import pyarrow as pa
import pyarrow.parquet as pq

from dlo_casadi import predict
from dlo_casadi.cli import main
from dlo_casadi.effects import CableData, EndSpring
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.fleet import shape_table as shape_table_module
from dlo_casadi.fleet.shape_table import Grid, Plan, PoseList, shape_table
from dlo_casadi.io.files import only_run
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.report.documents import parameters_text
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.parallel import open_executor

CABLE = CableData(length=0.5, mass=0.1, diameter=0.01, bending_stiffness=0.02)
REST = np.zeros(10)
GRID = Grid((-0.4, 0.4, 5), (-0.3, 0.3, 5))


def plan_of(tmp_path, **options):
    model = CableModel(CABLE, n=10, n_rest=4, **options)
    return Plan(model, model.nominal, model.rest_basis @ np.ones(4), None, tmp_path / "a.parquet")


@pytest.fixture(scope="module")
def parameters(tiny, tmp_path_factory):
    """parameters.yaml of a fitted cable, with all nuisances."""
    folder = tmp_path_factory.mktemp("fitted")
    (folder / "parameters.yaml").write_text(parameters_text(tiny))
    return folder / "parameters.yaml"


@pytest.fixture
def small_chunks(monkeypatch):
    """Some four poses a chunk."""
    monkeypatch.setattr(shape_table_module, "CHUNK_BYTES", 1600)


def test_rows_are_predictions_in_the_order_of_the_grid(parameters, tmp_path, capsys):
    output = tmp_path / "shapes.parquet"
    grid = ["--grid", "-0.5", "0.5", "5", "-4e-1", "0.4", "3"]
    command = ["shape-table", str(parameters), *grid, "--output", str(output), "--quiet", "--json"]
    assert main(command) == 0
    told = json.loads(capsys.readouterr().out)
    table = pq.read_table(output)
    rows = table.to_pylist()
    ends = [(row["end_x"], row["end_y"]) for row in rows]
    places = [(x, y) for y in (-0.4, 0.0, 0.4) for x in np.linspace(-0.5, 0.5, 5)]
    assert np.array(ends) == pytest.approx(np.array(places), abs=1e-15)
    assert [row["status"] for row in rows].count("ok") == told["poses"]["ok"]
    assert table.schema.field("points").metadata[b"unit"] == b"m"
    assert table.schema.field("force_on_end_x").metadata[b"unit"] == b"N"
    assert json.loads(table.schema.metadata[b"identity"])["solver_hash"] == told["solver_hash"]
    for row, end in zip(rows, ends, strict=True):
        if np.hypot(*end) > 0.56:  # the cable is 0.55 m long
            assert row["status"] == "unreachable"
            assert row["points"] is row["energy"] is None
            continue
        shape = predict(parameters, end)
        nodes = np.reshape(row["points"], (-1, 2))
        # Points are in single precision: 6e-8 of half a metre.
        assert nodes == pytest.approx(shape.curve.nodes, abs=1e-7)
        assert row["energy"] == pytest.approx(shape.energy, rel=1e-8)
        force = [row["force_on_end_x"], row["force_on_end_y"]]
        assert force == pytest.approx(shape.end_force, rel=1e-6, abs=1e-8)


def test_the_command_writes_parquet_alone(tmp_path, capsys):
    grid = ["--grid", "0", "0.3", "2", "0", "0.3", "2"]
    assert main(["shape-table", "any.yaml", *grid, "--output", str(tmp_path / "t.csv")]) == 2
    assert "t.parquet" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_list_of_poses_of_a_clamped_cable(kind, tmp_path):
    columns = {
        "end_x_m": [0.3, 0.35, 9.0],
        "end_y_m": [0.1, -0.1, 0.0],
        "end_heading_rad": [0.4, -0.2, 0.0],
    }
    path = tmp_path / f"poses.{kind}"
    if kind == "csv":
        lines = [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
        path.write_text("\n".join([",".join(columns), *lines]) + "\n")
    else:
        pq.write_table(pa.table(columns), path)
    plan = plan_of(tmp_path, start="clamped", end="clamped")
    poses = PoseList(path, ("end_x_m", "end_y_m", "end_heading_rad"), {"start_heading": 0.2})
    assert shape_table(plan, poses, InProcess()) == {"ok": 2, "unreachable": 1}
    rows = pq.read_table(plan.output).to_pylist()
    for k, row in enumerate(rows[:2]):
        end = (columns["end_x_m"][k], columns["end_y_m"][k])
        pose = HeldPose(
            (0.0, 0.0), end, start_heading=0.2, end_heading=columns["end_heading_rad"][k]
        )
        found = solve_equilibrium(plan.model, plan.p, plan.rest, pose)
        assert row["energy"] == pytest.approx(found.energy, rel=1e-8)
        assert row["end_heading"] == columns["end_heading_rad"][k]
        moments = [row["moment_on_start"], row["moment_on_end"]]
        assert moments == pytest.approx(found.moments, rel=1e-5, abs=1e-8)
    assert rows[2]["status"] == "unreachable"


def test_interrupted_and_resumed_or_in_a_pool_the_bytes_are_the_same(tmp_path, small_chunks):
    plan = plan_of(tmp_path)
    whole = plan.output
    counts = shape_table(plan, GRID, InProcess())
    assert sum(counts.values()) == GRID.count
    assert not plan.parts.exists()

    def interrupt(tally):
        if tally.done == 3:
            raise KeyboardInterrupt

    again = tmp_path / "again.parquet"
    other = replace(plan, output=again)
    with pytest.raises(KeyboardInterrupt):
        shape_table(other, GRID, InProcess(), progress=interrupt)
    assert not again.exists()
    before = len(list(other.parts.glob("*.arrow")))
    assert before == 3
    tallies = []
    assert shape_table(other, GRID, InProcess(), progress=tallies.append) == counts
    assert len(tallies) == -(-GRID.count // plan.chunk) - before > 2
    assert again.read_bytes() == whole.read_bytes()

    pooled = tmp_path / "pooled.parquet"
    with open_executor(jobs=2) as executor:
        shape_table(replace(plan, output=pooled), GRID, executor)
    assert pq.read_table(pooled).equals(pq.read_table(whole))

    assert shape_table(plan, GRID, InProcess()) == {}, "complete already"


def test_what_belongs_to_something_else_is_refused(tmp_path, small_chunks):
    plan = plan_of(tmp_path)
    output = plan.output

    def interrupt(tally):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        shape_table(plan, GRID, InProcess(), progress=interrupt)
    other = Grid((-0.4, 0.4, 9), (-0.3, 0.2, 3))
    with pytest.raises(DloError, match="holds parts of another table"):
        shape_table(plan, other, InProcess())
    with only_run(plan.parts), pytest.raises(DloError, match="another run is writing"):
        shape_table(plan, other, InProcess(), restart=True)
    assert list(plan.parts.glob("*.arrow")), "the parts of a run in progress stay"
    shape_table(plan, other, InProcess(), restart=True)
    with pytest.raises(DloError, match="holds something else"):
        shape_table(plan, GRID, InProcess())
    output.write_text("my notes")
    with pytest.raises(DloError, match="holds something else"):
        shape_table(plan, other, InProcess())
    assert output.read_text() == "my notes"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("end_x_m\n0.1\n", "end_y_m missing"),
        ("end_x_m,end_y_m,speed\n0.1,0.2,3\n", "speed unknown"),
        ("end_x_m,end_y_m\n0.1,far\n", "far"),
        ("end_x_m,end_y_m\n", "ends.csv: no poses"),
    ],
)
def test_bad_lists(text, message, tmp_path):
    path = tmp_path / "ends.csv"
    path.write_text(text)
    with pytest.raises(DloError, match=message):
        assert PoseList(path).count == len(list(PoseList(path).chunks(10)))


def test_the_moment_of_a_pin_with_a_spring_is_a_column(tmp_path):
    plan = plan_of(tmp_path, effects=(EndSpring(),))
    plan.p[plan.model.names.index("end_spring.stiffness")] = 0.1
    assert shape_table(plan, Grid((0.3, 0.3, 1), (0.1, 0.1, 1)), InProcess()) == {"ok": 1}
    (row,) = pq.read_table(plan.output).to_pylist()
    pose = HeldPose((0.0, 0.0), (0.3, 0.1))
    found = solve_equilibrium(plan.model, plan.p, plan.rest, pose)
    assert abs(found.moments[1]) > 1e-3
    assert row["moment_on_end"] == pytest.approx(found.moments[1], rel=1e-6)
    assert "moment_on_start" not in row


def test_a_long_bad_list_is_no_bug(tmp_path):
    """It is read in blocks of a megabyte: the first one tells the columns, others the count."""
    path = tmp_path / "ends.csv"
    path.write_text("end_x_m,end_y_m\n" + 200_000 * "0.1,0.2\n" + "0.1,0.2,0.3\n")
    poses = PoseList(path)
    for read in (lambda: poses.count, lambda: list(poses.chunks(100_000))):
        with pytest.raises(DloError, match=r"(?s)ends.csv: .* Try: a CSV or Parquet file"):
            read()


def test_a_list_that_does_not_exist_is_told(tmp_path):
    with pytest.raises(DloError, match=r"ends.csv: no such file"):
        PoseList(tmp_path / "ends.csv")


def test_a_header_that_is_no_utf8_is_no_bug(tmp_path):
    path = tmp_path / "ends.csv"
    path.write_bytes("end_x_m,end_y_m,größe\n0.1,0.2,3\n".encode("latin-1"))
    with pytest.raises(DloError, match=r"(?s)ends.csv: .* Try: a CSV or Parquet file"):
        PoseList(path)


def test_a_model_is_pickled_without_its_expressions():
    model = CableModel(CABLE, n=10)
    before = solve_equilibrium(model, model.nominal, REST, HeldPose((0.0, 0.0), (0.3, 0.0)))
    copy = pickle.loads(pickle.dumps(model))
    assert copy == model
    after = solve_equilibrium(copy, copy.nominal, REST, HeldPose((0.0, 0.0), (0.3, 0.0)))
    assert np.array_equal(before.phi, after.phi)


def test_lists_and_grids_are_cut_without_a_gap(tmp_path):
    path = Path(tmp_path / "ends.csv")
    values = np.arange(50.0).reshape(25, 2)
    path.write_text("end_x_m,end_y_m\n" + "\n".join(f"{x},{y}" for x, y in values) + "\n\n")
    poses = PoseList(path, fixed={"start_x": 7.0})
    cut = list(poses.chunks(10))
    assert [len(chunk) for chunk in cut] == [10, 10, 5]
    assert poses.count == 25
    joined = np.concatenate(cut)
    assert np.array_equal(joined[:, 2:4], values)
    assert np.all(joined[:, 0] == 7.0)
    assert np.array_equal(np.concatenate(list(GRID.chunks(10))), next(GRID.chunks(10**6)))
