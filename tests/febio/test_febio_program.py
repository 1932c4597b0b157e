"""How a run of FEBio ends, judged on what FEBio 4.11 itself left behind when it failed.

FEBio is not run here.  A script stands in its place as the program: it writes the recorded words and tables
of a real run and ends as that run ended.  No record of a run that ended well is kept, so the words for that
are made up from the others'.
"""

import stat
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from limbfit.bench.timing import build_punched_block
from limbfit.errors import InputError, ProblemError, RunError
from limbfit.fe import History
from limbfit.febio import RunVerdict, build_result, find_febio, judge_run, read_log, run_febio
from limbfit.febio.program import ERROR_TERMINATION, NORMAL_TERMINATION
from reference import REFERENCE, recorded

LOGS = REFERENCE / "febio-logs"
END = 12.708333333333334
VERDICTS = {
    "bad-material": ("input", 'could not read its input: tag "SolidDomain" (line 3625) : invalid value'),
    "broken-xml": ("input", "could not read its input: Unexpected end of file"),
    "missing-file": ("input", "Failed opening input file model.feb"),
    "diverges": ("error", "at 0 s of 12.71 s: 69 negative jacobians detected; no convergence at 6.354 s"),
    "stops-early": (
        "error",
        "at 2.769 s of 12.71 s: Max nr of reformations reached; no convergence at 2.921",
    ),
    "killed": ("killed", "killed by signal 9, most often for lack of memory, at 4.13 s of 12.71 s"),
}
WELL = (
    "  version 4.11.0\n------- converged at time : 1\n------- converged at time : 2\n "
    + NORMAL_TERMINATION
    + "\n"
)


@recorded
def test_an_error_is_one_whatever_the_exit_code():
    said = (LOGS / "stops-early" / "stdout.txt").read_text(errors="replace")
    verdict = judge_run(said, 0, END)
    assert verdict.kind == "error"
    assert "though it left with exit code 0" in verdict.reason


@pytest.mark.parametrize(
    ("said", "code", "kind", "fragment"),
    [
        (WELL, 0, "normal", ""),
        (WELL.replace("time : 2", "time : 1.5"), 0, "partial", "stopped early, at 1.5 s of 2 s"),
        (WELL.replace(NORMAL_TERMINATION, ""), 0, "crashed", "without a verdict"),
        (WELL.replace(NORMAL_TERMINATION, ERROR_TERMINATION), 0, "error", "though it left with exit code 0"),
        (WELL.replace(NORMAL_TERMINATION, ""), -11, "killed", "signal 11"),
        (WELL.replace(NORMAL_TERMINATION, ""), 139, "killed", "signal 11"),
        (WELL, 3, "crashed", "exit code 3"),
        ("", 0, "no output", "wrote nothing"),
        ("", 127, "crashed", "exit code 127"),
    ],
)
def test_other_ends(said, code, kind, fragment):
    verdict = judge_run(said, code, 2.0)
    assert verdict.kind == kind
    assert fragment in verdict.reason


@pytest.mark.parametrize("end", [10.022314, 6.623194858657083, 2.0 / 3.0, 999.9996])
def test_six_digits_of_the_end_are_the_end(tmp_path, end):
    """FEBio prints the time with six digits: a run that reached its end says a little less, or more."""
    said = WELL.replace("time : 2", f"time : {end:.6g}")
    assert judge_run(said, 0, end).kind == "normal"
    assert judge_run(WELL.replace("time : 2", f"time : {0.9999 * end:.6g}"), 0, end).kind == "partial"
    (tmp_path / "forces.txt").write_text(f"*Step  = 1\n*Time  = {end:.6g}\n*Data  = Fz\n3,-1.5\n")
    history = History(np.array([0.0, end / 2, end]), np.array([0.0, 6.1, 0.0]))
    problem = replace(build_punched_block("hex8", 2), history=history)
    log = read_log(tmp_path / "forces.txt")
    assert build_result(problem, log, judge_run(said, 0, end)).completed


def program(folder: Path, body: str) -> Path:
    file = folder / "febio4"
    file.write_text(f"#!{sys.executable}\nimport os, shutil, signal, sys, time\n{body}\n")
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    return file


def replay(folder: Path, name: str) -> Path:
    """A program that does as the recorded run of that name did."""
    code = int((LOGS / name / "exit-code.txt").read_text())
    body = f"there = {str(LOGS / name)!r}\n"
    body += "for f in ('forces.txt', 'model.log'):\n"
    body += "    if os.path.exists(f'{there}/{f}'): shutil.copyfile(f'{there}/{f}', f)\n"
    body += "sys.stdout.write(open(f'{there}/stdout.txt', errors='replace').read()); sys.stdout.flush()\n"
    body += "os.kill(os.getpid(), signal.SIGKILL)" if code == 137 else f"sys.exit({code})"
    return program(folder, body)


@recorded
@pytest.mark.parametrize("name", VERDICTS)
def test_a_failed_run_is_a_result_with_its_reason(tmp_path, name):
    kind, fragment = VERDICTS[name]
    run = run_febio(replay(tmp_path, name), tmp_path, END, "forces.txt")
    assert run.verdict.kind == kind
    assert fragment in run.verdict.reason
    assert "\n" not in run.verdict.reason
    assert run.verdict.version.startswith("4.11.0")
    problem = build_punched_block("hex8", 2)
    history = History(np.array([0.0, END / 2, END]), np.array([0.0, 6.1, 0.0]))
    problem = replace(problem, history=history)
    found = build_result(problem, run.log, run.verdict, run.seconds)
    assert not found.completed
    assert found.reason == run.verdict.reason
    assert found.statistics["linear_solver"].startswith("FEBio 4.11.0")
    if name in ("killed", "stops-early"):
        # the table may be one step behind FEBio's last word, never ahead
        assert 0.0 < found.times[-1] <= run.verdict.reached_s * (1 + 1e-5)
        assert found.peak_force > 0.1
    elif name != "diverges":
        assert found.times.tolist() == [0.0]


def test_a_good_run(tmp_path):
    table = "*Step  = 1\n*Time  = 2\n*Data  = Fx;Fy;Fz\n3,0,0,-1.5\n"
    run = run_febio(
        program(tmp_path, f"sys.stdout.write({WELL!r}); open('forces.txt', 'w').write({table!r})"),
        tmp_path, 2.0, "forces.txt",
    )  # fmt: skip
    assert run.verdict == RunVerdict("normal", "", 2.0, "4.11.0")
    found = build_result(build_punched_block("hex8", 2), run.log, run.verdict)
    assert found.completed
    assert found.force.tolist() == [0.0, 1.5]  # along the axis, which is -z; rest is put before it


def test_a_good_end_without_a_table_is_no_result(tmp_path):
    run = run_febio(program(tmp_path, f"sys.stdout.write({WELL!r})"), tmp_path, 2.0, "forces.txt")
    assert run.verdict.kind == "no output"
    assert "forces.txt" in run.verdict.reason


def test_old_results_are_not_taken_for_new(tmp_path):
    (tmp_path / "forces.txt").write_text("*Step  = 1\n*Time  = 2\n*Data  = Fz\n3,-1.5\n")
    run = run_febio(program(tmp_path, "sys.exit(1)"), tmp_path, 2.0, "forces.txt")
    assert run.log is None


def test_the_time_limit_ends_it_and_its_children(tmp_path):
    body = (
        "import subprocess\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        f"open('child', 'w').write(str(child.pid)); sys.stdout.write({WELL!r}); sys.stdout.flush()\n"
        "time.sleep(600)"
    )
    run = run_febio(program(tmp_path, body), tmp_path, 2.0, "forces.txt", time_limit_s=3.0)
    assert run.verdict.kind == "time limit"
    assert "the time limit of 3 s at 2 s of 2 s" in run.verdict.reason
    child = int((tmp_path / "child").read_text())
    for _ in range(50):
        state = subprocess.run(["ps", "-o", "stat=", "-p", str(child)], capture_output=True, text=True).stdout
        if not state.strip() or state.startswith("Z"):
            return
        time.sleep(0.1)
    pytest.fail("the child lives on")


def test_of_very_many_words_the_last_count(tmp_path):
    body = f"sys.stdout.write('  version 4.11.0\\n' + 'x' * 7 * 10**7 + {NORMAL_TERMINATION!r})"
    run = run_febio(program(tmp_path, body), tmp_path, 0.0, "forces.txt")
    assert run.verdict.version == "4.11.0"
    assert run.verdict.kind == "no output"  # ended well, without a table
    assert "ended normally" in run.verdict.reason


def test_threads_and_folder(tmp_path):
    body = "open('seen', 'w').write(os.environ['OMP_NUM_THREADS'] + os.getcwd() + ' '.join(sys.argv[1:]))"
    run_febio(program(tmp_path, body), tmp_path, 2.0, "forces.txt", threads=3)
    assert (tmp_path / "seen").read_text() == f"3{tmp_path}-i model.feb -o model.log"


def test_where_febio_is_looked_for(tmp_path, monkeypatch):
    monkeypatch.delenv("FEBIO_CMD", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=r"not installed here; install FEBio 4 \(https://febio.org"):
        find_febio()
    file = program(tmp_path, "")
    assert find_febio() == file
    elsewhere = tmp_path / "else"
    elsewhere.mkdir()
    other = program(elsewhere, "")
    monkeypatch.setenv("FEBIO_CMD", str(other))
    assert find_febio() == other
    assert find_febio(file) == file
    monkeypatch.chdir(elsewhere)  # a path of a study is counted from the study's folder
    assert find_febio(Path("else") / other.name, tmp_path) == other
    assert find_febio(other.name, tmp_path / "study") == file  # and a name is looked for on the path
    monkeypatch.setenv("FEBIO_CMD", f"./{other.name}")
    assert find_febio() == other  # which is run in another folder
    with pytest.raises(InputError, match=r"febio\.program.*not a program that can be run"):
        find_febio(tmp_path / "nowhere")


def test_a_program_that_cannot_start(tmp_path):
    file = tmp_path / "febio4"
    file.write_text("not a program")
    file.chmod(0o755)
    with pytest.raises(RunError, match="febio4"):
        run_febio(file, tmp_path, 2.0, "forces.txt")


def test_a_table_of_something_else(tmp_path):
    file = tmp_path / "log.txt"
    good = RunVerdict("normal", "", 2.0, "")
    file.write_text("*Step  = 1\n*Time  = 2\n*Data  = Fx;Fy\n3,0,0\n")
    with pytest.raises(ProblemError, match="has no Fz"):
        build_result(build_punched_block("hex8", 2), read_log(file), good)
    file.write_text("*Step  = 1\n*Time  = 200\n*Data  = Fz\n3,0\n")
    with pytest.raises(ProblemError, match="goes on to 200 s"):
        build_result(build_punched_block("hex8", 2), read_log(file), good)
