"""What mesh and steps lack, from two of each, at the order of the element and of the scheme."""

import numpy as np
import pytest

from limbfit.fe import ELEMENTS, ORDER_IN_TIME
from limbfit.fe.materials import compute_prony_factors
from limbfit.pipeline.identification.answer import (
    MESH_ORDERS,
    estimate_coarse_error,
    extrapolate_richardson,
)
from limbfit.pipeline.uncertainty.sources import FINER, mesh_share
from limbfit.study import load_study

COARSE = "[mesh.coarse]\nedge_near_mm = 5.0\n"
TEXT = """
[study]
name = "mesh"
[surfaces]
skin = "skin.stl"
[mesh]
element = "{element}"
edge_near_mm = 3.5
{coarse}
[[sites]]
name = "a"
fitted = true
trace = "a.csv"
position = [0.0, 0.0, 0.0]
"""
# Forces in N at the posterior site of docs/convergence.md, by edge in mm.
POSTERIOR = {
    "tet10": {4.5: 4.204, 3.5: 4.141, 2.7: 4.081, 2.0: 4.021, 1.75: 4.005},
    "tet4": {6.0: 12.061, 4.5: 9.509, 3.5: 8.402, 2.7: 7.191, 2.0: 5.993, 1.3: 5.144},
}
LIMIT = 3.98


def study_with(tmp_path, element, coarse):
    for name in ("a.csv", "skin.stl"):
        (tmp_path / name).touch()
    (tmp_path / "study.toml").write_text(TEXT.format(element=element, coarse=coarse))
    return load_study(tmp_path)


@pytest.mark.parametrize("coarse", ["", COARSE], ids=["a finer mesh", "coarse and fine"])
@pytest.mark.parametrize("element", MESH_ORDERS)
def test_what_a_mesh_lacks_follows_from_the_order_of_its_element(tmp_path, element, coarse):
    words, share = mesh_share(study_with(tmp_path, element, coarse))
    order = MESH_ORDERS[element]
    if order is None:
        assert share == 1.0
        assert words.endswith("the difference itself")
        return
    edges = (5.0, 3.5) if coarse else (3.5, FINER * 3.5)
    rough, fine = (10.0 + 0.1 * edge**order for edge in edges)
    lacking = (fine if coarse else rough) - 10.0
    assert abs(share * (rough - fine)) == pytest.approx(lacking)
    assert words.endswith(f"at order {order:g}")


@pytest.mark.parametrize("element", POSTERIOR)
def test_the_orders_are_those_that_were_measured_on_a_limb(element):
    edges, forces = np.array(list(POSTERIOR[element].items())).T
    order = MESH_ORDERS[element]
    slope = np.polyfit(np.log(edges), np.log(forces - LIMIT), 1)[0]
    if element == "tet4":
        assert order == pytest.approx(slope, abs=0.1)
        return
    # Its own limit is 1 to 2 % above the middle of the two elements': the order is that of the differences.
    straight = np.polynomial.Polynomial.fit(edges**order, forces, 1)
    assert np.abs(straight(edges**order) - forces).max() < 0.003 * LIMIT


def test_every_element_of_studies_has_an_order_or_is_known_to_have_none():
    assert set(MESH_ORDERS) <= set(ELEMENTS)


def test_nothing_is_extrapolated_where_forces_do_not_change_in_one_direction():
    found = extrapolate_richardson([4.0, 2.8, 2.0], [10.4, 10.2, 10.1], None)
    assert found.order is None
    assert not found.measured
    assert found.error_percent(10.4) == pytest.approx(100 * (10.4 / 10.1 - 1))


def relaxing(steps):
    """Overstress of one Prony term at the end of an elastic stress that rises as the cube of time."""
    times = np.linspace(0.0, 4.0, steps + 1)
    decay, ramp, back, *_ = compute_prony_factors(4.0 / steps, 0.32, 4.0 / steps)
    found, before = 0.0, 0.0
    for change in np.diff(times**3):
        found, before = decay * found + ramp * change + back * before, change
    return found


def test_steps_in_time_are_extrapolated_at_the_order_of_the_scheme():
    limit = relaxing(4096)
    errors = np.array([relaxing(n) - limit for n in (16, 32, 64)])
    orders = np.log2(np.abs(errors[:-1] / errors[1:]))
    assert orders[-1] > ORDER_IN_TIME - 0.2
    told = estimate_coarse_error(ORDER_IN_TIME, 2) * (relaxing(64) - relaxing(32))
    assert told == pytest.approx(-errors[1], rel=0.1)
