"""The effects by their names; what enters is checked, so that a mistake names its class."""

import inspect
import re
from collections.abc import Iterator

from dlo_casadi.effects.effect import ContactEffect, Effect
from dlo_casadi.effects.trial import Mistake, try_out
from dlo_casadi.errors import DloError

_PACKAGE = "dlo_casadi."


class Registry(dict[str, type[Effect]]):
    """Classes of effects by their names: `EFFECTS[MyEffect.name] = MyEffect`.

    Raises
    ------
    DloError
        If a class is no effect, has another name or that of an effect of the package, lacks
        parameters or the law of its kind, or if one of its methods, called once as a model calls
        it, raises an error, takes other arguments, or returns something of another shape, a symbol
        of its own, or a number that is not finite. `update` and `setdefault` do not check.
    """

    def __setitem__(self, name: str, kind: type[Effect]) -> None:
        if wrong := self._taken(name, kind) or next(_mistakes(name, kind), ""):
            called = kind.__name__ if isinstance(kind, type) else repr(kind)
            raise DloError(f"{called} cannot be an effect: {wrong}.")
        super().__setitem__(name, kind)

    def _taken(self, name: str, kind: type[Effect]) -> str:
        """Why a name cannot be used; empty if it can. A class may replace its own earlier form."""
        if not (isinstance(name, str) and name.isidentifier()):
            return f"its name is {name!r}.\n  Try: letters, digits and underscores"
        own = [known for known, one in self.items() if one.__module__.startswith(_PACKAGE)]
        base = re.sub(r"_\d+$", "", name)  # lumped_mass_2 is a second lumped mass
        if base in own and self[base] is not kind:
            return f"{base} is an effect of the package.\n  Try: another name"
        return ""


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
        try_out(kind)
    except Mistake as mistake:
        yield str(mistake).rstrip(".")
