"""FEBio's stored results, which lie beside the repository, or not."""

from pathlib import Path

import pytest

REFERENCE = Path(__file__).parents[2] / "shared" / "reference"
recorded = pytest.mark.skipif(
    not REFERENCE.is_dir(), reason="the FEBio reference results are not beside the repository"
)
