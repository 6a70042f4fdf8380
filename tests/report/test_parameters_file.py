"""parameters.yaml rebuilds the model exactly, and says what is wrong with a damaged file."""

import math
import os
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_sessions import BENCH, CONFIGS, small

from dlo_casadi.api import predict
from dlo_casadi.cable.file import load
from dlo_casadi.cable.saved import parameters_hash
from dlo_casadi.config import dump_yaml, load_config, read_yaml
from dlo_casadi.effects import BendingSoftening, ImageDistortion, RestCurvatureDrift
from dlo_casadi.errors import ConfigError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.report.documents import fit_dict, parameters_text
from dlo_casadi.session.fitting import declared_model, minimum_by_ipopt
from dlo_casadi.session.measure import measured_poses, read_inputs


@pytest.fixture(scope="module")
def file(outcome, tmp_path_factory):
    path = tmp_path_factory.mktemp("results") / "parameters.yaml"
    path.write_text(parameters_text(outcome))
    return path


def fitted(name, *effects, n=10):
    """A quick fit of a bench session with more effects than declared."""
    config = load_config(BENCH / name / "session.yaml")
    measured = measured_poses(config, read_inputs(config))[:8]
    declared = declared_model(config)
    model = declared.model.with_mesh(n)
    for effect in effects:
        model = model.with_effect(effect)
    return fit_model(model, measured, declared.tolerances, 3e-4), measured


def test_a_cable_in_space_is_rebuilt_exactly(outcome, tmp_path):
    config = load_config(CONFIGS / "markers_in_space.yaml")
    measured = measured_poses(config, read_inputs(config))
    declared = declared_model(config)
    model = declared.model.with_mesh(8)
    fit = fit_model(model, measured[:3], declared.tolerances, 3e-4)
    path = as_file(fit, replace(outcome, config=config), tmp_path / "parameters.yaml")
    document = read_yaml(path)
    assert list(document["rest_curvature"]["coefficients"]) == ["k_y", "k_z"]
    assert document["cable"]["torsional_stiffness"] == pytest.approx(0.0197 / 1.3)
    assert {"torsional_stiffness", "end_roll"} < set(document["parameters"])
    assert document["fixtures"] == {
        "start": [0.4, -0.2, 0.3],
        "start_orientation": [-0.480585, -0.087156, -0.095296, 0.867387],
        "end_orientation": None,
    }

    cable = load(path)
    assert cable.model == fit.model
    assert np.array_equal(cable.p, fit.p)
    assert np.array_equal(cable.rest, fit.rest)
    assert np.array_equal(cable.metadata.coefficients, fit.coefficients)
    assert not cable.metadata.edited
    for change, message in (
        (lambda d: d["cable"].pop("torsional_stiffness"), "has no torsional stiffness: in space"),
        (lambda d: d["rest_curvature"]["coefficients"].pop("k_z"), "k_z is missing"),
        (lambda d: d["rest_curvature"]["coefficients"]["k_z"].pop(), "26 numbers belong here"),
    ):
        damaged = read_yaml(path)
        change(damaged)
        (tmp_path / "damaged.yaml").write_text(dump_yaml(damaged))
        with pytest.raises(ConfigError, match=message):
            load(tmp_path / "damaged.yaml")


def as_file(fit, outcome, path):
    path.write_text(parameters_text(replace(outcome, fit=fit)))
    return path


def test_prediction_from_the_file_equals_prediction_from_the_fit(outcome, file):
    cable = load(file)
    fit = outcome.fit
    poses = [item.pose for item in fit.problem.measured]

    ours = predict_poses(cable.model, cable.p, cable.rest, poses)
    theirs = predict_poses(fit.model, fit.p, fit.rest, poses)
    gap = max(
        np.abs(a.curve.nodes - b.curve.nodes).max() for a, b in zip(ours, theirs, strict=True)
    )
    assert gap < 1e-10


def test_the_model_is_rebuilt_exactly(outcome, file):
    cable = load(file)
    model, p, rest, metadata = cable.model, cable.p, cable.rest, cable.metadata

    assert model == outcome.fit.model
    assert np.array_equal(p, outcome.fit.p)
    assert np.array_equal(rest, outcome.fit.rest)
    assert np.array_equal(metadata.coefficients, outcome.fit.coefficients)
    assert not metadata.edited
    assert metadata.params["bending_stiffness"].identifiable is True
    assert metadata.config == "session"
    assert metadata.fixtures["start"] == [0.0, 0.0]


def test_equal_results_give_equal_bytes(outcome):
    assert parameters_text(outcome) == parameters_text(pickle.loads(pickle.dumps(outcome)))


def test_a_covariance_of_many_estimates_is_read(file, tmp_path):
    """300 kB beyond the largest configuration."""
    path = tmp_path / "parameters.yaml"
    path.write_text(file.read_text() + "# " + 800_000 * "x" + "\n")
    assert load(path).name == load(file).name


def test_a_folder_of_results_will_do(file):
    assert load(file.parent).metadata.path == file


def test_covariance_is_in_si_units(outcome, file):
    metadata, fit = load(file).metadata, outcome.fit

    assert metadata.covariance.names == fit.problem.unknowns.names
    for name in fit.model.names:
        assert metadata.covariance.std[name] == pytest.approx(fit.std(name), rel=1e-12)
        assert np.sqrt(metadata.covariance[name, name]) == pytest.approx(fit.std(name), rel=1e-12)
    curvature = outcome.stage("batch").rest_curvature
    # B-splines are positive and sum to one: a curve's std is of the size of its coefficients'.
    assert metadata.covariance.std["rest_curvature[3]"] < 20 * curvature.std.max()
    _, covariance = fit.named_covariance
    assert np.array_equal(covariance, covariance.T)


def test_the_fitted_stiffness_agrees_with_the_bench_truth(file):
    truth = read_yaml(BENCH.parent / "bench_truth" / "short_clean" / "truth.yaml")
    low, high = load(file).params["bending_stiffness"].interval_95
    stiffness = truth["bending_stiffness"]

    assert low < stiffness < high


def test_effects_keep_what_they_were_made_with(outcome, tmp_path):
    """A clamped start, a free end, a straight cable, a camera with a centre of its own."""
    fit, measured = fitted("overhang", ImageDistortion(center=(0.2, -0.05)))
    path = as_file(fit, outcome, tmp_path / "parameters.yaml")

    cable = load(path)
    model, p, rest, metadata = cable.model, cable.p, cable.rest, cable.metadata
    assert model == fit.model
    assert model.effects[-1].center == (0.2, -0.05)
    assert not metadata.edited

    pose = measured[0].pose
    (ours,) = predict_poses(model, p, rest, [pose])
    (theirs,) = predict_poses(fit.model, fit.p, fit.rest, [pose])
    assert np.abs(ours.curve.nodes - theirs.curve.nodes).max() < 1e-10
    shape = predict(path, start_heading=pose.start_heading)
    assert np.abs(shape.seen.nodes - ours.curve.nodes).max() < 1e-10


def test_the_next_pose_finds_the_cable_as_the_last_one_left_it(outcome, tmp_path):
    fit, measured = fitted("drift", RestCurvatureDrift())
    rest = load(as_file(fit, outcome, tmp_path / "parameters.yaml")).rest

    # The second route: pose by pose, kappa_0 += rate (kappa - kappa_0), from the fitted shapes.
    rate, expected = fit.value("rest_curvature_drift.rate"), fit.rest
    shapes = fit.point.shapes
    for j, item in enumerate(measured):
        given = Inputs.of(fit.p, expected, item.pose.vector[None])
        kappa = Assembly(fit.model, shapes.subset([j]), given).strain()[0]
        expected = expected + rate * (kappa - expected)
    assert rate > 0.005
    assert np.abs(expected - fit.rest).max() > 0.01
    assert rest == pytest.approx(expected, abs=1e-9)
    assert np.array_equal(rest, fit.rest_now)


def test_the_hash_depends_on_the_model_alone(outcome):
    document = fit_dict(outcome.fit)
    before = parameters_hash(document)

    document["parameters"]["bending_stiffness"]["std"] = 99.0
    document["n"] = 20.0
    assert parameters_hash(document) == before
    document["parameters"]["bending_stiffness"]["value"] *= 1 + 1e-12
    assert parameters_hash(document) != before


def test_a_file_changed_by_hand_is_noticed(file, tmp_path):
    document = read_yaml(file)
    document["parameters"]["bending_stiffness"]["value"] *= 2
    edited = tmp_path / "parameters.yaml"
    edited.write_text(dump_yaml(document))

    assert load(edited).metadata.edited


def test_an_unread_key_may_hold_what_only_yaml_can(file, tmp_path):
    noted = tmp_path / "parameters.yaml"
    text = file.read_text()
    assert "rest_shape: " in text
    noted.write_text(text.replace("rest_shape: ", "bought: !!timestamp 2024-01-31, rest_shape: "))

    assert load(noted).metadata.edited


def test_coefficients_changed_by_hand_are_used_without_the_state(file, tmp_path):
    def double(document):
        rows = document["rest_curvature"]["coefficients"]
        document["rest_curvature"]["coefficients"] = [2 * value for value in rows]
        del document["state"]

    cable = load(damaged(file, tmp_path, double))
    assert cable.metadata.edited
    assert cable.rest == pytest.approx(2 * load(file).rest, rel=1e-9)


def damaged(file, tmp_path, change):
    document = read_yaml(file)
    change(document)
    path = tmp_path / "parameters.yaml"
    path.write_text(dump_yaml(document))
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(schema="other/1"), "schema 'dlo-parameters/1' expected, 'other/1'"),
        (lambda d: d.pop("cable"), "'cable' is missing"),
        (
            lambda d: d["cable"].update(length=-1.0),
            "cable.length: must be larger than 0, found -1.0",
        ),
        (lambda d: d["cable"].update(length="long"), "cable.length: a number belongs here, found"),
        (
            lambda d: d.update(element="beam"),
            "element: allowed are 'quadratic', 'arc' or 'link', found 'beam'",
        ),
        (
            lambda d: d["boundary"].update(end="glued"),
            "boundary.end: allowed are 'pinned', 'clamped'",
        ),
        (lambda d: d["effects"].append({"name": "magic", "label": "x"}), "called 'magic'"),
        (lambda d: d["effects"].pop(), "do not belong together: image_scale.factor"),
        (lambda d: d["state"]["rest_curvature"].pop(), "20 numbers belong here, found 19"),
        (
            lambda d: d["rest_curvature"]["coefficients"].__setitem__(0, 3.0),
            "state.rest_curvature, which is used, and rest_curvature.coefficients differ by",
        ),
        (
            lambda d: d["parameters"]["bending_stiffness"].update(fitted=False),
            "parameters.bending_stiffness.value, which is used,",
        ),
        (
            lambda d: d["parameters"]["end_offset.dx"].update(interval_95=[0.02, 0.01]),
            "parameters.end_offset.dx: interval_95 is [low, high], found [0.02, 0.01]",
        ),
        (
            lambda d: d["parameters"]["end_offset.dx"].update(std=-1),
            "parameters.end_offset.dx.std: must not be smaller than 0, found -1",
        ),
        (
            lambda d: d["scatter"].update(rest_curvature_std=-5.0),
            "scatter.rest_curvature_std: must not be smaller than 0, found -5",
        ),
        (
            lambda d: d["scatter"]["from_pose_to_pose"].update(source="clamp_rotation"),
            "scatter.from_pose_to_pose.source: this cable has rest_curvature, pin_moment",
        ),
        (
            lambda d: d["scatter"]["fixtures"].update(end_q=1e-3),
            "scatter.fixtures: nothing is called 'end_q'",
        ),
        (lambda d: d["parameters"]["end_offset.dx"].update(value=None), "found nothing"),
        (
            lambda d: d["parameters"]["bending_stiffness"].update(value="soft"),
            "parameters.bending_stiffness.value: a number belongs here, found 'soft'",
        ),
        (
            lambda d: d["parameters"]["bending_stiffness"].update(value=-0.3),
            "parameters.bending_stiffness.value: -0.3 N m^2 lies outside of its bounds "
            "[1e-12, 1000000000]",
        ),
        (
            lambda d: d["parameters"]["end_offset.dx"].update(value=0.02, upper=0.01),
            "parameters.end_offset.dx.value: 0.02 m lies outside of its bounds",
        ),
        (lambda d: d.update(config=None), "config: text belongs here, found nothing"),
        (
            lambda d: d["covariance"]["values"][0].__setitem__(1, 1.0),
            "values of bending_stiffness and",
        ),
        (
            lambda d: d["covariance"]["values"][0].__setitem__(0, -1.0),
            "the variance of bending_stiffness is -1",
        ),
        (
            lambda d: d["covariance"]["names"].__setitem__(1, "bending_stiffness"),
            "a name stands here twice",
        ),
        (
            lambda d: d["covariance"]["names"].__setitem__(1, "stiffness"),
            "covariance.names: nothing is called 'stiffness'",
        ),
        (
            lambda d: d["fixtures"].update(start=[0.0, 0.0, 0.0]),
            "fixtures.start: 2 numbers belong here, found 3",
        ),
        (lambda d: d["fixtures"].update(start="here"), "fixtures.start: "),
        (
            lambda d: d["fixtures"].update(start_heading="up"),
            "fixtures.start_heading: a number belongs here, found 'up'",
        ),
        (
            lambda d: d["cable"].update(length=550.0),
            "cable.length: 550 m: units are SI, did you mean 0.55?",
        ),
    ],
)
def test_a_damaged_file_is_named_with_its_key(file, tmp_path, change, message):
    path = damaged(file, tmp_path, change)

    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(n=math.inf), "n: a whole number belongs here, found inf"),
        (
            lambda d: d.update(n=10**9),
            "n: must not be larger than 2000, found 1000000000; 2 to 2000",
        ),
        (lambda d: d.update(n=20.5), "n: a whole number belongs here, found 20.5"),
        (
            lambda d: d.update(n_rest=100_000),
            "n_rest: must not be larger than 64, found 100000; 0 to 64",
        ),
        (
            lambda d: d["cable"].update(bending_stiffness=1e-300),
            "cable.bending_stiffness: 1e-300 N m^2: 1e-12 to 1e+09 N m^2 is possible",
        ),
        (
            lambda d: d["cable"].update(length=1e-300),
            "cable.length: 1e-300 m: units are SI, 0.001 to 100 m is possible",
        ),
        (
            lambda d: d.update(gravity=[0, 1e30]),
            "gravity: 1e+30 m/s^2: 0 to 10000 m/s^2 is possible",
        ),
        (
            lambda d: d["effects"][0].update(center=[0, 0]),
            "center: length_error knows label",
        ),
        (
            lambda d: d["effects"][0].update(label=[1]),
            "effects[0].label: something like '' belongs",
        ),
        (
            lambda d: d["effects"][0].update(label=10**400),
            "effects[0].label: something like '' belongs",
        ),
        (
            lambda d: d["effects"].append({"name": "clip_offset", "clip": 0.5}),
            "effects[3].clip: something like 0 belongs here, found 0.5",
        ),
    ],
)
def test_a_value_that_cannot_be_computed_with_is_named_with_its_line(
    file, tmp_path, change, message
):
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        load(damaged(file, tmp_path, change))
    assert "Try: the file as a fit has written it." in str(caught.value)
    key = re.findall(r"\w+", message.split()[0])[-1]
    listed = re.findall(rf"line (\d+): {re.escape(message)}", str(caught.value))  # one of several
    lines = caught.value.file.read_text().splitlines()
    assert f"{key}:" in lines[(caught.value.line or int(listed[0])) - 1]


@pytest.mark.parametrize("bound", ["lower", "upper"])
def test_values_at_their_bounds_are_read_as_they_were_written(outcome, tmp_path, bound):
    """What a fit may return at a bound: the bound, and the bound as scale or logarithm round it."""
    fit = outcome.fit
    limits = {q.name: getattr(q, bound) for q in fit.model.parameters}
    rounded = {
        q.name: np.exp(np.log(limits[q.name]))
        if q.log
        else q.nominal + q.scale * ((limits[q.name] - q.nominal) / q.scale)
        for q in fit.model.parameters
    }
    for values in (limits, rounded):
        document = fit_dict(fit)
        for name, value in values.items():
            document["parameters"][name]["value"] = float(value)
        document["model_hash"] = parameters_hash(document)
        path = tmp_path / "parameters.yaml"
        path.write_text(dump_yaml(document))

        cable = load(path)
        model, p, metadata = cable.model, cable.p, cable.metadata
        assert dict(zip(model.names, p, strict=True)) == values  # every digit
        assert not metadata.edited


@pytest.mark.long
def test_a_fit_that_ends_at_a_bound_can_be_read(outcome, tmp_path):
    """IPOPT widens bounds by 1e-8 of them; here the softness would be -5e-10 m."""
    fit, _ = fitted("short_clean", BendingSoftening())
    point = minimum_by_ipopt(fit).point
    assert point is not None
    fit = Fit(fit.problem, point, converged=True)
    assert fit.value("bending_softening.softness") == 0.0
    assert np.array_equal(load(as_file(fit, outcome, tmp_path / "p.yaml")).p, fit.p)


def test_a_missing_file_is_a_clear_error(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        load(tmp_path / "parameters.yaml")


def test_a_folder_that_must_not_be_read_is_beside_a_wrong_path(tmp_path, monkeypatch):
    (tmp_path / "locked").mkdir()
    stat = os.stat

    def refused(path, **options):
        if "locked/" in str(path):
            raise PermissionError(path)
        return stat(path, **options)

    monkeypatch.setattr(os, "stat", refused)
    for path, said in (("nothing", "no such file or folder"), ("locked", "no parameters.yaml")):
        with pytest.raises(ConfigError, match=said):
            load(tmp_path / path)


def test_a_configuration_is_no_parameter_file():
    with pytest.raises(ConfigError, match=r"Try: dlo fit .*session\.yaml.* a configuration"):
        load(Path(small("short_clean").path))
