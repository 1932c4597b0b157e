"""Records judged before a simulation: against Hayes' layer, against one another, and against the skin."""

from dataclasses import replace

import numpy as np
import pytest

from limbfit.identify.checks.plausibility import (
    UNITS,
    RecordFacts,
    RecordWarning,
    check_plausibility,
    compute_layer_factor,
    explain_warnings,
)

RADIUS = 20 / np.sqrt(np.pi)
THICKNESS = (24.0, 8.0, 40.0, 20.0, 35.0, 12.0)


def study(seed: int = 0, scatter: float = 0.2, thickness=THICKNESS) -> list[RecordFacts]:
    """Sites of one limb: a modulus of about 6 kPa everywhere, layers of several thicknesses."""
    rng = np.random.default_rng(seed)
    facts = []
    for k, h in enumerate(thickness):
        depth = min(7.0, 0.4 * h) * rng.uniform(0.8, 1.0)
        modulus = 6.0 * np.exp(scatter * rng.standard_normal())
        peak = modulus * 1e-3 * 8 * RADIUS * compute_layer_factor(RADIUS / h) * depth
        speed = 0.96 * (1 + 0.05 * rng.uniform(-1, 1))
        facts.append(RecordFacts(f"s{k}", peak, depth, speed, 0.002, RADIUS, h, 2.0, 0.2))
    return facts


def recorded(fact: RecordFacts, force: float, travel: float, time: float) -> RecordFacts:
    """The same record written in other units."""
    return replace(
        fact,
        peak_N=fact.peak_N * force,
        depth_mm=fact.depth_mm * travel,
        speed_mm_s=fact.speed_mm_s * travel / time,
        step_s=fact.step_s * time,
    )


def test_the_layer_stiffens_from_the_half_space_to_the_cube_of_a_thin_layer():
    assert compute_layer_factor(0.0) == 1.0
    ratios = np.linspace(0, 6, 100)
    factors = np.array([compute_layer_factor(r) for r in ratios])
    assert np.all(np.diff(factors) > 0)
    assert compute_layer_factor(8.0) == pytest.approx(8 * compute_layer_factor(4.0))


def test_the_modulus_comes_back_whatever_the_thickness():
    for fact in study(scatter=0.0):
        assert fact.modulus_kPa == pytest.approx(6.0)


@pytest.mark.parametrize("seed", range(20))
def test_clean_studies_have_no_warning(seed):
    assert check_plausibility(study(seed)) == ()


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("seed", range(4))
def test_a_record_in_another_unit_is_named(unit, seed):
    facts = study(seed)
    facts[seed] = recorded(facts[seed], *UNITS[unit])
    flags = [flag for flag in check_plausibility(facts) if flag.kind == "unit"]
    assert [flag.sites for flag in flags] == [(f"s{seed}",)]
    near = {name for name, factors in UNITS.items() if np.allclose(factors, UNITS[unit], rtol=0.6)}
    assert flags[0].cause in near


@pytest.mark.parametrize("seed", range(6))
def test_swapped_names_of_thin_and_thick_sites_are_found(seed):
    facts = study(seed)
    thin, thick = facts[1], facts[2]
    facts[1] = replace(thick, record="s1", thickness_mm=thin.thickness_mm)
    facts[2] = replace(thin, record="s2", thickness_mm=thick.thickness_mm)
    swaps = [flag for flag in check_plausibility(facts) if flag.kind == "swap"]
    assert [flag.sites for flag in swaps] == [("s1", "s2")]
    assert swaps[0].evidence["scatter_exchanged"] < 0.5 * swaps[0].evidence["scatter"]


def test_a_slower_protocol_at_one_site_is_no_fault():
    facts = study()
    facts[3] = replace(facts[3], speed_mm_s=0.2)
    assert check_plausibility(facts) == ()


def test_all_records_in_another_unit_are_told_from_a_limb():
    facts = [recorded(fact, 101.97, 1, 1) for fact in study()]
    assert [flag.sites for flag in check_plausibility(facts)] == [()]


def test_axes_places_and_depths():
    facts = study()
    facts[0] = replace(facts[0], axis_deg=40.0)
    facts[2] = replace(facts[2], off_skin_mm=4.5)
    facts[3] = replace(facts[3], hint_mm=20.0)
    found = {flag.sites[0]: flag for flag in check_plausibility(facts)}
    assert set(found) == {"s0", "s2", "s3"}
    assert found["s0"].evidence == {"axis_deg": 40.0}


def test_without_thickness_only_gross_errors_are_told():
    facts = [replace(fact, thickness_mm=None) for fact in study()]
    assert check_plausibility(facts) == ()
    facts[4] = recorded(facts[4], 1000.0, 1, 1)
    assert [flag.kind for flag in check_plausibility(facts)] == ["unit"]


def test_flags_say_what_why_and_what_to_do():
    facts = study()
    facts[0] = recorded(facts[0], 9.80665, 1, 1)
    told = check_plausibility(facts)[0].to_dict()
    for part in ("s0", "times", "likely", "convert"):
        assert part in told["text"]
    assert told["evidence"]["modulus_ratio"] > 4


def test_a_unit_that_the_record_shows_is_the_only_cause_told():
    """A displacement in cm looks like ten times the force to the model."""
    facts = study()
    facts[3] = recorded(facts[3], 1.0, 0.1, 1.0)
    in_records = check_plausibility(facts)
    missed = [
        RecordWarning((site,), "unit", "predicted far too soft", {}, "force in kgf", "convert the force to N")
        for site in ("s3", "s4")
    ]
    told = explain_warnings(missed, in_records)
    assert [flag.sites for flag in in_records] == [("s3",)]
    assert (told[0].cause, told[0].remedy) == (in_records[0].cause, in_records[0].remedy)
    assert "displacement" in told[0].cause
    assert told[1] == missed[1]
