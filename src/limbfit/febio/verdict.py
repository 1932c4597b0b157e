"""What FEBio says of its own end: the verdict over one run, from its exit, its messages and its log."""

from __future__ import annotations

import re
from dataclasses import dataclass

NORMAL, ERROR = "N O R M A L   T E R M I N A T I O N", "E R R O R   T E R M I N A T I O N"
KINDS = ("normal", "partial", "error", "input", "killed", "time limit", "no output", "crashed")
_VERSION = re.compile(r"^\s*version\s+(\d+(?:\.\w+)+)", re.MULTILINE)
_CONVERGED = re.compile(r"------- converged at time : ([-+.\deE]+)")
_FAILED = re.compile(r"------- failed to converge at time : ([-+.\deE]+)")
_BOX = re.compile(r"^ \*+\n \*\s+(?:FATAL )?ERROR\s+\*\n((?: \*.*\n?)+)", re.MULTILINE)
SLACK = 1e-5  # of the end time: FEBio prints six digits, 10.0223 for 10.022314


@dataclass(frozen=True)
class RunVerdict:
    """``kind`` is one of `KINDS`; ``reason`` one line for the user, empty where all went well.

    ``reached_s`` is the last time that converged; ``version`` that of FEBio, empty where it did not say.
    """

    kind: str
    reason: str
    reached_s: float
    version: str

    @property
    def completed(self) -> bool:
        return self.kind == "normal"


def judge(
    messages: str, exit_code: int, end_s: float, *, timed_out: bool = False, limit_s: float = 0.0
) -> RunVerdict:
    """The verdict over a run.

    Parameters
    ----------
    messages : what FEBio wrote on standard output (its log file says the same).
    exit_code : of the process; negative or above 128 for a signal.
    end_s : time that the input asks for.
    timed_out, limit_s : whether, and after how many seconds, it was stopped by the time limit.
    """
    found = _VERSION.search(messages)
    version = found.group(1) if found else ""
    times = [float(t) for t in _CONVERGED.findall(messages)]
    reached = times[-1] if times else 0.0
    kind, what = _kind(messages, exit_code, reached, end_s, timed_out, limit_s)
    if kind == "normal":
        return RunVerdict(kind, "", reached, version)
    where = "" if kind in ("input", "no output") else f" at {reached:.4g} s of {end_s:.4g} s"
    return RunVerdict(kind, f"FEBio {what}{where}{_cause(messages, kind)}", reached, version)


def _kind(
    messages: str, exit_code: int, reached: float, end_s: float, timed_out: bool, limit_s: float
) -> tuple[str, str]:
    signal = -exit_code if exit_code < 0 else exit_code - 128
    if timed_out:
        return "time limit", f"was stopped by the time limit of {limit_s:g} s"
    if re.search(r"^Reading file .*FAILED!", messages, re.MULTILINE):
        return "input", "could not read its input"
    if ERROR in messages:
        return "error", "stopped with an error" + ("" if exit_code else ", though it left with exit code 0")
    if 0 < signal < 65:
        memory = ", most often for lack of memory" if signal == 9 else ""
        return "killed", f"was killed by signal {signal}{memory},"
    if exit_code != 0:
        return "crashed", f"left with exit code {exit_code} without a message,"
    if not messages.strip():
        return "no output", "wrote nothing"
    if NORMAL not in messages:
        return "crashed", "ended without a verdict,"
    if reached < end_s * (1.0 - SLACK):
        return "partial", "ended, but stopped early,"
    return "normal", ""


def _cause(messages: str, kind: str) -> str:
    """The last error that FEBio framed, and where it did not converge."""
    if kind not in ("error", "input", "crashed"):
        return ""
    boxes = _BOX.findall(messages)
    lines = [line.strip(" *") for line in boxes[-1].split("\n")] if boxes else []
    words = " ".join(" ".join(lines).split()).rstrip(".")
    failed = _FAILED.findall(messages)
    parts = [words] if words else []
    if kind != "input" and failed:
        parts.append(f"no convergence at {float(failed[-1]):.4g} s")
    return ": " + "; ".join(parts) if parts else ""
