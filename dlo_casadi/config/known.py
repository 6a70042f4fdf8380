"""A cable whose data are all known: the parts of a configuration other than its poses."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config.effects import declared_effects, declared_setup, wrong_effects, wrong_limits
from dlo_casadi.config.problems import Arguments, ConfigProblem, did_you_mean, show
from dlo_casadi.config.sections import Config
from dlo_casadi.config.supports import undetermined
from dlo_casadi.config.values import REST_COEFFICIENTS, plain
from dlo_casadi.rod.chain import RestCurvature


def known_config(given: dict[str, Any], names: tuple[str, ...]) -> tuple[Config, FloatArray]:
    """Make a configuration without poses, and rest coefficients [1/m], for `known_cable`.

    Raises ConfigError if an argument is missing or impossible; the message lists every problem with
    its argument.
    """
    given = plain(given)
    rest = given.pop("rest_curvature", None)
    held = {key: given.pop(key) for key in ("gravity", "boundary") if key in given}
    nothing = {"measurement": {"kind": "centerlines"}, "poses": ()}
    source = Arguments(given | {"experiment": nothing | held}, names)
    if strange := sorted(given.keys() & Config.model_fields.keys() - {*names}):
        hint = did_you_mean(strange[0], names)
        raise source.error([ConfigProblem((), f"unknown key {strange[0]!r} in {source.top}{hint}")])
    config = source.checked(Config)
    ends, cable, in_space = config.experiment.boundary, config.cable, config.experiment.in_space
    needed = (
        ("mass", "the mass of its length [kg]; without gravity any"),
        ("torsional_stiffness", "GJ [N m^2]; EI / 1.3 of a solid round rod"),
    )[: 1 + in_space]
    problems = [
        *undetermined(ends.start, ends.end, in_space),
        *(
            ConfigProblem((), f"cable.{key} is not given, and no fit tells it. Try: {meant}")
            for key, meant in needed
            if getattr(cable, key) is None
        ),
        *(wrong_effects(config, known=True) or _without_values(config)),
        *wrong_limits(config),
    ]
    values = np.zeros((1 + in_space, 0)) if rest is None else _curvatures(rest, 1 + in_space)
    text = ""
    if values is None:
        form = "(2,) or (2, K) numbers" if in_space else "one number or (K,)"
        text = f"{form} [1/m], K <= {REST_COEFFICIENTS.most}, belong here, found {show(rest)}"
    elif values.size and cable.rest_shape == "straight":
        text = "the cable is declared straight. Try: one of rest_curvature and rest_shape"
    elif (sharpest := np.linalg.norm(values, axis=0).max(initial=0.0)) * cable.diameter >= 2.0:
        text = f"{sharpest:g} 1/m bends it more sharply than it is thick: units are SI"
    problems += [ConfigProblem((), f"rest_curvature: {text}")] if text else []
    if problems or values is None:
        raise source.error(problems)
    count = values.shape[1]
    at = RestCurvature(cable.length, count).basis(np.linspace(0.0, cable.length, count))
    config = config.changed(estimation={"rest_curvature_coefficients": count})
    return config, np.linalg.solve(at, values.T).T.ravel()


def _without_values(config: Config) -> Iterator[ConfigProblem]:
    """Find effects whose declaration leaves values undetermined."""
    setup = declared_setup(config)
    for item, effect in declared_effects(config, setup):
        needed = [q for q in effect.parameters(setup.cable) if q.name not in item.parameters]
        if effect.kind == "state":
            text = "changes the rest shape from pose to pose. Try: rest_curvature as it is now"
            yield ConfigProblem((), f"model.effects: {item.name} {text}")
        elif needed:
            listed = ", ".join(f"{q.name} [{q.unit or '1'}]" for q in needed)
            text = f"{item.name} needs {listed}: no fit tells it. Try: parameters={{name: value}}"
            yield ConfigProblem((), f"model.effects: {text}")


def _curvatures(given: Any, axes: int) -> FloatArray | None:
    """A rest curvature as rows (axes, K) [1/m]; None if it is not one."""
    try:
        values = np.atleast_1d(np.array(given))
    except ValueError:  # rows of different lengths
        return None
    if values.dtype.kind not in "iuf":  # a text, or true
        return None
    values = values.astype(float)
    if values.ndim > axes or (axes == 2 and len(values) != 2) or not np.isfinite(values).all():
        return None
    rows = values.reshape(axes, -1)
    return rows if 0 < rows.shape[1] <= REST_COEFFICIENTS.most else None
