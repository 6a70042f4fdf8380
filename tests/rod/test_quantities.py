"""Each kind of reading has its keys, fields and rows wherever these are named after it."""

from dataclasses import fields

import pytest

from dlo_casadi.config.frozen import keys_of
from dlo_casadi.config.options import Measurement
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.ends import REACTIONS, reaction_rows
from dlo_casadi.rod.node import Frame, Heading
from dlo_casadi.rod.quantities import FORCE, MOMENT, QUANTITIES, quantity_of
from dlo_casadi.sensing.noise import NoiseModel, ReadingNoise
from dlo_casadi.session.outcome import MeasurementSummary, ReadingErrors


def test_a_reading_is_of_what_its_name_ends_with():
    found = [quantity_of(name) for name in (*REACTIONS, "clip_1_force")]
    assert found == [FORCE, MOMENT, FORCE, MOMENT, FORCE]


@pytest.mark.parametrize("quantity", QUANTITIES, ids=lambda x: x.name)
def test_its_keys_and_fields_are_there(quantity):
    assert quantity.std_key in keys_of(Measurement)
    assert getattr(Tolerances(), quantity.bias_key) > 0
    assert quantity.std_key in {field.name for field in fields(MeasurementSummary)}
    assert ReadingErrors(**{quantity.name: 0.5}).of(quantity) == 0.5
    noise = ReadingNoise(1.0, 1.0).with_std({quantity: 0.2})
    assert [noise.of(x) == 0.2 for x in QUANTITIES] == [x is quantity for x in QUANTITIES]
    assert not noise.known(quantity)
    assert NoiseModel(0.1, readings=noise).units([quantity.name]) == pytest.approx(0.5)


@pytest.mark.parametrize(("node", "sizes"), [(Heading, [2, 1]), (Frame, [3, 3])])
def test_its_components_are_those_of_the_model(node, sizes):
    rows = reaction_rows(node, clips=1)
    for name, at in rows.items():
        assert at.stop - at.start == sizes[QUANTITIES.index(quantity_of(name))]
    axes = "xyz"[: sizes[0]]
    known = {2: ["[fx, fy]", "one number"], 3: ["[fx, fy, fz]", "[mx, my, mz]"]}
    assert [quantity.written(axes) for quantity in QUANTITIES] == known[len(axes)]
    last = rows["clip_1_force"]
    assert last.stop == 2 * sum(sizes) + sizes[0]
