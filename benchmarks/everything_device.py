"""Record a study's first site again, unattended, on a virtual FitSocket around another's simulated limb.

    python benchmarks/everything_device.py SIMULATED STUDY

For `everything.py`. The device's clock waits for limbfit, so that a busy machine does not stop the session.
The exit code is that of the device where it does not start, else that of ``limbfit acquire``.
"""

import argparse
import subprocess
import sys
import tomllib
from pathlib import Path

LIMBFIT = (sys.executable, "-m", "limbfit")
SPEED = "20"  # times real time


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("simulated", type=Path, help="study with stored simulations")
    parser.add_argument("study", type=Path, help="the one to record into")
    given = parser.parse_args()
    site = tomllib.loads((given.study / "study.toml").read_text(encoding="utf-8"))["sites"][0]["name"]
    words = (*LIMBFIT, "virtual-fitsocket", str(given.simulated), "--port", "0", "--speed", SPEED)
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as device:
        assert device.stdout is not None
        address = device.stdout.readline().strip().removeprefix("device: ")
        if not address:
            return device.wait()
        asked = ("acquire", str(given.study), "--site", site, "--unattended", "--again", "--device", address)
        code = subprocess.run((*LIMBFIT, *asked)).returncode
        device.terminate()
    return code


if __name__ == "__main__":
    sys.exit(main())
