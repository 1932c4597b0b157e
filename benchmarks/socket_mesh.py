"""How far do the pressures in a socket depend on the limb's mesh?

    python benchmarks/socket_mesh.py patient --edges 16 12 10 --json socket-mesh.json

Runs ``limbfit socket`` on a study with several ``socket.edge_mm``, and tells by how much regional means, the
peak and the settling differ from those of the finest mesh, with the time of each.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import limbfit


def run(study: limbfit.Study, edge_mm: float) -> dict[str, Any]:
    """The study's socket on a limb with edges of ``edge_mm``."""
    started, cpu = time.perf_counter(), time.process_time()
    table = study.socket.model_copy(update={"edge_mm": edge_mm})
    found = limbfit.fit_socket(study.model_copy(update={"socket": table}), listener=print)
    load = found["loads"][-1]
    return {
        "edge_mm": edge_mm,
        "unknowns": found["statistics"]["unknowns"],
        "iterations": found["statistics"]["newton_iterations"],
        "seconds": time.perf_counter() - started,
        "cpu_seconds": time.process_time() - cpu,
        "settling_mm": load["settling_mm"],
        "peak_kPa": load["peak_kPa"],
        "means_kPa": {row["region"]: row["mean_kPa"] for row in load["regions"]},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("--edges", type=float, nargs="+", default=[16.0, 12.0, 10.0])
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    study = limbfit.load_study(asked.study)
    rows = [run(study, edge) for edge in sorted(asked.edges, reverse=True)]
    finest = rows[-1]
    largest = max(finest["means_kPa"].values())
    for row in rows:
        off = {
            name: abs(value - finest["means_kPa"].get(name, value)) / largest
            for name, value in row["means_kPa"].items()
        }
        row["mean_off_percent"] = 100.0 * sum(off.values()) / len(off)
        row["most_off_percent"], row["most_off"] = max((100.0 * share, name) for name, share in off.items())
        print(
            f"{row['edge_mm']:g} mm, {row['unknowns']} unknowns: {row['cpu_seconds']:.0f} CPU s, settled by "
            f"{row['settling_mm']:.2f} mm, peak {row['peak_kPa']:.0f} kPa, regional means within "
            f"{row['most_off_percent']:.1f} % of the largest ({row['most_off']})"
        )
    if asked.json is not None:
        asked.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
