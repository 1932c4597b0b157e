"""The Python files that docs/extending.md shows, and a small study that is identified with one of them."""

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from layered import blocks_study, store_blocks
from limbfit.execution import Limits, make_executor
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.identification.calibrate import run_calibrate

GUIDE = Path(__file__).parents[1] / "docs" / "extending.md"
BLOCKS = {"a": ((3.0, 5.0), 2.2, True), "b": ((3.0, 21.0), 6.0, True)}  # thicknesses, depth
TEXT = """
[study]
name = "blocks"
extensions = {extensions}
[surfaces]
skin = "skin.stl"
[solver]
load_steps = 4
unload_steps = 3
penalty_per_mm = 100.0
[mesh]
element = "tet10"
[mesh.coarse]
edge_near_mm = 6.0
[calibration]
tied = {tied}
"""


def from_the_guide(word: str, file: Path) -> Path:
    """``file``, written with the one block of Python that holds ``word``."""
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = [block for block in blocks if word in block]
    file.write_text(code, encoding="utf-8")
    return file


def identified(
    folder: Path, extension: Path | None, stated: str, truth: Mapping[str, float], within: float
) -> dict[str, Any]:
    """The calibration of two blocks whose tissues are one, in a study with more stated, or an extension.

    Of records with known truth and noise, simulated by worker processes that load the study's file.  The
    answer must be the truth, ``within`` a share of it, and the intervals must hold it.
    """
    if extension is not None:
        shutil.copy(extension, folder / extension.name)
    tied = [[f"{tissue}.{key}" for tissue in ("skin", "muscle")] for key in truth]
    text = TEXT.format(extensions=[extension.name] if extension else [], tied=tied) + stated
    study = blocks_study(folder, text, dict.fromkeys(BLOCKS, True))
    store = store_blocks(study, BLOCKS, {tissue: dict(truth) for tissue in study.tissues}, 4, coarse=4)
    store["calibrate"].mkdir()
    with make_executor(2, Limits(0.0, 0.0)) as executor:
        run_calibrate(Context(study, store, executor, lambda event: None), store["calibrate"])
    found: dict[str, Any] = store.results.calibration.to_plain()
    last, known = found["stages"][-1], found["uncertainty"]["intervals_95"]
    assert last["converged"], last["reason"]
    assert last["iterations"][-1]["error_percent"] < 1.0
    for tissue in study.tissues:
        assert last["parameters"][tissue] == pytest.approx(truth, rel=within)
        for key, value in truth.items():
            low, high = known[tissue][key]
            assert low < value < high, (tissue, key)
    return found
