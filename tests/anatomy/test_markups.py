"""Sites from the control points of 3D Slicer."""

import json

import numpy as np
import pytest

from limbfit.anatomy.sites.markups import read_markups
from limbfit.errors import InputError, SiteError
from limbfit.study import load_study


def points(*labels: str, status: str = "defined") -> list[dict]:
    return [
        {"id": str(n), "label": label, "position": [40.0, -n, 60.0 + n], "positionStatus": status}
        for n, label in enumerate(labels)
    ]


def write(path, *lists, system: object = "LPS", **more: object):
    markups = [
        {"type": "Fiducial", "coordinateSystem": system, "controlPoints": one, **more} for one in lists
    ]
    path.write_text(json.dumps({"@schema": "https://raw.githubusercontent.com/slicer", "markups": markups}))
    return path


@pytest.mark.parametrize(("system", "sign"), [("LPS", 1), ("RAS", -1), (1, 1), ("0", -1)])
def test_the_files_own_coordinates_are_followed(tmp_path, system, sign):
    file = write(tmp_path / "a.mrk.json", points("1", " 2 "), system=system, coordinateUnits="mm")
    found = read_markups(file)
    assert list(found) == ["1", "2"]
    assert np.allclose(found["2"], [sign * 40.0, sign * -1.0, 61.0])


def test_several_lists_and_points_not_placed(tmp_path):
    file = write(tmp_path / "a.mrk.json", points("1"), points("2"), points("3", status="preview"))
    assert list(read_markups(file)) == ["1", "2"]


@pytest.mark.parametrize(
    ("system", "more", "expected"),
    [
        (None, {}, "LPS or RAS"),
        ("LPS", {"coordinateUnits": "m"}, "not in millimetres"),
        ("LPS", {"controlPoints": points("1", "1")}, "labelled alike: 1"),
        ("LPS", {"controlPoints": [{"label": "1", "position": [1.0, None, 2.0]}]}, "not a readable"),
        ("LPS", {"controlPoints": [{"label": "1", "position": [1.0, 2.0]}]}, "three coordinates"),
    ],
)
def test_unclear_files_are_refused(tmp_path, system, more, expected):
    file = write(tmp_path / "a.mrk.json", points("1"), system=system, **more)
    with pytest.raises(SiteError, match=expected) as caught:
        read_markups(file)
    assert "a.mrk.json" in str(caught.value)


def test_what_is_no_markups_file_is_refused(tmp_path):
    for text in ("", "[1]", '{"markups": 3}', '{"a": 1}', "\0"):
        (tmp_path / "a.mrk.json").write_text(text)
        with pytest.raises(SiteError, match="not a readable markups file"):
            read_markups(tmp_path / "a.mrk.json")


def with_markups(study, *labels: str, keep: tuple[str, ...] = (), **options: object):
    """The study with its positions taken out, except some, and a markups file in."""
    write(study / "sites.mrk.json", points(*labels), **options)
    text = (study / "study.toml").read_text()
    for line in ("position = [40.0, 0.0, 60.0]", "position = [0.0, 40.0, 50.0]"):
        text = text if line in keep else text.replace(line, "")
    (study / "study.toml").write_text(text + '\n[markups]\nfile = "sites.mrk.json"\n')
    return study


def test_sites_take_the_points_of_their_names(study):
    found = load_study(with_markups(study, "1", "2", "7"))
    assert found.site("1").position == (40.0, 0.0, 60.0)
    assert found.site("2").position == (40.0, -1.0, 61.0)
    assert found.notes == ("control points without a site: 7",)


@pytest.mark.parametrize(
    ("labels", "keep", "expected"),
    [
        (("1",), (), "sites.2: no control point of sites.mrk.json is labelled '2'; it has '1'"),
        (("1", "2"), ("position = [40.0, 0.0, 60.0]",), "sites.1: the site has a place here and"),
    ],
)
def test_misses_and_doubles_are_refused(study, labels, keep, expected):
    with pytest.raises(InputError, match=expected):
        load_study(with_markups(study, *labels, keep=keep))


def test_a_missing_file_is_named(study):
    with_markups(study, "1", "2")
    (study / "sites.mrk.json").unlink()
    with pytest.raises(InputError, match=r"markups\.file: sites\.mrk\.json does not exist"):
        load_study(study)
