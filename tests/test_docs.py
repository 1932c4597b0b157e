"""The documentation points to what exists."""

import doctest
import re
import tomllib
from importlib import import_module
from pathlib import Path
from runpy import run_path

import pytest

import limbfit
from conftest import coarse_mesh, write_trace
from editing import append
from limbfit.pipeline.commands.experiments import EXPERIMENTS
from limbfit.study import Study

ROOT = Path(__file__).parents[1]
PACKAGE = Path(limbfit.__file__).parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]


def anchor(heading: str) -> str:
    """The anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def links(page: Path) -> list[str]:
    text = re.sub(r"```.*?```|<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not link.startswith("http")]


def leads_somewhere(page: Path, link: str) -> bool:
    target, _, fragment = link.partition("#")
    file = page.parent / target if target else page
    if not fragment:
        return file.exists()
    headings = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
    return fragment in [anchor(heading) for heading in headings]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    assert [link for link in links(page) if not leads_somewhere(page, link)] == []


def test_study_in_the_readme_is_valid() -> None:
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    study = Study(**tomllib.loads("\n".join(blocks)))
    assert [site.name for site in study.fitted] == ["1"]
    assert study.segmentation.labels == Path("corrected.seg.nrrd")


TYPES = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
HOMES = re.findall(r"^\| `(\w+)` \| `([\w.]+)` \|", TYPES, re.MULTILINE)


@pytest.mark.parametrize(("name", "home"), HOMES)
def test_the_main_types_live_where_the_table_says(name: str, home: str) -> None:
    assert getattr(import_module(f"limbfit.{home}"), name).__module__ == f"limbfit.{home}"


READING = (ROOT / "docs" / "reading.md").read_text(encoding="utf-8")
CHAPTERS = re.findall(r"^\| \d+ \| \[[\w ]+\]\(\S+\) \| `(\S+)` \| `(\w+)` \|", READING, re.MULTILINE)


@pytest.mark.parametrize(("file", "name"), CHAPTERS)
def test_a_chapter_of_the_reading_list_has_its_main_function(file: str, name: str) -> None:
    assert re.search(rf"^(def|class) {name}\b", (PACKAGE / file).read_text(encoding="utf-8"), re.MULTILINE)


def test_the_reading_list_is_short() -> None:
    assert len(CHAPTERS) == 12
    assert sum(len((PACKAGE / file).read_text(encoding="utf-8").splitlines()) for file, _ in CHAPTERS) < 3000


def test_the_first_changes_name_files_that_are_there() -> None:
    """Every path between backticks, below the package or the repository."""
    paths = re.findall(r"`([\w./]+(?:/|\.py|\.md)|tests/\w+)`", READING)
    assert len(paths) > 30
    assert [path for path in paths if not (PACKAGE / path).exists() and not (ROOT / path).exists()] == []


def test_pages_agree_on_where_a_corrected_segmentation_is_saved() -> None:
    for page in ("README.md", "docs/segmentation.md", "docs/getting-started.md"):
        text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
        assert "in place" in text
        assert "beside `study.toml` - not in" not in text


DOCTESTS = [
    ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
    for file in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in file.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("module", DOCTESTS)
def test_examples_in_docstrings_run(module: str) -> None:
    found = doctest.testmod(import_module(module))
    assert found.attempted
    assert not found.failed


def python_in(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("page", [f"docs/{page.name}" for page in PAGES if page.parent.name == "docs"])
def test_python_of_the_pages_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(EXPERIMENTS, "_added", {})  # no other test has this file
    for code in python_in(page):
        Path("example.py").write_text(code, encoding="utf-8")  # an experiment is in a file
        exec(compile(code, "example.py", "exec", dont_inherit=True), {"__name__": "example"})


def test_the_page_of_commands_is_what_they_say() -> None:
    """Made anew by  python docs/build_commands.py > docs/commands.md"""
    build_page = run_path(str(ROOT / "docs" / "build_commands.py"))["build_command_page"]
    assert (ROOT / "docs" / "commands.md").read_text(encoding="utf-8") == build_page()


def test_every_page_is_in_the_site() -> None:
    docs, parts = ROOT / "docs", ("index", "tutorials", "howto", "explanation", "reference")
    listed = [line for part in parts for line in (docs / f"{part}.md").read_text().splitlines()]
    pages = {str(page.relative_to(docs).with_suffix("")) for page in docs.rglob("*.md")}
    assert pages - {"index"} <= set(listed)


@pytest.mark.parametrize("part", ["tutorials", "howto", "explanation", "reference"])
def test_a_part_says_what_each_of_its_pages_is_for(part: str) -> None:
    text = (ROOT / "docs" / f"{part}.md").read_text(encoding="utf-8")
    landing, _, listed = text.partition("```{toctree}")
    for page in re.findall(r"^[\w/-]+$", listed, re.MULTILINE):
        assert re.search(rf"\]\({page}\.md\)(:| \| | and |.*\|)", landing), page


def test_every_public_name_is_in_the_reference() -> None:
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    named = set(re.findall(r"limbfit\.(\w+)", text)) | {"InputError", "LimbfitError", "__version__"}
    assert set(limbfit.__all__) <= named


FIXED = ["skin.m", "skin.gamma", "skin.tau_s", "muscle.m", "muscle.tau_s"]  # few samples are needed


def test_python_of_the_readme_runs(
    study: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a script, on a study that is small: from its inputs to its report."""
    settings = coarse_mesh(edge_near_mm=12.0).replace("load_steps = 4", "load_steps = 2")
    append(study, f"{settings}[calibration]\nmax_iterations = 1\nfixed = {FIXED}\n")
    for name in ("1.csv", "2.csv"):
        write_trace(study / name, rate=20.0)
    study.rename(study.parent / "patient")
    monkeypatch.chdir(study.parent)
    (code,) = python_in("README.md")
    Path("example.py").write_text(code, encoding="utf-8")
    run_path("example.py", run_name="__main__")
    assert Path("patient/results/report/report.html").is_file()
    assert "'state': 'done'" in capsys.readouterr().out
