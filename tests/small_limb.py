"""A small limb with one bone as a study of surfaces, for tests of sockets."""

from pathlib import Path

from bodies import limb, revolved
from limbfit.anatomy.surfaces.surfaces import write_surface

LIMB = """
[study]
name = "small limb"
[surfaces]
skin = "skin.stl"
bones = { tibia = "tibia.stl" }
[geometry]
proximal_cut = { point = [12.0, -80.0, 300.0], normal = [0.0, 0.0, 1.0] }
[[sites]]
name = "1"
position = [46.0, -80.0, 290.0]
depth_mm = 3.0
[socket]
trim_mm = 20.0
edge_mm = 14.0
distal_clearance_mm = 3.0
"""

__all__ = ["limb", "revolved", "small_limb"]


def small_limb(folder: Path, text: str, edge_mm: float = 14.0) -> Path:
    """Write the limb into a folder, and a study whose table ``[socket]`` goes on with ``text``.

    ``edge_mm``: of its mesh under the socket.
    """
    anatomy = limb()
    write_surface(folder / "skin.stl", anatomy.skin)
    write_surface(folder / "tibia.stl", anatomy.bones["tibia"])
    stated = LIMB.replace("edge_mm = 14.0", f"edge_mm = {edge_mm}")
    (folder / "study.toml").write_text(stated + text)
    return folder
