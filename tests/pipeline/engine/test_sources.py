"""What decides a stage is the import closure of its code, with templates, scripts and styles, and no more."""

import inspect
import json
import os
import shutil
import subprocess
import sys
from importlib import import_module
from types import ModuleType

import pytest

from limbfit.indentation import simulate
from limbfit.pipeline.commands.experiments import EXPERIMENTS
from limbfit.pipeline.commands.run import STAGES
from limbfit.pipeline.engine.digests import PACKAGE, find_sources, format_source

RUNS = {stage.name: stage.run for stage in (*STAGES, *EXPERIMENTS)} | {"simulation": simulate}


def names(of: str) -> set[str]:
    return {format_source(file) for file in find_sources(RUNS[of])}


def used_by(module: ModuleType) -> set[str]:
    """The modules of limbfit whose objects a loaded module holds."""
    found = set()
    for value in vars(module).values():
        name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
        own = isinstance(value, ModuleType) and str(name).startswith(f"{module.__name__}.")
        if own:  # a package has every module in it that anybody loaded
            continue
        if isinstance(name, str) and name.startswith("limbfit."):
            home = import_module(name)
            if not hasattr(home, "__path__"):  # a package only hands on
                found.add(str(inspect.getfile(home)))
    return found


@pytest.mark.parametrize("name", RUNS)
def test_what_a_module_uses_is_in_the_closure(name):
    """The objects of the loaded modules, found without reading any import."""
    files = find_sources(RUNS[name])
    modules = [file for file in files if file.suffix == ".py" and not file.stem.endswith("_worker")]
    for file in modules:
        parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
        missing = used_by(import_module(".".join(parts).removesuffix(".__init__"))) - set(map(str, files))
        assert not missing, f"{format_source(file)} uses {missing}"


def test_it_is_no_wider():
    def within(name: str, *rooms: str) -> set[str]:
        return {file for file in names(name) if file.startswith(rooms)}

    mechanics = ("fe/", "identify/", "indentation", "report/", "phantom/")
    assert within("segment", *mechanics, "traces/", "anatomy/meshing") == {"report/drawing/sheet.py"}
    amputation = {f"anatomy/segmentation/{part}.py" for part in ("__init__", "amputation")}
    for name in ("surfaces", "sites", "mesh"):
        assert within(name, *mechanics, "anatomy/segmentation") <= amputation
    assert not within("sites", "anatomy/meshing")
    assert not within("traces", "anatomy/", "report/", "phantom/")
    assert not within("calibrate", "report/", "phantom/", "anatomy/segmentation")
    assert not within("simulation", "anatomy/", "identify/", "pipeline/", "report/", "traces/")
    assert not any(within(name, "studio/", "cli/", "__init__") for name in RUNS)


def test_it_holds_what_lists_by_hand_forgot():
    assert "identify/fit/parameters.py" in names("design")
    assert "mesh/cells.py" in names("cube")
    web = {"web/static/viewer.js", "web/static/web.css", "web/static/vendor/three.min.js"}
    assert web | {"report/templates/report.css", "report/templates/blocks.html.j2"} <= names("report")
    assert "anatomy/meshing/_worker.py" in names("mesh")


DIGESTS = """
import json
from limbfit.pipeline.commands.experiments import EXPERIMENTS
from limbfit.pipeline.commands.run import STAGES
from limbfit.pipeline.engine.digests import code_digest
print(json.dumps({stage.name: code_digest(stage.run) for stage in (*STAGES, *EXPERIMENTS)}))
"""


@pytest.mark.slow
def test_a_changed_file_changes_what_it_decides_and_nothing_else(tmp_path):
    big = shutil.ignore_patterns("__pycache__", "niivue*")
    copy = shutil.copytree(PACKAGE, tmp_path / "limbfit", ignore=big)

    def digests() -> dict[str, str]:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        found = subprocess.run(
            [sys.executable, "-c", DIGESTS], env=environment, capture_output=True, text=True, check=True
        )
        return json.loads(found.stdout)

    def changed_by(name: str, line: str) -> set[str]:
        before = digests()
        with (copy / name).open("a") as stream:
            stream.write(line)
        return {stage for stage, value in digests().items() if value != before[stage]}

    assert changed_by("report/templates/report.css", "/* */\n") == {"report", "cube"}
    meshed = changed_by("anatomy/meshing/improving.py", "\n# a remark\n")
    assert meshed >= {"mesh", "calibrate"}  # a calibration corrects its answer by coarser meshes of its own
    assert not meshed & {"segment", "surfaces", "sites", "traces", "predict", "report"}
