"""Numbers of a cable that are arguments of functions for users: parameters, mass, length, rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import EFFECTS
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import REST_CURVATURE


@dataclass(frozen=True, eq=False)
class CableNumbers:
    """A model, its parameters p and rest strains (MX), and the argument on which they depend.

    `model` has an effect more for a mass or a length that varies. `argument` is None if nothing
    varies.
    """

    model: CableModel
    p: Any
    rest: Any
    argument: Any | None


def numbers_of(
    model: CableModel, p: FloatArray, rest: FloatArray, asked: bool | str | Sequence[str]
) -> CableNumbers:
    """The numbers of a cable with an argument for those asked for, see `CasadiCable.function`.

    Raises
    ------
    DloError
        If there is no parameter of a name.
    """
    if not isinstance(asked, bool | str | list | tuple):
        text = "True, False or names of parameters belong here, found"
        raise DloError(f"parameters: {text} {asked!r}")
    listed = [asked] if isinstance(asked, str) else asked
    corrections: dict[str, Any] = {x.corrects: x() for x in EFFECTS.values() if x.corrects}
    basis = rest_basis(model)
    curved = [f"{REST_CURVATURE}[{k}]" for k in range(basis.shape[1])]
    names = [*model.names] if listed is True else [*(listed or ())]
    names = [own for x in names for own in (curved if x == REST_CURVATURE else [x])]
    for name in names:
        if name not in (*model.names, *corrections, *curved):
            known = ", ".join((*model.names, *corrections, REST_CURVATURE))
            raise DloError(f"no parameter {name!r}; there are {known}")
    if not names:
        return CableNumbers(model, ca.MX(ca.DM(p)), ca.MX(ca.DM(rest)), None)
    argument = ca.MX.sym("parameters", len(names))
    own: dict[str, Any] = dict(zip(names, ca.vertsplit(argument), strict=True))
    larger, values = model, dict(zip(model.names, p.tolist(), strict=True))
    for name, effect in corrections.items():
        if name not in own:
            continue
        if effect.label not in [one.label for one in larger.effects]:
            larger = larger.with_effect(effect)
        (parameter,) = effect.parameters(model.cable)
        own[f"{effect.label}.{parameter.name}"] = effect.correction(own.pop(name), model.cable)
    values |= {q.name: q.nominal for q in larger.parameters if q.name not in values}
    fitted = np.linalg.lstsq(basis, rest, rcond=None)[0]
    strains = ca.MX(ca.DM(rest))
    for k, name in enumerate(curved):
        if name in own:
            strains += ca.DM(basis[:, k]) * (own.pop(name) - fitted[k])
    changed = ca.vertcat(*({**values, **own}[name] for name in larger.names))
    return CableNumbers(larger, ca.MX(changed), strains, argument)


def rest_basis(model: CableModel) -> FloatArray:
    """Rest strains per coefficient; of a cable that is straight at rest, a constant curvature."""
    if model.n_coefficients:
        return model.rest_basis
    return replace(model, cable=replace(model.cable, straight=False), n_rest=1).rest_basis
