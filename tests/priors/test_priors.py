"""The priors of people in a study: which tissue has which, what is refused, what is stored and shown."""

from pathlib import Path

import pytest

from editing import append, edit, list_stale
from limbfit.errors import InputError, StudyError
from limbfit.pipeline.commands.check import check_study
from limbfit.pipeline.identification.search import build_unknowns
from limbfit.priors import LITERATURE, PRIORS, of_tissues
from limbfit.study import Study, load_study

PEOPLE = '[calibration]\npriors = "population"\n'
THREE = '[geometry]\nlayers = [{ name = "skin", thickness_mm = 2.0 }, { name = "fat", thickness_mm = 5.0 }]\n'
HIDE = '[geometry]\nlayers = [{ name = "hide", thickness_mm = 3.0 }]\n'


def with_settings(folder: Path, more: str) -> Study:
    append(folder, more)
    return load_study(folder)


def test_a_study_has_no_priors_of_its_own(study: Path) -> None:
    assert build_unknowns(load_study(study)).priors == ()


def test_a_skin_without_fat_below_it_is_skin_with_its_fat(study: Path) -> None:
    found = {prior.name: prior for prior in build_unknowns(with_settings(study, PEOPLE)).priors}
    assert set(found) == {"skin.c_kPa", "skin.m", "muscle.c_kPa", "muscle.m"}
    known = PRIORS["skin_fat"]["c_kPa"]
    assert (found["skin.c_kPa"].median, found["skin.c_kPa"].factor) == (known["median"], known["factor"])


NAMED = {
    "over fat a skin has no c": (THREE + PEOPLE, "skin.m fat.c_kPa fat.m muscle.c_kPa muscle.m"),
    "fat of which nothing is to be known is fat all the same": (
        THREE + PEOPLE + 'prior_tissues = { fat = "none" }\n',
        "skin.m muscle.c_kPa muscle.m",
    ),
    "the study says what another name means": (
        HIDE + PEOPLE + 'prior_tissues = { hide = "skin_fat", muscle = "none" }\n',
        "hide.c_kPa hide.m",
    ),
}


@pytest.mark.parametrize("what", NAMED)
def test_which_parameters_have_priors(study: Path, what: str) -> None:
    more, expected = NAMED[what]
    assert {prior.name for prior in build_unknowns(with_settings(study, more)).priors} == {*expected.split()}


def test_what_is_stated_or_fixed_is_not_people_s(study: Path) -> None:
    more = "fixed = ['skin.m']\nprior = { 'muscle.c_kPa' = { median = 9.0, factor = 1.1 } }\n"
    found = {prior.name: prior for prior in build_unknowns(with_settings(study, PEOPLE + more)).priors}
    assert set(found) == {"skin.c_kPa", "muscle.c_kPa", "muscle.m"}
    assert (found["muscle.c_kPa"].median, found["muscle.c_kPa"].factor) == (9.0, 1.1)


def test_what_a_tissue_is_decides_the_calibration_alone(study: Path) -> None:
    plain = with_settings(study, PEOPLE)
    other = with_settings(study, 'prior_tissues = { skin = "none" }\n')
    assert list_stale(plain, other) == {"calibrate", "predict", "report"}


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (HIDE + PEOPLE, "which tissue of people is 'hide'"),
        (PEOPLE + 'prior_tissues = { bark = "skin" }\n', "the model has no tissue 'bark'"),
        (PEOPLE + 'prior_tissues = { skin = "bark" }\n', "'bark' is no tissue of people"),
        (PEOPLE + 'objective = "paper"\n', "no place for priors"),
        ('[calibration]\npriors = "animals"\n', "population"),
        (PEOPLE + '[material]\nlaw = "of_another_kind"\n', 'described by the law "ogden"'),
    ],
)
def test_what_people_cannot_say_is_refused_in_one_line(study: Path, more: str, words: str) -> None:
    (study / "law.py").write_text(
        "from dataclasses import replace\nfrom limbfit.laws import LAWS, register_law\n"
        'register_law(replace(LAWS["ogden"], name="of_another_kind"))\n'
    )
    edit(study, "[study]\n", '[study]\nextensions = ["law.py"]\n')
    with pytest.raises(StudyError, match=words):
        with_settings(study, more)


def test_check_tells_the_priors(commands_unasked: None, study: Path) -> None:
    facts = check_study(with_settings(study, PEOPLE), listener=lambda event: None)["facts"]
    (told,) = (fact for fact in facts if "priors" in fact)
    known = PRIORS["muscle"]["c_kPa"]
    assert f"muscle.c_kPa {known['median']:g}, factor {known['factor']:g}" in told


def test_a_tissue_that_is_not_known_names_the_remedy() -> None:
    with pytest.raises(InputError) as caught:
        of_tissues(("skin", "tendon"))
    assert '"skin_fat"' in str(caught.value.remedy)


def test_literature_is_cited_and_read_where_it_says() -> None:
    for one in LITERATURE:
        assert {"tissue", "citation", "who", "site", "method", "read"} <= set(one)
        assert one["tissue"] in PRIORS
        assert any(key in one for key in ("c_kPa", "m", "gamma", "tau_s"))
        if "doi" in one:
            assert one["doi"].startswith("10.")


def test_the_page_lists_every_literature_value_and_every_prior() -> None:
    page = (Path(__file__).parents[2] / "docs" / "priors.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    for one in LITERATURE:
        values = [f" {one[key]:g} " for key in ("c_kPa", "m", "gamma", "tau_s") if key in one]
        cited = [row for row in rows if one["citation"] in row and f"| `{one['tissue']}` " in row]
        assert any(one["site"] in row and all(value in row for value in values) for row in cited), one
    for tissue, parameters in PRIORS.items():
        for key, prior in parameters.items():
            told = f"{prior['median']:g} ×÷ {prior['factor']:g}"
            assert any(f"| `{tissue}` " in row and told in row for row in rows), (tissue, key)
