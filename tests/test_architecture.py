"""The house rule: arrows point down only, and no import hides inside a function."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import limbfit

PACKAGE = Path(limbfit.__file__).parent
# From the top floor to the ground; a room may import only rooms that stand below it.
FLOORS = [
    {"__main__"},
    {"cli"},
    {"studio", "population"},
    {"pipeline"},
    {"bench"},
    {"report", "phantom"},
    {"indentation", "notebook", "acquire"},
    {"study", "febio", "fields", "donning"},
    {"socket"},
    {"identify", "execution", "traces", "anatomy", "fe", "web"},
    {"mesh", "phases", "autoregressive", "laws", "shapes", "priors"},
    {"extensions", "relaxation", "results"},
    {"errors", "arrays", "folders", "renamed", "_version"},
]
HEIGHT = {room: -level for level, rooms in enumerate(FLOORS) for room in rooms}
# Floors inside a room, from the top; "" is what stands in the room's own folder.
INNER_FLOORS = {
    "anatomy": ["imaging", "meshing", "sites", "segmentation", "surfaces", "labels", "images", ""],
    "fe": ["__init__", "solution", "", "contact", "kernel", "materials", "lanes"],
    "identify": ["__init__", "checks", "uncertainty", "fit"],
    "pipeline": [
        "__init__",
        "commands",
        "design uncertainty variants",
        "identification",
        "socket",
        "records",
        "simulation",
        "limb",
        "engine",
    ],
    "report": ["__init__ build", "sections", "drawing", "page store tables formats words"],
}
# ``report`` reads stored results only; ``phantom`` makes inputs: neither may know the other.


def room_of(module: str) -> str:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def module_name(path: Path) -> str:
    relative = path.relative_to(PACKAGE.parent).with_suffix("")
    parts = [p for p in relative.parts if p != "__init__"]
    return ".".join(parts)


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def list_statements(nodes: list[ast.stmt], inside: bool = False) -> Iterator[tuple[ast.stmt, bool]]:
    """Every statement below these, and whether it is inside a function."""
    for node in nodes:
        yield node, inside
        deeper = inside or isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        for field in ("body", "handlers", "cases", "orelse", "finalbody"):
            yield from list_statements(getattr(node, field, []), deeper)


@cache
def imports(path: Path) -> list[tuple[str, int, bool]]:
    """(absolute module, line, inside a function) of every limbfit import in a file."""
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    found = []
    for node, inside in list_statements(parse(path).body):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno, inside) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, node.module] if node.module else base)
            found += [(f"{stem}.{alias.name}", node.lineno, inside) for alias in node.names]
    return [entry for entry in found if entry[0].split(".")[0] == "limbfit"]


@cache
def files() -> list[Path]:
    return [p for p in sorted(PACKAGE.rglob("*.py")) if p != PACKAGE / "__init__.py"]


def test_every_room_has_a_floor():
    rooms = {room_of(module_name(path)) for path in files()}
    assert rooms <= set(HEIGHT), f"rooms without a floor: {sorted(rooms - set(HEIGHT))}"


def test_arrows_point_down():
    wrong = []
    for path in files():
        here = room_of(module_name(path))
        for target, line, _ in imports(path):
            there = room_of(target)
            if there in HEIGHT and there != here and HEIGHT[there] >= HEIGHT[here]:
                wrong.append(f"{path.relative_to(PACKAGE)}:{line} imports {target}")
    assert not wrong, "\n".join(wrong)


def inner_floor(room: str, parts: list[str]) -> int:
    """The floor of a module inside its room, counted from the ground; ``parts`` follow the room's name."""
    own = parts[0] if parts else "__init__"
    floors = [set(names.split()) for names in INNER_FLOORS[room]]
    level = next((k for k, names in enumerate(floors) if own in names), None)
    if level is None:
        assert set() in floors, f"{room}/{own} has no floor"
        level = floors.index(set())
    return -level


@pytest.mark.parametrize("room", sorted(INNER_FLOORS))
def test_arrows_point_down_inside_a_room(room):
    wrong = []
    modules = {module_name(path) for path in files()}
    for path in files():
        here = module_name(path).split(".")
        if here[1] != room:
            continue
        for target, line, _ in imports(path):
            while target not in modules:
                target = target.rpartition(".")[0]
            there = target.split(".")
            if there[1:2] != [room] or there[2:3] == here[2:3]:
                continue
            if inner_floor(room, there[2:]) > inner_floor(room, here[2:]):
                wrong.append(f"{path.relative_to(PACKAGE)}:{line} imports {target}")
    assert not wrong, "\n".join(wrong)


def test_corridors_are_short():
    """No folder has more than twenty doors."""
    counts = {}
    for path in files():
        counts[path.parent] = counts.get(path.parent, 0) + 1
    wide = {str(folder.relative_to(PACKAGE)): n for folder, n in counts.items() if n > 20}
    assert not wide, wide


def test_no_import_hides_in_a_function():
    hidden = [
        f"{path.relative_to(PACKAGE)}:{line} imports {target} inside a function"
        for path in files()
        for target, line, lazy in imports(path)
        if lazy
    ]
    assert not hidden, "\n".join(hidden)


def test_no_cycle_between_modules():
    modules = {module_name(path): path for path in files()}
    graph = {}
    for name, path in modules.items():
        targets = set()
        for target, _, _ in imports(path):
            while target and target not in modules:
                target = target.rpartition(".")[0]
            if target and target != name:
                targets.add(target)
        graph[name] = targets
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail[trail.index(name) :], name))
        if name not in done:
            for target in sorted(graph[name]):
                visit(target, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_only_the_command_line_prints_and_exits():
    wrong = []
    for path in files():
        if room_of(module_name(path)) in {"cli", "__main__"}:
            continue
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in {"print", "sys.exit", "exit"}:
                wrong.append(f"{path.relative_to(PACKAGE)}:{node.lineno}")
    assert not wrong, "\n".join(wrong)


def test_a_public_class_has_a_name_of_its_own():
    homes: dict[str, list[str]] = {}
    for path in files():
        for node in parse(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(module_name(path))
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}
