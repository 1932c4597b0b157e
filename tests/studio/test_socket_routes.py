"""The view Socket's server side: the shape and its offsets; areas of the page end in the study file."""

from __future__ import annotations

import numpy as np
import pytest
from fastapi.testclient import TestClient

from limbfit import load_study
from limbfit.studio.app import create_app
from limbfit.studio.folder import StudyFolder
from limbfit.studio.guard import Door
from limbfit.web.arrays import unpack

ORIGIN = "http://127.0.0.1:8123"
AREA = {"name": "front", "position": [0.0, -41.0, 60.0], "radius_mm": 25.0, "depth_mm": 4.0}


@pytest.fixture
def page(study):
    """The stump with a socket and a comment in its file, as its page talks to it."""
    file = study / "study.toml"
    file.write_text(file.read_text() + "[socket]\ntrim_mm = 40.0  # of the brim\n")
    door = Door("127.0.0.1", 8123)
    client = TestClient(create_app(StudyFolder(file), door), base_url=ORIGIN, headers={"Origin": ORIGIN})
    assert client.get("/", params={"token": door.token}).status_code == 200
    return client


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
    file = study / "study.toml"
    one = '{ name = "a", region = "tibial crest", radius_mm = 20.0, depth_mm = 1.0 }'
    file.write_text(file.read_text() + f"areas = [{one}]\n")
    assert page.post("/api/socket/areas", json=AREA).status_code == 200
    assert [area.name for area in load_study(study).socket.areas] == ["a", "front"]
