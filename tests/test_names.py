"""Names tell what comes back: a function of a module begins with a verb, or converts one thing to another."""

import ast
from functools import cache
from pathlib import Path

import limbfit

PACKAGE = Path(limbfit.__file__).parent
VERBS = frozenset(
    """
acquire adapt add advance amputate announce append apply approach approximate assemble assess assign
average balance batch begin bench bisect build bump calibrate call cap change check choose clamp
classify clean clear clip close coarsen code collect combine compare compile compress compute
connect constrain continue convolve copy correct count couple create cross curve cut decode deform delay
demo derive describe design diagnose die dilate divide do draw drop edit embed
equilibrate erode estimate evaluate expand explain explore export extend extract extrapolate extrude
fail fill find finish fit flatten follow format from generate get grade group grow guess has hold ignore
import impose improve insert integrate interpolate interpret interrupt intersect invert is iterate join
judge keep label level limit link list listen load locate lock log lump main make mark match measure
mend merge mesh minimise mix move multiply mute name normalise number observe open optimise orient
outline pack paint pair parse place plan plot pool post predict prefetch prepare prepend press preview
print prioritise project prolong prompt pull rank rasterise read record recover rectify redact
reduce refactor refine refit refuse register regularise release remesh remove render renew repair
replace report reproduce resample rescale resolve respond restate restrict resume rotate round run
sample save scale schedule search segment select send serve set share shorten show silence simulate
smooth snap solve split spread stack start state step stop store sum summarise take tell temper
test thicken thin time to touch transfer translate triangulate trim try turn unpack untangle update vary
voxelise walk warm warn weigh whiten widen wrap write
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
