"""What the report and the studio show in a browser alike: arrays for scripts, shapes of limbs, scripts.

``static`` holds the scripts and style sheets, and below ``vendor`` the libraries they use (VENDOR.md).
Nothing here knows a study or a page.
"""

import base64
import hashlib
import re
from pathlib import Path

STATIC = Path(__file__).parent / "static"
_MODULE_LINES = re.compile(r"^import .*;\n|^export (?=(?:const|function|class|async) )", re.MULTILINE)


def read_asset(name: str) -> str:
    """The text of a file of ``static``, for example ``vendor/uPlot.min.css``."""
    return (STATIC / name).read_text(encoding="utf-8")


def build_inline_script(*names: str) -> str:
    """Scripts one after the other as one classic script, which needs no server.

    Modules lose their one-line imports and the word ``export``: what they name must be in an earlier file.
    Whatever would end a ``<script>`` element is refused.
    """
    text = "\n".join(_MODULE_LINES.sub("", read_asset(name)) for name in names)
    if re.search(r"</script|<!--", text, re.IGNORECASE):
        raise ValueError("a script must not hold what ends a script element")
    return text


def compute_integrity(script: str) -> str:
    """The source of a script in a content security policy: only this very text may run."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
