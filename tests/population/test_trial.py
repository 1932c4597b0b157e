"""``population.toml``: what it holds, who is drawn from it, and what is refused."""

import json

import numpy as np
import pytest

import limbfit
from limbfit.errors import InputError, StudyError
from limbfit.population.limbs import FARTHEST
from limbfit.population.people import LINER, WEIGHT, People
from limbfit.population.trial import load_trial
from limbfit.priors import PRIORS

PHANTOM = '[shapes]\nphantom = "transtibial"\n'


def load(tmp_path, text):
    (tmp_path / "population.toml").write_text(text)
    return load_trial(tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "shapes"),
        ("[shapes]\n", "give one of phantom, model and folder"),
        ('[shapes]\nphantom = "arm"\n', "shapes.phantom"),
        ('[shapes]\nmodel = "none.npz"\n', "none.npz does not exist"),
        (PHANTOM + "modes = 3\n", "modes belongs to model"),
        (PHANTOM + "[population]\npeople = 0\n", "population.people"),
        (PHANTOM + "rules = []\n", "unknown key"),
        ("rules = []\n" + PHANTOM, "rules is empty"),
        (PHANTOM + '[[rules]]\nname = "a"\n[[rules]]\nname = "a"\n', "given twice: a"),
        (
            PHANTOM + '[[rules]]\nname = "a"\n[rules.socket]\nbody_weight_N = 700.0\n',
            "weight and liner have tables",
        ),
        (PHANTOM + "[person.sites]\nx = 1\n", "the table sites is written for each person"),
        (PHANTOM + "[liner]\nthickness_mm = [9.0, 3.0]\n", "the smaller one first"),
        (PHANTOM + "[robust]\nranges = { friction = [0.1, 0.2] }\n", "robust.ranges"),
        (PHANTOM + "[weight]\nmedian_kg = 80\n", "unknown key"),
        ("[shapes\n", "not valid TOML"),
    ],
)
def test_a_trial_that_cannot_be_meant_is_refused_in_one_line(tmp_path, text, words):
    with pytest.raises(StudyError, match=words) as refused:
        load(tmp_path, text)
    assert "population.toml" in str(refused.value)


def test_the_trial_that_init_writes_is_one(tmp_path):
    trial = load_trial(limbfit.write_trial(tmp_path / "mine"))
    assert trial.population.name == "mine"
    assert [rule.name for rule in trial.rules] == ["3 percent", "1 percent"]
    with pytest.raises(InputError, match="there is a trial already"):
        limbfit.write_trial(tmp_path / "mine")


def test_more_people_extend_those_who_are_there_and_a_seed_draws_others(tmp_path):
    first = People(load(tmp_path, PHANTOM))
    before = [first.draw(number).inputs for number in range(1, 9)]
    text = PHANTOM + '[population]\npeople = 1000\n[[rules]]\nname = "a"\n[[rules]]\nname = "b"\n'
    after = People(load(tmp_path, text))
    assert [after.draw(number).inputs for number in range(1, 9)] == before
    other = People(load(tmp_path, PHANTOM + "[population]\nseed = 1\n"))
    assert other.draw(1).inputs != before[0]


def test_people_have_the_tissues_and_weights_that_are_stated(tmp_path):
    trial = load(
        tmp_path, PHANTOM + "[weight]\nmedian_N = 700.0\nfactor = 1.1\n[liner]\nthickness_mm = [3.0, 9.0]\n"
    )
    people = People(trial)
    drawn = [people.draw(number).inputs for number in range(1, 257)]
    stiffness = np.log([one["muscle.c_kPa"] for one in drawn])
    prior = PRIORS["muscle"]["c_kPa"]
    assert stiffness.mean() == pytest.approx(np.log(prior["median"]), abs=0.03)
    assert stiffness.std() == pytest.approx(np.log(prior["factor"]), rel=0.05)
    assert np.log([one[WEIGHT] for one in drawn]).std() == pytest.approx(np.log(1.1), rel=0.05)
    liners = np.array([one[LINER] for one in drawn])
    assert 3.0 <= liners.min() < 3.2
    assert 8.8 < liners.max() <= 9.0


def test_a_person_is_an_ordinary_study(tmp_path):
    rule = '[[rules]]\nname = "tight"\n[rules.socket]\nreduction_percent = 5.0\n'
    people = People(load(tmp_path, PHANTOM + rule + "[person.socket]\nedge_mm = 20.0\n"))
    person = people.draw(1)
    limb = people.build_limb(person, tmp_path / "one")
    study = people.write_study(person, people.trial.rules[0], limb, tmp_path / "one" / "tight")
    assert (study.socket.reduction_percent, study.socket.edge_mm) == (5.0, 20.0)
    assert study.socket.body_weight_N == pytest.approx(person.inputs["body weight (N)"], abs=0.01)
    values = people.choose_parameters(person, study)
    assert values["muscle"]["c_kPa"] == person.inputs["muscle.c_kPa"]
    assert values["muscle"]["tau_s"] == study.material.get("muscle", "start")["tau_s"]
    # The skin's points that correspond lie on the skin.
    far = np.abs(limb.surfaces["skin"].signed_distance(limb.skin_points))
    assert far.max() < 1.0


def test_a_key_that_no_study_has_is_named(tmp_path):
    people = People(load(tmp_path, PHANTOM + "[person.socket]\nedge = 20.0\n"))
    limb = people.build_limb(people.draw(1), tmp_path / "one")
    with pytest.raises(StudyError, match=r"socket\.edge: unknown key"):
        people.write_study(people.draw(1), people.trial.rules[0], limb, tmp_path / "one" / "a")


@pytest.mark.slow
def test_a_limb_whose_bone_comes_too_near_to_the_skin_is_refused(tmp_path):
    load(tmp_path, PHANTOM + "least_tissue_mm = 15.0\n")
    with pytest.raises(InputError, match=r"none of the first 3 people can be simulated.*to the skin"):
        limbfit.check_trial(tmp_path)


def test_scores_of_modes_are_normal_and_cut_off(tmp_path):
    from_limits = np.array([1e-9, 0.5, 1 - 1e-9])
    source = limbfit.population.limbs.ModelLimbs.to_inputs(None, from_limits)
    np.testing.assert_allclose(source, [-FARTHEST, 0.0, FARTHEST], atol=1e-5)


def test_a_trial_without_people_says_so(tmp_path):
    load(tmp_path, PHANTOM)
    assert limbfit.count_people(tmp_path)["people"] == 0
    with pytest.raises(InputError, match="nobody was simulated yet"):
        limbfit.report_population(tmp_path)
    assert json.dumps(limbfit.count_people(tmp_path))
