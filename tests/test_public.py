"""The public names exist, and the light part of the package stays light."""

import ast
import subprocess
import sys
import tomllib
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

import limbfit
from limbfit.shapes import SHAPES


def test_all_public_names_exist():
    for name in limbfit.__all__:
        assert getattr(limbfit, name) is not None
    assert set(limbfit.__all__) <= set(dir(limbfit))


def test_type_checkers_see_every_public_name_at_its_home():
    """A home that finds its names lazily has no types; `Any` would pass every check of a user."""
    for name, home in limbfit._HOME.items():
        source = find_spec(f"limbfit.{home}").origin
        assert "__getattr__" not in Path(source).read_text(encoding="utf-8"), f"{name} from {home}"


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        limbfit.nonsense  # noqa: B018


def test_version_is_that_of_the_project():
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text())
    assert limbfit.__version__ == project["project"]["version"]
    assert f"\nversion: {limbfit.__version__}\n" in (root / "CITATION.cff").read_text()
    assert f"\n## [{limbfit.__version__}] - " in (root / "CHANGELOG.md").read_text()


def test_the_solver_loads_without_images_and_pictures():
    """Worker processes that only solve start quickly."""
    heavy = ("pyvista", "SimpleITK", "matplotlib")
    code = f"import sys, limbfit.indentation; print([m for m in {heavy} if m in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"


SCRIPTS = [
    path
    for folder in ("benchmarks", "examples")
    for path in sorted((Path(__file__).parents[1] / folder).rglob("*.py"))
]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_what_benchmarks_and_examples_import_exists(script):
    for node in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "limbfit":
            module = import_module(node.module)
            for name in node.names:
                known = hasattr(module, name.name) or find_spec(f"{node.module}.{name.name}")
                assert known, f"{script.name}:{node.lineno}: {node.module} has no {name.name}"


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        ("limbfit.execution", "placed", "place_jobs"),
        ("limbfit.execution", "sharing", "share_executor"),
        ("limbfit.indentation", "clamped", "clamp_problem"),
        ("limbfit.fe.tractions", "tractions", "compute_tractions"),
    ],
)
def test_documented_names_that_became_others_keep_working(module, old, new):
    room = import_module(module)
    with pytest.warns(FutureWarning, match=f"{old} is now called {new}"):
        assert getattr(room, old) is getattr(room, new)
    with pytest.raises(AttributeError, match="nothing"):
        room.nothing  # noqa: B018


def test_the_former_name_of_a_shape_in_words_keeps_working():
    sphere, settings = SHAPES["sphere"], {"width_mm": 10}
    with pytest.warns(FutureWarning, match="said is now called describe"):
        assert sphere.said(settings) == sphere.describe(settings)
