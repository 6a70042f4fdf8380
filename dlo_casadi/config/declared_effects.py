"""Effects that a configuration names: whether they exist, and can act as they are declared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from dlo_casadi.config.limits import Range
from dlo_casadi.config.problems import Place, Problem, did_you_mean
from dlo_casadi.effects import EFFECTS, Cable, Setup
from dlo_casadi.effects.cable import Parameter

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
    setup, effects, excluded = (
        declared_setup(config),
        config.model.effects,
        config.diagnosis.exclude,
    )
    problems = [
        problem
        for i, item in enumerate(effects)
        for problem in _wrong(item, ("model", "effects", i), setup)
    ]
    return problems + [
        Problem(("diagnosis", "exclude", i), f"diagnosis.exclude: {_unknown(name)}")
        for i, name in enumerate(excluded)
        if name not in EFFECTS
    ]


def _wrong(item: DeclaredEffect, at: Place, setup: Setup) -> Iterator[Problem]:
    """Find what is wrong with one declared effect."""
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
    wrong = {name: text for name in values if (text := _wrong_value(known, name, values[name]))}
    for name, text in wrong.items():
        yield Problem((*at, "parameters", name), f"model.effects: {item.name}{text}")
    if not wrong and (refusal := effect.refusal(setup, nominal | values)):
        yield Problem((*at, "name"), f"model.effects: {item.name}: {refusal}")


def _wrong_value(known: Mapping[str, Parameter], name: str, value: float) -> str:
    """What is wrong with a value that is declared for a parameter; empty if nothing is."""
    if name not in known:
        return f" has no parameter {name!r}{did_you_mean(name, known)}"
    complaint = Range(*known[name].range, known[name].unit).complaint(value)
    return complaint and f".{name}: {complaint}"


def _unknown(name: str) -> str:
    return f"no effect is called {name!r}{did_you_mean(name, EFFECTS)}"
