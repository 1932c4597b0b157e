"""``[[socket.measured]]``: what is refused, where cells are, and how they agree with the model."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limbfit import fit_socket, load_results, load_study, report_study, run_study, study_status
from limbfit.cli.socket import show_socket
from limbfit.donning import LoadedState, SocketStep, Strains
from limbfit.donning.outcome import Patch
from limbfit.errors import InputError
from limbfit.mesh import read_vtu
from limbfit.pipeline.commands.planning import choose_tissues
from limbfit.pipeline.socket.measured import describe_measured, sample_pressure, summarise_agreement
from limbfit.pipeline.socket.sensors import write_true_sensors
from limbfit.pipeline.socket.shape import build_regions, build_socket
from limbfit.pipeline.socket.simulation import SocketLimb
from limbfit.results.socket import MeasuredCell, SensorComparison, SocketResult
from small_limb import limb, small_limb

LOADED = 'hold_s = 0.0\n[[socket.loads]]\nname = "stance"\nforce_N = [0.0, 0.0, 150.0]\nhold_s = 0.0\n'
BARE = f"liner = {{ thickness_mm = 0.0 }}\n{LOADED}"
TABLE = '\n[[socket.measured]]\nname = "one"\nload = "stance"\nerror_percent = 10.0\n'
CELLS = f'{TABLE}file = "cells.csv"\nformat = "cells"\n'
LAYOUT = "rows = 2\ncolumns = 3\nspacing_mm = [10.0, 10.0]\n"
SHEET = f"""{TABLE}{LAYOUT}file = "strip.asc"
format = "pliance"
landmarks = [
  {{ row = 1, column = 1, position = [2.0, -114.2, 255.0] }},
  {{ row = 1, column = 3, position = [22.0, -114.2, 255.0] }},
  {{ row = 2, column = 1, position = [2.0, -114.2, 245.0] }},
]
"""
STRIP = "pressure values in kPa\ntime[secs] 1 2 3 4 5 6\n 0.1 5 5 5 5 5 5\n"


def place_cell(folder: Path, text: str, y_mm: float = -115.0) -> list[str]:
    """Describe the measured tables of a study whose one cell is in front of the limb."""
    (folder / "cells.csv").write_text(f"x_mm,y_mm,z_mm,area_mm2,pressure_kPa\n12,{y_mm},250,100,25\n")
    (folder / "strip.asc").write_text(STRIP)
    return describe_measured(load_study(small_limb(folder, BARE + text)), limb())


@pytest.mark.parametrize(
    ("text", "old", "new", "said"),
    [
        (CELLS, 'load = "stance"', 'load = "run"', "no load is named 'run'; there are donning, stance"),
        (CELLS, "cells.csv", "none.csv", "socket.measured.one.file: none.csv does not exist"),
        (CELLS, "error_percent = 10.0", "", "the sensor's error is not known; give error_kPa"),
        (CELLS, "format", "rows = 3\nformat", 'rows does not belong to format = "cells"'),
        (CELLS, "format", "within_mm = 0.1\nformat", "cell 1 lies [0-9]+ mm from the socket's face; correct"),
        (SHEET, "rows = 2\n", "", "the file does not state the sheet's layout; give rows"),
        (SHEET, "  { row = 2", "# ", "2 landmarks; a sheet is placed by three or more"),
        (SHEET, "{ row = 2, column = 1", "{ row = 1, column = 2", "all landmarks lie on one line"),
        (SHEET, "{ row = 2", "{ row = 3", "no cell 3-1 for a landmark; there are 2 rows"),
        (SHEET, "-114.2, 245.0", "-214.2, 245.0", "landmark 3 lies [0-9]+ mm from the socket's face"),
        (SHEET, "245.0", "225.0", "socket.measured.one: the sheet would be stretched by [0-9]+ %"),
        (SHEET, "format", "from_s = 9.0\nformat", "strip.asc: frames: no frame from 9 to inf s; correct"),
        (
            SHEET,
            "position = [2.0, -114.2, 245.0]",
            'marker = "A"',
            "marker belong together",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, text, old, new, said):
    y_mm = -130.0 if "within_mm" in new else -115.0
    with pytest.raises(InputError, match=said) as caught:
        place_cell(tmp_path, text.replace(old, new), y_mm)
    assert "\n" not in str(caught.value)


def test_a_marker_of_3d_slicer_places_a_cell_and_an_unknown_one_is_refused(tmp_path):
    points = [{"label": "A", "position": [2.0, -114.2, 245.0]}]
    markups = {"markups": [{"coordinateSystem": "LPS", "controlPoints": points}]}
    (tmp_path / "sheet.mrk.json").write_text(json.dumps(markups))
    text = SHEET.replace("position = [2.0, -114.2, 245.0]", 'marker = "A"')
    text = text.replace("rows = 2", 'markups = "sheet.mrk.json"\nrows = 2')
    cells, strip = place_cell(tmp_path, CELLS.replace('"one"', '"cell"') + text)
    assert cells == "socket.measured.cell: 1 compared"
    assert strip.startswith("socket.measured.one: 6 compared; stretched by ")
    with pytest.raises(InputError, match="no marker is named 'B'; there are A"):
        place_cell(tmp_path, text.replace('"A"', '"B"'))


def test_cells_move_with_the_socket_and_average_the_pressure_over_their_area(tmp_path):
    """A pressure that is linear in space; the limb stays, or turns and goes along with the socket."""
    study, anatomy = load_study(small_limb(tmp_path, BARE)), limb()
    run_limb = SocketLimb(study, anatomy, anatomy, None, build_regions(study, anatomy), ())
    socket = build_socket(study, anatomy, anatomy.skin)
    mesh, _ = run_limb.mesh(tmp_path, socket, lambda words: None)
    model = run_limb.build_model(socket, mesh)
    move, degrees, none = np.array([0.0, 0.0, 6.0]), np.array([0.0, 0.0, 10.0]), np.zeros(3)
    middles = mesh.points[mesh.face_sets["skin"][:, :3]].mean(axis=1)
    points = middles[socket.find_covered(middles)][::7]
    nodes, still = mesh.points - model.fit.pivot, np.zeros_like(mesh.points)
    turn = Rotation.from_euler("z", 10.0, degrees=True)
    along = turn.apply(nodes) - nodes + move @ model.fit.frame
    strains = Strains(*(np.zeros(len(mesh.cells)) for _ in range(4)))
    slopes, at = np.array([0.3, 0.0, 0.2]), points - model.fit.pivot

    def sample(share: float, away: np.ndarray, onto: np.ndarray | None = None) -> tuple:
        patch = Patch(0.0, 0.0, 0.0, 0.0)
        row = SocketStep(0.0, none, none, share * move, share * degrees, 0.0, 0.0, 0.0, patch, {})
        held = LoadedState(row, 20.0 + nodes @ slopes, still, away, strains, {})
        return sample_pressure(model, held, points, np.full(len(points), 30.0), onto)

    for share, away, place in ((0.0, still, at), (1.0, along, at), (1.0, still, turn.apply(at) + move)):
        off = sample(share, away)[0] - (20.0 + place @ slopes)
        assert abs(np.median(off)) < 0.15
        assert np.percentile(np.abs(off), 90) < 1.0  # between facets; turned the other way it is 4
    # Where a cell slides from facet to facet its pressure jumps, but not where it keeps to the first one.
    for share in np.linspace(0.0, 1.0, 201):
        _, below = sample(share, still)
        before, after = (sample(share + step, still, below)[0] for step in (-1e-6, 1e-6))
        np.testing.assert_allclose(after, before, atol=2e-5)


def test_the_stage_sensors_stores_the_cells_and_the_limb_in_its_socket(tmp_path):
    place_cell(tmp_path, f"{CELLS}[calibration]\nuse_socket_pressures = true\n")
    study = load_study(tmp_path)
    run_study(study, until="sensors")
    (one,) = load_results(tmp_path).sensors.sensors
    assert (one.name, one.load, one.error_percent) == ("one", "stance", 10.0)
    (cell,) = one.cells
    assert (cell.state, cell.area_mm2, cell.measured_kPa) == ("compared", 100.0, 25.0)
    assert len(read_vtu(study.results / "sensors" / "limb.vtu").cells) > 100
    cells = tmp_path / "cells.csv"
    cells.write_text(cells.read_text().replace(",25\n", ",\n"))
    with pytest.raises(InputError, match=r"socket.measured: no cell can be compared"):
        run_study(load_study(tmp_path), until="sensors")
    assert "sensors" not in {row["stage"] for row in study_status(load_study(small_limb(tmp_path, BARE)))}


def test_agreement_is_that_of_bland_and_altman_over_the_cells_that_are_compared():
    def cell(measured: float, model: float, state: str = "compared", **more) -> MeasuredCell:
        place = {"position_mm": (0.0, 0.0, 0.0), "level_mm": 0.0, "angle_deg": 0.0, "interval_kPa": None}
        own = (
            {"cell": "1", "state": state, "regions": ["crest"], "error_kPa": 1.5, "area_mm2": 100.0}
            | place
            | more
        )
        return MeasuredCell(measured_kPa=measured, model_kPa=model, **own)

    cells = [cell(10.0, 11.0), cell(20.0, 22.0, regions=[]), cell(30.0, 33.0, interval_kPa=(30.4, 34.0))]
    rows = [*cells, cell(50.0, 90.0, "saturated"), cell(0.0, 40.0, "dead")]
    sensors = SensorComparison(name="a", load="stance", stretch_percent=None, counts={}, cells=rows)
    every, crest = summarise_agreement([sensors])
    assert (every.region, every.cells, every.bias_kPa) == ("all", 3, 2.0)
    np.testing.assert_allclose(every.limits_kPa, [2.0 - 1.96, 2.0 + 1.96], atol=1e-3)
    assert every.within_percent == pytest.approx(200.0 / 3.0)  # 3 kPa are within hypot(1.5, 2.6)
    assert (crest.region, crest.cells, crest.bias_kPa) == ("crest", 2, 2.0)


@pytest.mark.slow
def test_sensors_of_a_phantom_are_compared_stored_and_reported(tmp_path, capsys):
    """The truth is of another mesh of the same limb, so coarse that single cells differ."""
    small_limb(tmp_path, LOADED, edge_mm=22.0)
    tissues, _ = choose_tissues(load_study(tmp_path), True, None)
    truth, study = write_true_sensors(tmp_path, limb(), tissues, 0), load_study(tmp_path)
    fit_socket(study, literature=True)
    found = SocketResult.read(study.results)
    for one in found.sensors:
        pairs = zip(one.cells, truth[one.name], strict=True)
        assert np.mean([abs(cell.measured_kPa - true) <= cell.error_kPa for cell, true in pairs]) > 0.9
    sheet = found.sensors[0]
    assert (sheet.counts["dead"], sheet.cells[20].state) == (1, "dead")
    assert sheet.counts["saturated"] >= 1
    assert abs(found.agreement[0].bias_kPa) < 1.5
    show_socket(found)
    assert "stance: model minus measured" in capsys.readouterr().out
    assert "sheet, stance: measured" in Path(report_study(study)["report"]).read_text()
