"""How long does a reference case of a socket take, and FEBio beside it on the same threads?

    python benchmarks/socket_febio.py --case cone cone-load --threads 2 --beside-febio --json socket.json

limbfit runs FEBio's inputs of ``shared/reference/socket`` with FEBio's steps and contact, as ``limbfit bench
febio-parity`` does, without compilation; then FEBio itself does (its program: FEBIO_CMD, or on the path).
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from limbfit.bench.parity import SOCKET, find_reference
from limbfit.bench.timing import time_febio
from limbfit.execution import count_usable_cores
from limbfit.febio import find_febio, run_feb


def time_input(file: Path, threads: int) -> dict[str, Any]:
    """Seconds and steps of a FEBio input on limbfit's solver; kernels are compiled before."""
    with tempfile.TemporaryDirectory(prefix="limbfit-bench-") as out:
        run_feb(file, out, times=(0.01,), threads=threads)  # compiles by one small step
        result = run_feb(file, out, threads=threads).result
    kept = ("unknowns", "steps", "newton_iterations", "factorisations")
    return {
        **{key: result.statistics[key] for key in kept},
        "seconds": result.statistics["seconds"]["total"],
        "reason": result.reason,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", nargs="+", default=["cone"], choices=[case.name for case in SOCKET])
    parser.add_argument("--reference", type=Path, help="folder of FEBio's results; default: shared/reference")
    parser.add_argument("--threads", type=int, default=count_usable_cores(), help="that each of both has")
    parser.add_argument("--beside-febio", action="store_true", help="run FEBio itself afterwards")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    program, rows = find_febio() if asked.beside_febio else None, []
    reference = asked.reference or find_reference(Path.cwd())
    for case in asked.case:
        file = reference / "socket" / f"{case}.feb"
        row = {"case": case, "threads": asked.threads, **time_input(file, asked.threads)}
        words = f"{case}: {row['unknowns']} unknowns, {row['steps']} steps, limbfit {row['seconds']:.1f} s"
        if program is not None:
            row["febio_seconds"] = time_febio(program, reference, f"socket/{case}", asked.threads)
            row["ratio"] = row["febio_seconds"] / row["seconds"]
            words += f", FEBio {row['febio_seconds']:.1f} s: {row['ratio']:.1f} times as long"
        print(words, row["reason"])
        rows.append(row)
    if asked.json is not None:
        asked.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
