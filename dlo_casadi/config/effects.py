"""Declared effects: which of them, and which of their values, are possible in a session."""

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import asdict

from dlo_casadi.config.options import DeclaredEffect, EffectParameter
from dlo_casadi.config.problems import ConfigProblem, Place, did_you_mean
from dlo_casadi.config.sections import Config
from dlo_casadi.config.values import Range
from dlo_casadi.effects import EFFECTS, CableData, Effect, Setup
from dlo_casadi.effects.cable import Parameter, height_of
from dlo_casadi.effects.end_spring import PinSpring
from dlo_casadi.errors import counted
from dlo_casadi.rod.chain import ELEMENTS_IN_SPACE


def declared_setup(config: Config) -> Setup:
    """How the cable is held and measured, as far as a configuration says."""
    cable, experiment = config.cable, config.experiment
    measurement = experiment.measurement
    d = len(experiment.gravity)
    starts = [pose.start for pose in experiment.poses if len(pose.start) == d] or [(0.0,) * d]
    return Setup(
        cable=CableData(
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
        # Only the photographs tell where their middle is.
        center=(0.0, 0.0) if measurement.kind == "images" else None,
        camera=measurement.kind == "images" and None not in (measurement.board, measurement.camera),
        readings=tuple({name for pose in experiment.poses for name in pose.readings}),
        tolerances=asdict(experiment.tolerances),
        clips=experiment.clips,
        obstacles=len(experiment.obstacles),
        level=float(height_of(starts[0], experiment.gravity)),
    )


def declared_effects(config: Config, setup: Setup) -> list[tuple[DeclaredEffect, Effect]]:
    """Each declaration and its effect; those of one name are numbered in their order."""
    items = config.model.effects
    counts = Counter(item.name for item in items)
    effects = {name: iter(EFFECTS[name].several(setup, n)) for name, n in counts.items()}
    return [(item, next(effects[item.name])) for item in items]


def wrong_effects(config: Config, *, known: bool = False) -> list[ConfigProblem]:
    """Find elements, effects and their parameters that do not exist or are impossible here.

    `known`: nothing is estimated, so that all values are kept.
    """
    setup, element = declared_setup(config), config.model.element
    found: list[ConfigProblem] = []
    if config.experiment.in_space and element not in ELEMENTS_IN_SPACE:
        others = " or ".join(ELEMENTS_IN_SPACE)
        text = f"model.element: {element} is of a cable in a plane. Try: {others}"
        found.append(ConfigProblem(("model", "element"), text))
    for i, item in enumerate(config.model.effects):
        found += _wrong(item, ("model", "effects", i), setup, known)
    found += _too_many(config, setup, known)
    for i, name in enumerate(config.diagnosis.exclude):
        if name not in EFFECTS:
            text = f"diagnosis.exclude: {_unknown(name)}"
            found.append(ConfigProblem(("diagnosis", "exclude", i), text))
    return found


def without_values(config: Config) -> Iterator[ConfigProblem]:
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


def has_pin_spring(config: Config) -> bool:
    """Whether a spring at a pinned end is declared."""
    names = (item.name for item in config.model.effects)
    return any(issubclass(EFFECTS.get(name, Effect), PinSpring) for name in names)


def wrong_limits(config: Config) -> list[ConfigProblem]:
    """Find limits that are meaningless for this cable."""
    given, ends = config.experiment, config.experiment.boundary
    held = {ends.start, ends.end, *(clip.kind for x in given.poses for clip in x.clips)}
    sprung = has_pin_spring(config)
    avoided = any(one.touch == "avoided" for one in given.obstacles)
    length, limits = config.cable.length, config.limits
    found = limits.problems(sorted(held), sprung, given.in_space, length, avoided)
    return [ConfigProblem(("limits", *place), text) for place, text in found]


def _wrong(item: DeclaredEffect, at: Place, setup: Setup, kept: bool) -> Iterator[ConfigProblem]:
    if item.name not in EFFECTS:
        yield ConfigProblem((*at, "name"), f"model.effects: {_unknown(item.name)}")
        return
    effect, said = EFFECTS[item.name].made_for(setup), f"model.effects: {item.name}"
    declarable = {q.name: q for q in effect.parameters(setup.cable)}
    values = {name: q.nominal for name, q in declarable.items()}
    if refusal := effect.refusal(setup, values):
        yield ConfigProblem((*at, "name"), f"{said}: {refusal}")
        return
    for name, declared in item.parameters.items():
        key = (*at, "parameters", name)
        if name not in declarable:
            hint = did_you_mean(name, declarable)
            yield ConfigProblem(key, f"{said} has no parameter {name!r}{hint}")
        elif wrong := _out_of_range(declarable[name], declared, kept):
            yield ConfigProblem(key, f"{said}.{name}: {wrong}")
        else:
            values[name] = declared.value
    as_declared = all(values.get(name) == item.parameters[name].value for name in item.parameters)
    if as_declared and (refusal := effect.refusal(setup, values)):
        yield ConfigProblem((*at, "name"), f"{said}: {refusal}")


def _too_many(config: Config, setup: Setup, kept: bool) -> Iterator[ConfigProblem]:
    """Find effects declared more often than a cable may have them, or twice alike for a fit."""
    before = defaultdict[str, list[dict[str, float]]](list)
    for i, item in enumerate(config.model.effects):
        if item.name not in EFFECTS or EFFECTS[item.name].impossible(setup):
            continue
        kind, same = EFFECTS[item.name], before[item.name]
        first, *others = kind.several(setup, len(same) + 1)
        values = {q.name: q.nominal for q in first.parameters(setup.cable)}
        values |= {name: declared.value for name, declared in item.parameters.items()}
        text = ""
        if len(same) > len(others):
            text = f"{counted(len(same) + 1, 'such effect')} declared, and this cable can have "
            text += f"{1 + len(others)}. Try: without this one"
        elif not kept and kind.repeatable and values in same:
            text = "declared twice with the same values, from which a fit cannot tell them apart. "
            text += "Try: another position"
        if text:
            at = ("model", "effects", i, "name")
            yield ConfigProblem(at, f"model.effects: {item.name}: {text}")
        same.append(values)


def _out_of_range(q: Parameter, declared: EffectParameter, kept: bool) -> str:
    """Why a parameter cannot have a value, and what to try; empty if it can."""
    value, unit = declared.value, q.unit
    if wrong := Range(*q.known_range, unit).complaint(value):
        return wrong
    searched = Range(*q.range, unit)
    if kept or declared.fixed or value in searched:
        return ""
    shown, most = (f"{x:g} {unit}".rstrip() for x in (value, searched.most))
    text = f"{shown}: a fit searches {searched.least:g} to {most} only"
    return f"{text}. Try: {{value: {value:g}, fixed: true}}, which keeps it"


def _unknown(name: str) -> str:
    return f"no effect is called {name!r}{did_you_mean(name, EFFECTS)}"
