"""A function of a module begins with a verb, or converts one thing to another; a class is a noun."""

import ast
import re
from functools import cache
from pathlib import Path

import limbfit

PACKAGE = Path(limbfit.__file__).parent
VERBS = frozenset(
    """
acquire adapt add advance amputate announce append apply approach approximate assemble assess assign
average balance batch begin bench bisect build bump calibrate call cap change check choose clamp
classify clean clear close coarsen code collect combine compare compile compress compute
connect constrain continue convert convolve copy correct count couple create cross curve cut decode
deform delay demo derive describe design diagnose die dilate divide do draw drop edit equilibrate
erode estimate evaluate expand explain explore export extend extract extrapolate extrude fail fill find
finish fit flatten follow format from generate get grade group grow guess has hold ignore import impose
improve insert interpolate interpret interrupt intersect invert is iterate join judge keep
label level limit link list listen load locate lock log lump main make mark match measure mend merge
mesh minimise mix move multiply mute name normalise number observe open optimise orient outline pack
paint pair parse place plan plot pool post predict prefetch prepare press preview print
prioritise project prolong prompt pull rank rasterise read record recover rectify redact reduce refactor
refine refit refuse register regularise release remesh remove render renew repair replace report
reproduce resample rescale resolve respond restate restrict resume rotate round run sample save scale
schedule search segment select send serve set share shorten show silence simulate smooth snap solve
split spread stack start state step stop store sum summarise take tell temper test thicken thin time to
touch transfer translate triangulate trim try turn unpack untangle update vary voxelise walk warm warn
watch weigh whiten widen wrap write
    """.split()  # noqa: SIM905
)
PREDICATES = frozenset({"is", "has", "can", "are", "prefers"})
# Functions that are named by what they are, and why.
EXCEPTIONS = {
    "cli/": "a command's function has the command's name",
    "fe/kernel/": "compiled formulas have the name of what they compute, as in a textbook",
    "fe/contact/": "compiled formulas",
    "fe/lanes.py": "compiled arithmetic",
    "fe/materials/": "laws and their formulas",
    "fe/solution/multigrid.py": "compiled sweeps",
    "fe/solution/sensitivity.py": "compiled formulas",
    "shapes/": "compiled distances, and names that users import",
    "mesh/cells.py": "shape functions",
    "mesh/volume.py": "names that users import",
    "notebook.py": "names that users import",
    "fe/problem.py": "a name that users import",
    "fields.py": "names that users import",
    "pipeline/commands/acquire.py": "names that users import",
    "pipeline/commands/run.py": "names that users import",
    "priors/__init__.py": "a constructor",
}


@cache
def functions() -> list[tuple[str, str]]:
    """File below the package and name of each function that stands at the top of a module."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE).as_posix()
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("__"):
                found.append((file, node.name))
    return found


def begins_with_a_verb(name: str) -> bool:
    first = name.lstrip("_").split("_")[0]
    return first in VERBS | PREDICATES or first == "with" or "_to_" in name


def test_functions_begin_with_a_verb():
    wrong = [
        f"{file}: {name}"
        for file, name in functions()
        if not begins_with_a_verb(name) and not any(file.startswith(place) for place in EXCEPTIONS)
    ]
    assert not wrong, "\n".join(wrong)


def test_every_exception_is_needed():
    odd = {file for file, name in functions() if not begins_with_a_verb(name)}
    assert [place for place in EXCEPTIONS if not any(file.startswith(place) for file in odd)] == []


def test_the_list_of_verbs_holds_no_spare_word():
    first = {name.lstrip("_").split("_")[0] for _, name in functions()}
    assert sorted(VERBS - first) == []


# No class ends and no function or method begins with one of these; a property may be an adjective, as keys of
# what is stored are.
PARTICIPLES = frozenset(
    """
    begun bent broken chosen done drawn driven frozen given gone grown hidden kept known left lost made seen
    sent shown sunk taken told torn understood worn written
    """.split()  # noqa: SIM905
)
PREPOSITIONS = frozenset(
    """
    above across after along among around at before behind below beside between beyond by during from in
    inside into near of off on outside over through towards under until upon within without
    """.split()  # noqa: SIM905
)
ADJECTIVES = frozenset(
    """
    alike blunt deaf each explicit first flat hollow interactive last lower plain plausible single straight
    suspect uncoupled upper upright vain whole
    """.split()  # noqa: SIM905
)
NOUNS_AND_VERBS = frozenset({"feed", "need", "ring", "speed", "spring", "string", "warning"})
NOT_NOUNS = {
    "Coupling": "a noun of mechanics",
    "Finding": "a noun: what was found",
    "LayerThinning": "a noun: how much thinner a layer is",
    "Painting": "a noun: what was painted",
    "Recording": "a noun: what was recorded",
    "RegionFitted": "limbfit schema and docs/results.md show it",
    "RelaxationBeyond": "limbfit schema and docs/results.md show it",
    "ShareOver": "limbfit schema and docs/results.md show it",
    "SocketDesigned": "limbfit schema and docs/results.md show it",
    "TissueStrainInside": "limbfit schema and docs/results.md show it",
    "Uncoupled": "FEBio's term for such laws; extensions derive theirs from it",
    "_Crossing": "a noun: where a line crosses a face",
}
NOT_VERBS = {
    "at": "the value at a time or point: users call that of History, Motion and Pressure",
    "by_tissue": "users call it of Study",
    "coupling": "a noun of mechanics",
    "_coupling": "a noun of mechanics",
    "grown": "users call it of SmoothSurface",
    "in_solver_units": "users call it of TissueLaw",
    "of": "a constructor: users call that of Motion, Shape and SmoothSurface",
    "of_record": "users call it of TissueLaw",
    "of_tissues": "a constructor",
    "recording": "a command",
    "revolved": "users import it",
    "scaling": "a command",
    "waiting": "users import it",
}


def is_no_head(word: str) -> bool:
    """Neither a noun nor a verb."""
    regular = re.fullmatch("[a-z]+(ed|ing)", word) and word not in NOUNS_AND_VERBS
    return bool(regular) or word in PARTICIPLES | PREPOSITIONS | ADJECTIVES


def is_property(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any(ast.unparse(one).endswith("property") for one in node.decorator_list)


@cache
def definitions() -> tuple[dict[str, str], dict[str, str]]:
    """File of each class, and of each function and method that is no property, of all depths, by name."""
    classes, called = dict[str, str](), dict[str, str]()
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE).as_posix()
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef):
                classes[node.name] = file
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not is_property(node):
                called[node.name] = file
    return classes, called


def find_not_nouns() -> set[str]:
    return {name for name in definitions()[0] if is_no_head(re.findall("[A-Z][a-z0-9]*", name)[-1].lower())}


def find_not_verbs() -> set[str]:
    """Those of one word, or that begin with a preposition: an adjective before a noun is a measure's name."""
    words = {name: name.strip("_").split("_") for name in definitions()[1]}
    return {
        name
        for name, (first, *more) in words.items()
        if first in PREPOSITIONS - {"from"} or (not more and is_no_head(first) and first not in VERBS)
    }


def test_classes_are_nouns():
    assert sorted(find_not_nouns() - NOT_NOUNS.keys()) == []


def test_methods_are_no_participles_adjectives_or_prepositions():
    assert sorted(find_not_verbs() - NOT_VERBS.keys()) == []


def test_every_exception_to_the_parts_of_speech_is_needed():
    assert sorted(NOT_NOUNS.keys() - find_not_nouns()) == []
    assert sorted(NOT_VERBS.keys() - find_not_verbs()) == []
