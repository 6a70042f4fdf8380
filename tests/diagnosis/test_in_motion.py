"""Which of several effects a motion is said to show."""

from types import SimpleNamespace

import pytest

from dlo_casadi.diagnosis import in_motion


@pytest.mark.parametrize(
    ("excess", "square", "named", "rivals"),
    [
        ({"air": 3.1, "liquid": 2.6}, {"air": 122.0, "liquid": 130.0}, "air", ("liquid",)),
        ({"air": 2.6, "liquid": 2.6}, {"air": 1.0, "liquid": 130.0}, "liquid", ("air",)),
        ({"air": 0.1, "liquid": 9.9}, {"air": 122.0, "liquid": 130.0}, "air", ()),
        ({"air": 2.6, "liquid": 2.6}, {"air": 1.0, "liquid": 1.0}, None, ()),
    ],
)
def test_effects_are_compared_at_one_excess_and_named_if_significant(
    monkeypatch, excess, square, named, rivals
):
    """One gains 123, the other 122: one's own excess, or what is vanishing, does not rank them."""
    gains = {"air": 123.0, "liquid": 122.0}
    items = {x: SimpleNamespace(name=x, frees=(x,), add_to=lambda model: model) for x in gains}
    start = SimpleNamespace(fit=SimpleNamespace(model=None), objective=3000.0, rmse=1.0)
    fits = {x: SimpleNamespace(objective=3000.0 - gain, rmse=0.5) for x, gain in gains.items()}
    monkeypatch.setattr(in_motion, "rejoined", lambda _, model, values: fits[values["of"]])
    monkeypatch.setattr(in_motion, "_excess", lambda _, item: excess[item.name])
    monkeypatch.setattr(in_motion, "_square", lambda _, item: square[item.name])
    scores = {x: in_motion.Score(items[x], 2 * gain, {"of": x}) for x, gain in gains.items()}
    best = in_motion._best(start, start, scores, 1e-4, 10)
    if named is None:
        assert best is None
        return
    fit, added = best
    assert fit is fits[named]
    assert (added.candidate.name, added.rivals) == (named, rivals)
