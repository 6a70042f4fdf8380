"""The effects by their names; what enters is checked, so that a mistake names its class."""

import inspect
from collections.abc import Iterator

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import ContactEffect, Effect, Load, PointForceAt, SpringAt
from dlo_casadi.errors import DloError, counted


class Registry(dict[str, type[Effect]]):
    """Classes of effects by their names: `EFFECTS[MyEffect.name] = MyEffect`.

    Raises
    ------
    DloError
        If a class is no effect, has another name, lacks parameters or the law of its kind, or if
        one of its methods raises an error. `update` and `setdefault` do not check.
    """

    def __setitem__(self, name: str, kind: type[Effect]) -> None:
        if wrong := next(_mistakes(name, kind), ""):
            called = kind.__name__ if isinstance(kind, type) else repr(kind)
            raise DloError(f"{called} cannot be an effect: {wrong}.")
        super().__setitem__(name, kind)


def _mistakes(name: str, kind: type[Effect]) -> Iterator[str]:
    """What is wrong with a class that is to be the effect of a name; the first is the cause."""
    if not (isinstance(kind, type) and issubclass(kind, Effect) and hasattr(kind, "kind")):
        yield (
            "it is no class that derives from a kind of effect.\n"
            "  Try: class MyEffect(PointLoad), or another kind of dlo_casadi.effects"
        )
        return
    if getattr(kind, "name", None) != name:
        yield (
            f"its name is {getattr(kind, 'name', None)!r}, not {name!r}.\n"
            f"  Try: name = {name!r} in the class, EFFECTS[{kind.__name__}.name] = {kind.__name__}"
        )
    if kind.parameters is Effect.parameters and not kind.declared:
        yield "it declares no parameters.\n  Try: parameters(self, cable), or declared = (...,)"
        return
    base = next(parent for parent in kind.__mro__ if "kind" in vars(parent))
    laws = [law for law, own in vars(base).items() if inspect.isfunction(own)]
    # A contact needs no law: its parameter moves the obstacle.
    if base is not ContactEffect and all(getattr(kind, x) is getattr(base, x) for x in laws):
        yield f"it has no law and would do nothing.\n  Try: a method {' or '.join(laws)}"
        return
    try:
        yield from _wrong_values(kind)
    except Exception as error:
        yield (
            f"one of its methods fails, {type(error).__name__}: {error}.\n"
            "  Try: parameters(self, cable) that declares each name which the laws use"
        )


def _wrong_values(kind: type[Effect]) -> Iterator[str]:
    """Methods that return something else than a tuple of what belongs there, for some cable."""
    d = min(kind.dimensions)
    cable = CableData(1.0, 1.0, 0.01, 1.0, torsional_stiffness=None if d == 2 else 1.0)
    setup = Setup(cable, gravity=(*(0.0,) * (d - 1), -9.81))
    if not kind.applies(setup):
        return
    effect = kind.made_for(setup)
    parameters = effect.parameters(cable)
    yield from _not_a_tuple("parameters", parameters, Parameter)
    if isinstance(effect, Load):
        names = (*(q.name for q in parameters), *effect.per_pose(cable))
        symbols = {name: ca.SX.sym(name) for name in names}
        found = effect.forces(ca.SX(ca.DM(setup.gravity)), symbols)
        yield from _not_a_tuple("forces", found, PointForceAt)
        springs = effect.springs(symbols)
        yield from _not_a_tuple("springs", springs, SpringAt)
        if len(springs) != effect.n_springs:
            yield (
                f"its springs returns {counted(len(springs), 'spring')}, and n_springs is "
                f"{effect.n_springs}.\n  Try: n_springs = {len(springs)} in the class"
            )


def _not_a_tuple(method: str, found: object, item: type) -> Iterator[str]:
    if not isinstance(found, tuple) or not all(isinstance(one, item) for one in found):
        yield (
            f"its {method} must return a tuple of {item.__name__}, found {type(found).__name__}.\n"
            f"  Try: return ({item.__name__}(...),), with the comma"
        )
