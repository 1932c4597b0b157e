"""Where the stage `sites` puts a site, and the axis that it finds there."""

from pathlib import Path

import numpy as np
import pytest

from editing import edit
from limbfit.anatomy.sites.sites import compute_indenter_axis
from limbfit.anatomy.surfaces.surfaces import Anatomy
from limbfit.errors import SiteError
from limbfit.pipeline.limb.sites import place_site
from limbfit.pipeline.limb.surfaces import read_given_anatomy
from limbfit.results.limb import PlacedSite
from limbfit.study import load_study
from small_limb import small_limb


def place_changed(folder: Path, *changes: tuple[str, str]) -> tuple[PlacedSite, Anatomy]:
    """The first site of the small limb, some words of whose study are others, and the limb's surfaces."""
    small_limb(folder, "")
    for stated, instead in changes:
        edit(folder, stated, instead)
    study = load_study(folder)
    anatomy, _ = read_given_anatomy(study)
    return place_site(study.sites[0], study, anatomy, None), anatomy


def test_the_axis_is_the_mean_normal_under_the_square_as_it_is_turned(tmp_path: Path) -> None:
    """At the rounded end of a limb the normals differ from side to side."""
    end = ("[46.0, -80.0, 290.0]", "[36.0, -80.0, 212.5]")
    placed, anatomy = place_changed(
        tmp_path, end, ("depth_mm = 3.0", "depth_mm = 3.0\nedge = [0.0, 1.0, 1.0]")
    )
    turned, straight = (
        compute_indenter_axis(anatomy.skin, placed.position_mm, 20.0, edge) for edge in ([0, 1, 1], None)
    )
    assert np.allclose(placed.axis, turned)
    assert not np.allclose(turned, straight, atol=1e-4)


def test_a_site_beyond_the_cut_is_refused_with_the_study_file_and_its_name(tmp_path: Path) -> None:
    with pytest.raises(SiteError, match=r"study\.toml: sites\.1: lies on the proximal cut or beyond it"):
        place_changed(tmp_path, ("[46.0, -80.0, 290.0]", "[30.0, -80.0, 303.0]"))


def test_an_axis_that_points_out_of_the_limb_is_refused_whether_or_not_a_record_tells(tmp_path: Path) -> None:
    with pytest.raises(SiteError, match=r"study\.toml: sites\.1: the axis points out of the limb; negate it"):
        place_changed(tmp_path, ("depth_mm = 3.0", "depth_mm = 3.0\naxis = [1.0, 0.0, 0.1]"))
