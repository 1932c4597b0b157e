"""One case of each kind of damage ends in one clear line; all kinds, with the model, in the slow test."""

import damaging  # noqa: F401
import numpy as np
import pytest
from damage import KINDS, Kind, Whole
from damaged_inputs import FORK, judge, make_whole, read_whole, run_case

from limbfit.anatomy.surfaces.surfaces import build_anatomy
from limbs import leg_image, rotation, write_dicom

SEED = 1
ROOMS = ("dicom", "file", "labels", "surfaces")


@pytest.fixture(scope="module")
def leg(tmp_path_factory) -> Whole:
    """A smaller limb than the benchmark's, its labels the truth."""
    folder = tmp_path_factory.mktemp("leg")
    image, labels = leg_image([4.2, 4.3, 5.1], (31, 31, 30), rotation(4))
    image = image.with_array(np.round(image.array))
    write_dicom(folder / "mri", image, SpacingBetweenSlices="5.1")
    return Whole(folder, image, labels, build_anatomy(labels, 8.0))


def refused_by_check(room: str) -> list[Kind]:
    return [
        kind
        for kind in KINDS.values()
        if (kind.room, kind.expected, kind.by_check) == (room, "refused", True)
    ]


@pytest.mark.parametrize("room", ROOMS)
def test_damage_is_refused_in_one_line(leg, tmp_path, limbfit_and_libraries, room):
    kinds = refused_by_check(room)
    assert len(kinds) > 5
    found = {}
    for number, kind in enumerate(kinds):
        folder = tmp_path / kind.name
        folder.mkdir()
        inputs = kind.make(np.random.default_rng([SEED, number]), leg, folder)
        (folder / "study.toml").write_text(leg.study(inputs))
        code, out, err = limbfit_and_libraries("check", folder)
        verdict, text, _ = judge(kind, code, err + out, folder, leg, "check")
        found[kind.name] = verdict if verdict == "refused" else f"{verdict}: {text}"
    assert set(found.values()) == {"refused"}, found


@pytest.fixture(scope="module")
def phantom(tmp_path_factory) -> Whole:
    folder = tmp_path_factory.mktemp("phantom") / "whole"
    child = FORK.Process(target=make_whole, args=(folder, 0))
    child.start()
    child.join()
    return read_whole(folder)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if kind.expected != "refused"])
def test_what_is_not_refused_gives_the_undamaged_model(phantom, tmp_path, name):
    kind = KINDS[name]
    outcome = run_case(list(KINDS).index(name), kind, phantom, tmp_path / "case", SEED)
    allowed = {"same": {"same"}, "repaired": {"repaired"}, "either": {"same", "refused"}}
    assert outcome.verdict in allowed[kind.expected], outcome.text
