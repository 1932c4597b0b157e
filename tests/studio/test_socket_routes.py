"""The view Socket's server side: the shape and its offsets; areas of the page end in the study file."""

import numpy as np
import pytest
from serving_here import open_page

from editing import append, edit
from limbfit import load_study
from unpacking import unpack

AREA = {"name": "front", "position": [0.0, -41.0, 60.0], "radius_mm": 25.0, "depth_mm": 4.0}


@pytest.fixture
def page(study):
    """The stump with a socket and a comment in its file, as its page talks to it."""
    append(study, "[socket]\ntrim_mm = 34.0  # of the brim\n")
    return open_page(study)


def test_areas_of_the_page_are_areas_of_the_study_and_press_the_face_in(page, study):
    before = page.get("/api/socket/shape").json()
    assert before["problem"] is None
    assert before["areas"] == []
    assert "tibial crest" in before["regions"]
    plain, _ = unpack(page.get("/api/socket/face").content)
    after = page.post("/api/socket/areas", json=AREA).json()
    assert after["mark"] != before["mark"]
    (area,) = load_study(study).socket.areas
    assert (area.name, area.radius_mm, area.depth_mm, area.region) == ("front", 25.0, 4.0, None)
    assert np.linalg.norm(np.subtract(area.position, AREA["position"])) < 3.0  # put on the skin
    pressed, _ = unpack(page.get("/api/socket/face").content)
    middle = np.linalg.norm(pressed["points"] - area.position, axis=1).argmin()
    assert pressed["values"][middle] == pytest.approx(plain["values"].min() - 4.0, abs=1.0)
    moved = {**AREA, "position": None, "region": "tibial crest", "depth_mm": -2.0}
    (row,) = page.post("/api/socket/areas", json=moved).json()["areas"]
    assert (row["region"], row["depth_mm"]) == ("tibial crest", -2.0)
    assert row["position_mm"] is not None  # the region's middle
    assert load_study(study).socket.areas[0].position is None
    assert page.post("/api/socket/areas/front/remove").json()["areas"] == []
    assert "# of the brim" in (study / "study.toml").read_text()


def test_what_cannot_be_drawn_is_said_and_what_the_study_refuses_changes_nothing(page, study):
    shape = page.post("/api/socket/areas", json={**AREA, "radius_mm": 5.0}).json()
    assert "steeper than 45 degrees" in shape["problem"]
    assert page.get("/api/socket/face").status_code == 422
    text = (study / "study.toml").read_text()
    for wrong in ({"radius_mm": 500.0}, {"region": "tibial crest"}, {"name": ""}, {"position": None}):
        assert page.post("/api/socket/areas", json={**AREA, **wrong}).status_code == 422, wrong
    assert page.post("/api/socket/areas/none/remove").status_code == 422
    assert (study / "study.toml").read_text() == text


def test_a_list_of_areas_in_one_line_is_added_to(page, study):
    one = '{ name = "a", region = "tibial crest", radius_mm = 20.0, depth_mm = 1.0 }'
    append(study, f"areas = [{one}]\n")
    assert page.post("/api/socket/areas", json=AREA).status_code == 200
    assert [area.name for area in load_study(study).socket.areas] == ["a", "front"]


def heights(points) -> np.ndarray:
    return np.array(points)[:, 2]  # of the stump, which stands along z


def test_a_dragged_brim_is_a_trimline_of_the_study_and_moves_the_face(page, study):
    before = page.get("/api/socket/shape").json()
    points = before["trim"]["points"]
    assert not before["trim"]["is_line"]
    assert len(points) == 16
    assert np.ptp(heights(points)) < 0.5  # a plane
    assert abs(np.hypot(*np.array(points)[:, :2].T) - 41.0).max() < 3.0  # on the skin
    plain, _ = unpack(page.get("/api/socket/face").content)
    front = int(np.argmin(np.array(points)[:, 1]))
    points[front] = [*points[front][:2], points[front][2] - 15.0]
    after = page.post("/api/socket/trimline", json={"points": points}).json()
    assert after["problem"] is None
    assert after["trim"]["is_line"]
    assert after["mark"] != before["mark"]
    socket = load_study(study).socket
    assert (socket.trim_mm, socket.trim_planes, len(socket.trimline)) == (None, (), 16)
    np.testing.assert_allclose(heights(socket.trimline), heights(points), atol=0.02)
    np.testing.assert_allclose(after["trim"]["points"], socket.trimline, atol=0.5)
    lower, _ = unpack(page.get("/api/socket/face").content)

    def top(face) -> float:
        """The highest point of the face on its front, where it is cut by the plane x = 0."""
        own = (abs(face["points"][:, 0]) < 4.0) & (face["points"][:, 1] < 0.0)
        return float(face["points"][own, 2].max())

    assert top(plain) - top(lower) == pytest.approx(15.0, abs=1.5)
    gone = page.post("/api/socket/trimline/remove").json()
    assert not gone["trim"]["is_line"]
    assert load_study(study).socket.trimline == ()


def test_a_brim_that_leaves_no_socket_is_refused_and_changes_nothing(page, study):
    text, points = (study / "study.toml").read_text(), page.get("/api/socket/shape").json()["trim"]["points"]
    low = [[x, y, z - 300.0] for x, y, z in points]
    for wrong, reason in (
        ([points[0], *low[1:]], "mm of the distal end"),
        ([[x, y, z + 300.0] for x, y, z in points], "beyond the limb's proximal cut"),
        ([points[0], points[4], points[2], points[8]], "does not go once around the limb"),
        (points[:2], ""),
        ([["nan", 0, 0]] * 3, ""),
    ):
        answer = page.post("/api/socket/trimline", json={"points": wrong})
        assert answer.status_code == 422, reason
        assert reason in answer.text
        assert (study / "study.toml").read_text() == text


def test_a_socket_from_a_file_has_no_brim_to_drag(page, study):
    (study / "own.stl").write_text("solid\nendsolid\n")
    edit(study, "trim_mm = 34.0", 'file = "own.stl"')
    assert page.get("/api/socket/shape").json()["trim"]["points"] == []
