"""What others found where a socket presses, by region: to be read beside a result, without a verdict.

Only findings that the cited abstracts state. Pressures in kPa, which depend on sensor, socket and activity,
and thresholds of pain stand in the papers alone: no abstract gives them by region.
"""

import tomllib
from collections.abc import Collection
from pathlib import Path

from ..results.socket import PublishedFindings

WHOLE = "the limb"
_FILE = Path(__file__).with_name("published.toml")
FINDINGS = tuple(
    PublishedFindings(**row) for row in tomllib.loads(_FILE.read_text(encoding="utf-8"))["findings"]
)


def select_published_findings(regions: Collection[str]) -> list[PublishedFindings]:
    """The findings over any of the ``regions``, or over the whole limb, as they are stored."""
    return [
        finding.model_copy(update={"regions": covered})
        for finding in FINDINGS
        if (covered := [name for name in finding.regions if name in regions or name == WHOLE])
    ]
