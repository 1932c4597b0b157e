"""The writers of enhanced DICOM, DICOM-SEG and RTSTRUCT, which are the benchmarks'."""

import sys
from pathlib import Path

from limbfit.anatomy.imaging import Volume
from limbs import write_dicom

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from damage import Whole
from damage_enhanced import write_enhanced
from damage_labels import write_rtstruct, write_seg

__all__ = ["enhanced", "write_rtstruct", "write_seg"]


def enhanced(folder: Path, image: Volume, order: list[int], **changes: object) -> Path:
    """The folder of an image as one enhanced MR file, its frames in the given order."""
    write_dicom(folder / "single" / "mri", image)
    (folder / "many").mkdir()
    whole = Whole(folder / "single", image, None, None)  # type: ignore[arg-type]
    return write_enhanced(folder / "many", whole, order, **changes).parent
