"""Effects that a configuration names: whether they exist, and can act as they are declared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from dlo_casadi.config.limits import Range
from dlo_casadi.config.problems import Problem, did_you_mean
from dlo_casadi.effects import EFFECTS, Cable, Setup
from dlo_casadi.effects.parameter import Parameter

if TYPE_CHECKING:
    from dlo_casadi.config.options import DeclaredEffect
    from dlo_casadi.config.sections import Config, File


def declared_setup(config: Config | File) -> Setup:
    """How the cable is held and measured, as far as a configuration tells."""
    cable, experiment = config.cable, config.experiment
    measurement = experiment.measurement
    return Setup(
        cable=Cable(
            length=cable.length,
            mass=cable.prior_mass,
            diameter=cable.diameter,
            bending_stiffness=cable.prior_bending_stiffness,
            name=cable.name,
            straight=cable.rest_shape == "straight",
            torsional_stiffness=cable.prior_torsional_stiffness if experiment.in_space else None,
        ),
        start=experiment.boundary.start,
        end=experiment.boundary.end,
        gravity=experiment.gravity,
        curved=cable.rest_shape != "straight",
        n_poses=sum(pose.role == "fit" for pose in experiment.poses),
        camera=measurement.kind == "images" and None not in (measurement.board, measurement.camera),
        readings=tuple({name for pose in experiment.poses for name in pose.readings}),
        tolerances=experiment.tolerances.model_dump(),
    )


def wrong_effects(config: Config | File) -> list[Problem]:
    """Find effects, and parameters of theirs, that do not exist or cannot be as declared."""
    setup = declared_setup(config)
    problems = [
        problem for i, item in enumerate(config.model.effects) for problem in _wrong(item, i, setup)
    ]
    for i, name in enumerate(config.diagnosis.exclude):
        if name not in EFFECTS:
            text = f"diagnosis.exclude: {_unknown(name)}"
            problems.append(Problem(("diagnosis", "exclude", i), text))
    return problems


def _wrong(item: DeclaredEffect, i: int, setup: Setup) -> Iterator[Problem]:
    """Find what is wrong with one declared effect."""
    at = ("model", "effects", i)
    if item.name not in EFFECTS:
        yield Problem((*at, "name"), f"model.effects: {_unknown(item.name)}")
        return
    effect = EFFECTS[item.name].made_for(setup)
    known = {q.name: q for q in effect.parameters(setup.cable)}
    nominal = {name: q.nominal for name, q in known.items()}
    if refusal := effect.refusal(setup, nominal):
        yield Problem((*at, "name"), f"model.effects: {item.name}: {refusal}")
        return
    values = {name: declared.value for name, declared in item.parameters.items()}
    wrong = [
        problem
        for name, value in values.items()
        for problem in _wrong_value(item.name, known, name, value)
    ]
    for place, message in wrong:
        yield Problem((*at, *place), f"model.effects: {message}")
    if not wrong and (refusal := effect.refusal(setup, nominal | values)):
        yield Problem((*at, "name"), f"model.effects: {item.name}: {refusal}")


def _wrong_value(
    effect: str, known: Mapping[str, Parameter], name: str, value: float
) -> list[Problem]:
    """Find what is wrong with a value that is declared for a parameter of an effect."""
    place = ("parameters", name)
    if name not in known:
        text = f"{effect} has no parameter {name!r}{did_you_mean(name, known)}"
        return [Problem(place, text)]
    possible = Range(*known[name].range, known[name].unit)
    problems = possible.problems(place, value)
    return [Problem(at, f"{effect}.{name}: {message}") for at, message in problems]


def _unknown(name: str) -> str:
    return f"no effect is called {name!r}{did_you_mean(name, EFFECTS)}"
