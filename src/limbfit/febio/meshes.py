"""Mesh, named sets and domains of a FEBio input."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from ..fe import Problem
from .faceting import Body, ToolMesh
from .moving import HELD, row

# FEBio's names of limbfit's elements; hex8 with an uncoupled material is three-field by itself.
QUADRATURE = {"tet4": "", "tet10": "TET10G4", "tet10p0": "TET10G4", "tet10g8": "TET10G8", "hex8": ""}
_FACE = {3: "tri3", 4: "quad4", 6: "tri6"}


def mesh_lines(problem: Problem, bodies: list[Body], meshes: dict[str, ToolMesh]) -> Iterator[str]:
    """The mesh of the tissue and those of rigid bodies by name, with all sets, surfaces and pairs."""
    mesh = problem.mesh
    firsts = np.cumsum([len(mesh.points), *(len(rigid.points) for rigid in meshes.values())])
    yield '<Mesh><Nodes name="all">'
    for i, point in enumerate(np.vstack([mesh.points, *(rigid.points for rigid in meshes.values())]), 1):
        yield f'<node id="{i}">{row(point)}</node>'
    yield "</Nodes>"
    number = 1
    for r, name in enumerate(mesh.region_names):
        cells = mesh.cells[mesh.regions == r]
        yield from _elements(name, mesh.cell_type, cells, number)
        number += len(cells)
    for (name, rigid), first in zip(meshes.items(), firsts):
        yield from _elements(name, rigid.cell_type, rigid.cells + first, number)
        number += len(rigid.cells)
    sets = {HELD: problem.fixed, **mesh.node_sets}
    sets |= {f"support_{i}": support.nodes for i, support in enumerate(problem.supports, 1)}
    for name, nodes in sets.items():
        if len(nodes):
            yield f"<NodeSet name={quoteattr(name)}>{_ids(nodes)}</NodeSet>"
    named = {  # FEBio makes an element set of every part
        f"{name}_surface" if name in mesh.region_names else name: faces
        for name, faces in mesh.face_sets.items()
    }
    surfaces = {body.patch: body.faces for body in bodies}
    surfaces |= {body.front: body.tool.front + first for body, first in zip(bodies, firsts)}
    surfaces |= {f"pressed_{i}": np.asarray(one.faces) for i, one in enumerate(problem.pressures, 1)}
    for name, faces in {**surfaces, **named}.items():
        yield from _surface(name, faces)
    for body in bodies:
        yield f"<SurfacePair name={quoteattr(body.pair)}><primary>{body.patch}</primary>"
        yield f"<secondary>{body.front}</secondary></SurfacePair>"
    yield "</Mesh>"


def _elements(name: str, cell_type: str, cells: NDArray[np.int64], first: int) -> Iterator[str]:
    yield f"<Elements type={quoteattr(cell_type)} name={quoteattr(name)}>"
    for i, cell in enumerate(cells, first):
        yield f'<elem id="{i}">{_ids(cell)}</elem>'
    yield "</Elements>"


def _surface(name: str, faces: NDArray[np.int64]) -> Iterator[str]:
    kind = _FACE[faces.shape[1]]
    yield f"<Surface name={quoteattr(name)}>"
    for i, face in enumerate(faces, 1):
        yield f'<{kind} id="{i}">{_ids(face)}</{kind}>'
    yield "</Surface>"


def domain_lines(problem: Problem, meshes: dict[str, ToolMesh]) -> Iterator[str]:
    """How the parts are discretised."""
    rule = QUADRATURE[problem.formulation.name]
    given = f' elem_type="{rule}"' if rule else ""
    if problem.formulation.name == "tet10p0":  # one volume ratio and pressure per element
        given += ' type="three-field-solid"'
    yield "<MeshDomains>"
    for name in problem.mesh.region_names:
        yield f"<SolidDomain name={quoteattr(name)} mat={quoteattr(name)}{given}/>"
    for name, rigid in meshes.items():
        names = f"name={quoteattr(name)} mat={quoteattr(name)}"
        if rigid.cell_type == "hex8":
            yield f"<SolidDomain {names}/>"
        else:
            yield f"<ShellDomain {names}><shell_thickness>0.01</shell_thickness></ShellDomain>"
    yield "</MeshDomains>"


def _ids(nodes: Iterable[int]) -> str:
    return ",".join(str(int(node) + 1) for node in nodes)
