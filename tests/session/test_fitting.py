"""The mesh that is asked for, and points far off their neighbours."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.config import dump_yaml, load_config
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import explains
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Point
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.session import run_session
from dlo_casadi.session.fitting import (
    Minimum,
    confirmed,
    declared_model,
    fit_declared,
)
from dlo_casadi.session.measure import measured_poses, read_session
from dlo_casadi.session.outliers import outliers_of

BENCH = Path(__file__).resolve().parents[1] / "data" / "bench"
NOISE = 3e-4


def test_a_declared_mesh_is_kept_and_its_error_told():
    config = load_config(BENCH / "short_clean" / "session.yaml")
    coarse = config.model.changed(n=6)
    estimation = config.estimation.changed(algorithm1=False)
    diagnosis = config.diagnosis.changed(enabled=False)
    config = config.changed(model=coarse, estimation=estimation, diagnosis=diagnosis)
    outcome = run_session(config)
    assert outcome.fit.model.n == 6
    (warning,) = [text for text in outcome.warnings if "mesh" in text]
    assert f"{1e3 * outcome.mesh_error:.3g} mm" in warning
    assert "the mesh of 6 elements" in warning


def test_a_fit_that_ipopt_confirms_has_converged_and_one_where_it_fails_has_not():
    """A minimum lower by more than 1e-4 counts; one higher by a millionth is the same."""
    problem = SimpleNamespace(n_residuals=1, used=[0], equilibria=SimpleNamespace(m=1))
    problem.unknowns = SimpleNamespace(model=None)
    fit = Fit(problem, Point(None, SimpleNamespace(x=None), [], 10.0, 1.0, []))

    def found(objective):
        return Minimum(replace(fit.point, objective=objective))

    assert confirmed(fit, found(10.0 + 1e-6)).converged
    assert confirmed(fit, found(10.0 + 1e-6)).point is fit.point
    assert not confirmed(fit, found(10.1)).converged
    better = found(9.9)
    assert confirmed(fit, better).point is better.point
    assert confirmed(fit, better).converged
    assert not confirmed(replace(fit, converged=True), Minimum()).converged
    assert confirmed(fit, Minimum(searched=False)) is fit


EI, PER_LINE, SHARE, MESH = 0.026, 80, 0.03, 12
CABLE = {"length": 0.8, "mass": 0.05, "diameter": 0.008, "bending_stiffness": 0.02}
ENDS = ((0.5, 0.1), (0.6, -0.1), (0.4, 0.2), (0.45, -0.15), (0.55, 0.2))


def with_outliers(folder, count, std, *, robust):
    """Lines of `count` points between pins, 3 % of them 6 to 20 mm off; pose and number of each.

    The last pose is held out.
    """
    model = CableModel(CableData(*CABLE.values()), MESH)
    values = model.nominal * EI / CABLE["bending_stiffness"]
    held = [HeldPose((0.0, 0.0), end) for end in ENDS]
    shapes = predict_poses(model, values, np.zeros(model.chain.n_rests), held)
    rng, poses, names = np.random.default_rng(0), [], []
    s = np.linspace(0.02, 0.98, count) * model.cable.length
    for k, (end, shape) in enumerate(zip(ENDS, shapes, strict=True)):
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(count, 2))
        if k < len(ENDS) - 1:
            odd = np.sort(rng.choice(count, round(SHARE * count), replace=False))
            sign = rng.choice([-1, 1], len(odd))[:, None]
            tangent = shape.curve.tangents(s[odd])
            normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
            points[odd] += sign * normal * rng.uniform(6e-3, 20e-3, len(odd))[:, None]
            names += [f"pose{k} point {1 + i} at" for i in odd]
        role = "held_out" if k == len(ENDS) - 1 else "fit"
        pose = {"name": f"pose{k}", "start": [0.0, 0.0], "end": list(end), "role": role}
        poses.append(pose | {"points": points.tolist()})
    measurement = {"kind": "centerlines"} | ({} if std is None else {"std": std})
    document = {
        "cable": {"name": "rope", "rest_shape": "straight", **CABLE},
        "experiment": {
            "gravity": [0.0, -9.81],
            "boundary": {"start": "pinned", "end": "pinned"},
            "measurement": measurement,
            "poses": poses,
        },
        "model": {"n": MESH},
        "estimation": {"algorithm1": False, "robust": robust},
        "diagnosis": {"enabled": False},
    }
    path = folder / "session.yaml"
    path.write_text(dump_yaml(document))
    return load_config(path), names


@pytest.mark.parametrize(
    ("count", "std"),
    [
        (PER_LINE, None),
        pytest.param(PER_LINE, NOISE, marks=pytest.mark.long),
        (500, NOISE),
    ],
)
def test_robust_leaves_out_outliers_and_names_them(tmp_path, count, std):
    """Of 500 points a line the fit compares means, and those with an outlier are left out."""
    config, names = with_outliers(tmp_path, count, std, robust=True)
    outcome = run_session(config)
    found = outcome.stages[-1].parameters["bending_stiffness"]
    low, high = found.interval_95
    assert low < EI < high
    assert high - low < 0.1 * EI
    assert outcome.fit.noise.std == pytest.approx(NOISE, rel=0.3)
    # Some 250 degrees of freedom or more: three times sqrt(2 / 250).
    assert outcome.fit.chi2_per_dof == pytest.approx(1, abs=0.27)
    (said,) = [text for text in outcome.warnings if "estimation.robust leaves out" in text]
    assert not any("measurement.std" in text for text in outcome.warnings)
    if count == PER_LINE:
        assert f"leaves out {len(names)} points" in said
        assert all(name in said for name in names[:12])
        assert [len(item.points) for item in outcome.poses] == [78, 78, 78, 78, 80]


def test_the_warning_of_a_contradicted_noise_names_outliers(tmp_path):
    config, names = with_outliers(tmp_path, PER_LINE, NOISE, robust=False)
    (said,) = [text for text in run_session(config).warnings if "measurement.std" in text]
    assert f"There are {len(names)} points" in said
    assert all(name in said for name in names)
    assert said.endswith("Try: estimation: {robust: true}")


def test_the_residual_of_a_missing_effect_has_no_outliers():
    """A hidden pull moves lines of 15 points by many times their noise."""
    config = load_config(BENCH / "unknown_pull" / "session.yaml").changed(model={"n": 12})
    few = config.experiment.changed(poses=config.experiment.poses[::2])
    config, inputs = read_session(config.changed(experiment=few))
    declared = declared_model(config)
    poses = tuple(replace(item, points=item.points[::16], means=None) for item in inputs)
    fit = fit_declared(config, declared, measured_poses(config, poses))
    found = outliers_of(fit, poses)
    assert not explains(fit)
    assert found.lines == len(fit.problem.fitted)
    assert found.names == ()


def test_lines_of_few_points_have_no_outliers_and_robust_says_so(tmp_path):
    config, _ = with_outliers(tmp_path, 13, NOISE, robust=True)
    outcome = run_session(config)
    (said,) = [text for text in outcome.warnings if "estimation.robust" in text]
    assert "no line has the 14 points" in said


def test_two_declared_masses_are_told_apart(tmp_path):
    """True masses and places within four standard deviations; the page shows both."""
    given = {"length": 0.8, "mass": 0.05, "diameter": 0.005, "bending_stiffness": 0.01}
    held = {"gravity": (0, -9.81), "boundary": ("pinned", "pinned")}

    def loaded(*values):
        each = ({"mass": mass, "position": position} for mass, position in values)
        effects = [{"name": "lumped_mass", "parameters": one} for one in each]
        return {"n": 20, "effects": effects}

    true = dlo.known_cable(dlo.Cable(**given), **held, model=loaded((0.01, 0.3), (0.02, 0.5)))
    rng, poses = np.random.default_rng(0), []
    for end in ((0.5, 0.1), (0.3, -0.2), (0.6, -0.1)):
        shape = true.solve(end=end)
        points = shape.points + rng.normal(scale=2e-4, size=shape.points.shape)
        poses.append(dlo.Pose((0, 0), end, points=points, end_force=shape.end_force))
    cable = dlo.Cable(**{**given, "rest_shape": "straight"})
    options = {"estimation": {"algorithm1": False}, "diagnosis": {"enabled": False}}
    model = loaded((0.005, 0.25), (0.005, 0.55))
    result = dlo.Session(cable, poses, std=2e-4, **held, model=model, **options).fit()
    for name in true.model.names:
        found = result.params[name]
        assert abs(found.value - true.params[name].value) < 4 * found.std, name
    result.write(tmp_path / "results")
    page = (tmp_path / "results" / "report.html").read_text().replace("<wbr>", "")
    assert all(name in page for name in ("lumped_mass.mass", "lumped_mass_2.mass"))
    assert dlo.load(tmp_path / "results").model == result.fit.model
