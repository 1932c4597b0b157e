"""``calibration.use_socket_pressures``: what sensors in a socket measured counts beside the records."""

from pathlib import Path

import numpy as np
import pytest

from limbfit import load_results, load_study, report_study, run_study
from limbfit.pipeline.commands.planning import choose_tissues
from limbfit.pipeline.commands.simulate import simulate_site
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.identification.pressures import PressureSimulator
from limbfit.pipeline.socket.sensors import write_true_sensors
from small_limb import limb, small_limb

LOADED = """hold_s = 0.0
[[socket.loads]]
name = "stance"
force_N = [0.0, 0.0, 150.0]
hold_s = 0.0
"""
FREE = ("skin.c_kPa", "muscle.c_kPa")


@pytest.fixture
def measured(tmp_path) -> Path:
    """A limb with sensors in its socket, and the tissues of people."""
    study = load_study(small_limb(tmp_path, LOADED, edge_mm=22.0))
    write_true_sensors(tmp_path, limb(), choose_tissues(study, True, None)[0], 0)
    return tmp_path


def write_record(curve: Path, file: Path) -> None:
    """A simulated curve as a rig records it: from 1 mm before the skin, with a sensor's noise."""
    time, depth, force = np.loadtxt(curve, delimiter=",", skiprows=1).T
    ends = time[-1] + 1.04, time[-1] + 2.0
    before, after = np.linspace(0.0, 0.96, 25), np.linspace(*ends, 25)
    at = np.concatenate([before, 1.0 + time, after])
    knots = np.concatenate([before, 1.0 + depth, np.linspace(1.0, 0.0, 25)])
    steady = np.arange(0.0, at[-1], 0.02)
    clean = np.interp(steady, at, np.concatenate([0.0 * before, force, 0.0 * after]))
    noisy = clean + 0.002 * np.random.default_rng(0).normal(size=len(steady))
    columns = np.column_stack([steady, np.interp(steady, at, knots), noisy])
    np.savetxt(file, columns, delimiter=",", header="time_s,displacement_mm,force_N", comments="")


@pytest.mark.slow
def test_pressures_of_cells_have_derivatives_with_respect_to_the_tissues(measured, tmp_path):
    """Against simulations of other tissues, on a mesh so coarse that cells lose contact between them."""
    text = (measured / "study.toml").read_text()
    (measured / "study.toml").write_text(f"{text}\n[calibration]\nuse_socket_pressures = true\n")
    study = load_study(measured)
    run_study(study, until="sensors")
    at = study.vector(choose_tissues(study, True, None)[0])
    simulator = PressureSimulator(study, Store(study.results), tmp_path / "kept", print)
    number = [f"{tissue}.{name}" for tissue, name in study.parameters].index("muscle.c_kPa")
    step = 0.03 * np.eye(len(at))[number]
    here, less, more = (simulator.read_cells(at * np.exp(by), "here") for by in (0.0 * step, -step, step))
    expected, found = (less.off - more.off) / 0.06, here.derivatives[:, number]
    assert np.corrcoef(expected, found)[0, 1] > 0.95
    assert np.median(np.abs(found - expected)) < 0.03 * np.abs(expected).max()


@pytest.mark.slow
def test_records_and_pressures_together_find_a_known_tissue(measured):
    """Skin and muscle from one record, which leaves their balance open: the pressures narrow it."""
    file = measured / "study.toml"
    file.write_text(file.read_text() + '\n[indenter]\nshape = "sphere"\nwidth_mm = 20.0\n')
    study = load_study(measured)
    truth, _ = choose_tissues(study, True, None)
    simulate_site(study, "1", parameters=truth)
    write_record(measured / "results" / "simulate" / "1.csv", measured / "1.csv")
    fixed = [name for name in map(".".join, study.parameters) if name not in FREE]
    text = study.file.read_text().replace("depth_mm = 3.0", 'trace = "1.csv"\nfitted = true')
    text += f"\n[calibration]\nuse_socket_pressures = false\nfixed = {fixed}\n"
    for tissue, values in truth.items():
        beside = values | {"c_kPa": 1.5 * values["c_kPa"]}
        start = ", ".join(f"{key} = {value}" for key, value in beside.items())
        text += f"[material.tissues.{tissue}]\nstart = {{ {start} }}\n"
    study.file.write_text(text)
    run_study(load_study(measured))
    alone = load_results(measured).calibration.uncertainty.intervals_95
    study.file.write_text(text.replace("use_socket_pressures = false", "use_socket_pressures = true"))
    run_study(load_study(measured))
    found = load_results(measured).calibration
    told, known = found.socket_pressures, found.uncertainty
    assert told.settled
    assert told.cells > 80
    for name in FREE:
        tissue = name.removesuffix(".c_kPa")
        low, high = known.intervals_95[tissue]["c_kPa"]
        assert low < truth[tissue]["c_kPa"] < high
        assert high / low < alone[tissue]["c_kPa"][1] / alone[tissue]["c_kPa"][0]
        assert told.wider_without[name] > 1.0
        assert told.share[name] > 0.0
    page = Path(report_study(load_study(measured))["report"]).read_text()
    assert "in the socket measured count beside the records" in page
