"""How the friction of a step settles where its normal force is renewed."""

import numpy as np
from blocks import punch

from limbfit.fe import Indenter, Problem, StepControl, solve
from limbfit.fe.solution import simulation


def rounded(mu: float) -> Problem:
    tool = Indenter("square", 20.0, 2.0, axis=(0, 0, -1), centre=(0.0, 0.0, 1.0))
    return punch("tet10", 2, 1, friction=mu, indenter=tool)


def test_renewals_ask_for_equilibrium_no_better_than_needed(monkeypatch):
    """Asked for to the tolerance every time, friction that is renewed takes more iterations."""
    monkeypatch.setattr(simulation, "couple", lambda *given: (None, 0))
    problem, control = rounded(0.2), StepControl(times=(1.0, 2.0))
    found = solve(problem, control)
    monkeypatch.setattr(simulation, "RENEWAL_REDUCTION", 0.0)
    fine = solve(problem, control)
    assert found.completed
    assert fine.completed
    assert found.statistics["newton_iterations"] < fine.statistics["newton_iterations"]
    np.testing.assert_allclose(found.force, fine.force, rtol=1e-4)
