"""The reproduction of the paper: Table 4, the small replica, what the equations miss, the page."""

import json
from dataclasses import replace

import numpy as np
import pytest
from paper import chords, energies, equations, monte_carlo, page, published, replica, scale, tables
from paper.content import Claim, Part, Section, Target, drawing
from paper.fits import estimate

from dlo_casadi.estimation import start
from dlo_casadi.estimation.constrained import profile_interval, stiffness_profile, threshold


@pytest.fixture(scope="module")
def revealing():
    """The replica whose stiffness shows, on a coarser fine mesh."""
    stiffness = replica.REVEALING
    return replica.make("revealing", stiffness, 3 * stiffness, published.rest_angles(), mesh=40)


@pytest.fixture(scope="module")
def fitted(revealing):
    return equations.first_fit(revealing)


# ---- Table 4, which needs no raw data ----------------------------------------------------------


def test_table_4_within_its_print():
    rows = energies.rows_of_table_4(roundings=2)
    printed = published.table(4)
    assert len(rows) == len(printed) == 12
    for row, line in zip(rows, printed, strict=True):
        assert abs(row.before - line["V_theta0_alpha0_J"]) <= energies.ENERGY_TOLERANCE, row.pose
        assert row.stable


def test_bound_on_the_first_heading_contradicts_the_print():
    """A bound at -pi/2 on theta_1 costs the last pose energy that the print does not show."""
    last = published.poses()[-1]
    printed = published.table(4)[-1]["V_theta0_alpha0_J"]
    assert energies.with_bounded_heading(last) > printed + 4.0


# ---- the replica -------------------------------------------------------------------------------


def test_held_out_poses_of_the_replica(revealing):
    """Batch arcs predict them at least ten times better than the paper's loop, at n = 10."""
    found = [estimate((revealing, method, (10,), True))[0] for method in ("loop", "arc")]
    loop, arc = (tables.held_out_rmse(found, "revealing", m, 10) for m in ("loop", "arc"))
    assert loop >= tables.GAIN * arc
    assert arc <= tables.HELD_OUT_LIMIT
    low, high = found[1].interval
    # The interval is at n = 10; twice its half-width covers the true value all but surely.
    center, half = np.log(low * high) / 2, np.log(high / low) / 2
    assert abs(np.log(revealing.stiffness) - center) < 2 * half


def test_profile_meets_the_threshold_at_the_ends_of_the_interval(fitted):
    interval = profile_interval(fitted)
    ends = np.array([interval.high, fitted.p[0], interval.low])
    rises = stiffness_profile(fitted, ends)
    # The ends are found by two secant steps.
    assert rises[[0, 2]] == pytest.approx(threshold(fitted), rel=0.05)
    # Without the prior of the stiffness, the minimum is as low as the profile gets.
    assert abs(rises[1]) < 1e-2


def test_search_on_a_few_poses_leads_to_the_same_minimum(revealing, fitted, monkeypatch):
    monkeypatch.setattr(start, "POSES_OF_A_SEARCH", 5)
    again = equations.first_fit(revealing)
    # Both have converged to within a hundredth of a standard deviation.
    assert again.p[0] == pytest.approx(fitted.p[0], abs=0.02 * fitted.std("bending_stiffness"))


# ---- what the equations miss -------------------------------------------------------------------


def test_reaction_closes_the_balance_and_eq_15_wants_a_negative_stiffness():
    found = [equations.balance(stiffness) for stiffness in (published.STIFFNESS, 0.3)]
    for exact in found:
        moments = exact.elastic + exact.gravity
        # IPOPT leaves 1e-11 relative to moments of up to 200 N m.
        assert np.abs(moments + exact.reaction).max() < 1e-7
        assert np.abs(moments).max() > np.abs(exact.gravity).max() / 2
        assert exact.inverse_stiffness < 0
    first, second = (exact.inverse_stiffness for exact in found)
    assert first == pytest.approx(second, rel=0.1), "it does not depend on the stiffness"


def test_printed_rest_angles_are_the_mean_bend_of_the_poses():
    printed = published.rest_angles()
    bends = equations.balance(published.STIFFNESS).bends.mean(axis=0)
    # Both lie within the print's last digit, 0.005 rad.
    assert np.abs(bends - printed).max() < 0.005


def test_few_elements_are_as_good_as_81_links():
    stiffness = replica.REVEALING
    truth = [
        curve.at(replica.PLACES)
        for curve in replica.true_shapes(stiffness, published.rest_angles(), mesh=40)
    ]
    wanted = chords.largest_error(stiffness, "link", chords.LINKS_HELD_AGAINST, truth)
    for element, n in chords.MOST_ELEMENTS.items():
        assert chords.largest_error(stiffness, element, n, truth) <= wanted, element


# ---- benchmarks --------------------------------------------------------------------------------


@pytest.mark.long
def test_one_set_of_the_monte_carlo():
    """The same numbers wherever it runs; its errors are of the size of the bound."""
    rng = [monte_carlo.generator_of(0, 3) for _ in range(2)]
    first, second = (monte_carlo.draw(generator) for generator in rng)
    assert np.array_equal(first.coefficients, second.coefficients)
    row = monte_carlo.run_one(3, 0)
    # Four standard deviations; for 41 correlated places, three in the mean square.
    assert abs(row["log_error"]) < 4 * row["log_bound"]
    assert np.mean((np.array(row["rest_error"]) / row["rest_bound"]) ** 2) < 9


def test_growth_of_costs():
    rows = [
        {
            "poses": m,
            "n": n,
            "cpu_seconds": 0.1 * m * n,
            "seconds": 0.0,
            "gigabytes": 0.2 + 1e-4 * m**2 * n,
            "gigabytes_before": 0.2,
        }
        for m in scale.POSES
        for n in scale.ELEMENTS
    ]
    growth = scale.growths(rows)
    assert growth["time_poses"] == pytest.approx(1)
    assert growth["time_n"] == pytest.approx(1)
    assert growth["memory_poses"] == pytest.approx(2)


# ---- the page ----------------------------------------------------------------------------------


def test_page_is_escaped_and_needs_no_network(tmp_path):
    section = Section("one", "<script>alert(1)</script>", ["a < b"])
    with drawing(section, "line", 'caption "quoted"', (2.0, 1.0)) as figure:
        figure.subplots().plot([0, 1], [0, 1])
    part = Part(
        "table4",
        [section],
        [Claim("Eq. 1", "<b>says</b>", "found", "holds")],
        [Target("name", "at most 1", "0", True)],
    )
    result = page.write(tmp_path, [part], ("table4", "replica"))
    text = (tmp_path / "index.html").read_text()
    assert "<script" not in text
    assert "&lt;b&gt;says&lt;/b&gt;" in text
    assert text.count("data:image/svg+xml;base64,") == 1
    assert "http" not in text.replace("http-equiv", "")
    assert (tmp_path / "figures" / "line.svg").exists()
    assert json.loads((tmp_path / "paper.json").read_text()) == result

    again = page.write(tmp_path, [replace(part, name="replica")], ("table4", "replica"))
    assert list(again["parts"]) == ["table4", "replica"], "earlier parts are kept"
