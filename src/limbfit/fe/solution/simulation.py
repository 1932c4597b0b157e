"""One run: the system, its materials, and the steps that are accepted one by one."""

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache

import numpy as np
from threadpoolctl import ThreadpoolController

from ...arrays import Array
from ...errors import ProblemError
from ..contact.friction import StickyContact
from ..memory import Memory, compute_elastic_stresses
from ..motion import Drives
from ..problem import Problem
from ..result import Result, State, Step
from ..system import Evaluation, Increment, System
from .control import PATIENCE, StepControl, StepController, predict_remaining_times, schedule_steps
from .coupling import Coupling, couple, renew_increment, solve_coupled
from .direction import refactor_at
from .factor import Factor, find_touched_unknowns
from .linear import prefers_multigrid
from .newton import FIRST_DAMPING, Equilibrium, NewtonControl, compute_reaction_scale, equilibrate
from .sensitivity import ExplicitDerivative, ForceTakeover, MemoryDerivative
from .start import IndenterStart, WarmStart, build_grips, compute_extrapolation, measure_indenter_travel

# Penetration over the allowed one that a few more iterations will not mend; how often a penalty is raised.
UNBEARABLE_DEPTH, MAX_RAISES = 1.2, 5
# Residual over reactions at which what a step holds constant is let go along.
LOOSE_TOLERANCE = 0.1
# How often the grip of a step is renewed; residual over reactions that is left then and is taken as it is.
MAX_RENEWALS, MAX_UNSETTLED = 30, 1e-2
# Renewals in a row that may bring it no closer: then it goes round, or away.
MAX_VAIN_RENEWALS, CLOSER_SHARE = 6, 0.9
# Share of the residual that renewing the grip causes which is left before it is renewed again.
RENEWAL_REDUCTION = 0.05
# Force over the mean shear modulus and the square of a body's width against which a residual is judged before
# anything is touched.
REST_FORCE_SHARE = 1e-6
# Depth of a step over that of the last one, as far as a first guess counts on it.
MAX_DEPTH_RATIO = 3.0
# Contact pressure over the mean shear modulus from which a rounded edge is flat in the tangents far from
# equilibrium: over the radius it is a negative stiffness, there beside that of the tissue.
STEEP_PRESSURE = 3.0
# How long ago tissue was strained before a simulation begins, s: by now it has relaxed.
PRESTRETCH_AGE_S = 1e9
# Share of the history in which what acts from its beginning comes on: nothing relaxes meanwhile.
SUDDEN_SHARE = 1e-9


class SteppedRun:
    """One run: the system, its materials, and the step that was reached last."""

    def __init__(
        self,
        problem: Problem,
        control: StepControl,
        sensitivities: bool,
        warm_start: Result | None = None,
        system: System | None = None,
    ) -> None:
        started = time.perf_counter()
        self.problem, self.control = problem, control
        known = (system, None if warm_start is None else warm_start.system)
        fitting = (one for one in known if one is not None and one.fits(problem))
        self.system = next(fitting, None) or System(problem, control.threads)
        self.laws = problem.build_laws()
        self.seconds: defaultdict[str, float] = defaultdict(float)
        moduli, threads, last = self.laws.moduli, control.threads, find_touched_unknowns(self.system, problem)
        self.planned = schedule_steps(problem.history, control, problem.turns)
        _check_takeovers(problem, self.planned)
        self.factor = Factor(
            self.system, moduli, control.linear_solver, threads, last=last, steps=len(self.planned)
        )
        # Multigrid is for one right-hand side: sensitivities have many, and want them exactly.
        apart = sensitivities and not self.factor.is_lasting and not prefers_multigrid()
        self.slopes = self.factor
        if apart:
            self.slopes = Factor(self.system, moduli, threads=threads, lasting=True, last=last)
        self.counts: Counter[str] = Counter()
        self.memory = Memory.rest(self.system, self.laws)
        self.slope = MemoryDerivative.rest(self.system, self.laws) if sensitivities else None
        self.damping = 0.0  # to begin a step with, after one that needed it
        self.warm = WarmStart.from_result(problem, warm_start)
        widths = [body.shape.width for body in problem.rigid_bodies]
        width = min(widths, default=1.0)
        self.floor, self.pushing = REST_FORCE_SHARE * self.laws.modulus * width**2, False
        self.stiffness = 2000.0 / width if control.penalty is None else control.penalty
        self.deepest = control.penetration * measure_indenter_travel(self.system, self.laws.modulus)
        self.touch = IndenterStart.from_problem(problem)
        drives = self.touch.shift_drives(problem.drives(0.0))
        rest = self.system.bodies.impose(np.zeros((self.system.rows, 3)), drives)
        still = np.zeros((*rest.shape, self.laws.count)) if sensitivities else None
        self.rest = self._read_coordinates(rest, drives)
        self.onset: Step | None = None  # the equilibrium at time 0, where it is another than that
        start = problem.history.displacement_at(0.0)
        parameters = self.laws.count if sensitivities else 0
        self.grips = build_grips(self.system, parameters, rest, drives)
        self.states = [self._build_state(0.0, start, rest, self.stiffness, still, None, drives, self.grips)]
        self.takeover = None
        if still is not None:
            self.takeover = ForceTakeover.begin(problem.rigid_bodies, still[self.system.nodes :])
        self.reason, self.pace = "", StepController(control.max_iterations)
        self.unbalanced: list[tuple[float, float]] = []  # mm and residual of steps beyond the tolerance
        self.unsettled: list[tuple[float, float]] = []  # the same of steps whose grip goes on changing
        self.seconds["setup"] = time.perf_counter() - started

    def run(self) -> Iterator[Step]:
        """Yield accepted steps; afterwards ``reason`` says why it stopped early, if it did."""
        begun, pace, why = self.states[-1].time, self.pace, ""
        targets = [t for t in self.planned if t > begun * (1.0 + 1e-9)]
        if not begun and not self._equilibrate_onset():
            return
        times, forces = [0.0], [0.0]
        while targets:
            now, spent = self.states[-1].time, self._is_spent()
            if spent:
                bound = f"no more than {self.control.most_iterations} Newton iterations were allowed"
                why = f"{why}; {bound}" if why else bound
            if spent or pace.cuts > self.control.max_cuts:
                self.reason = f"stopped at {now:.4g} s of {targets[-1]:.4g} s: {why}"
                return
            t = pace.next_time(now, targets[0])
            before = self.counts["newton_iterations"]
            with limit_numpy_threads():
                found = self._attempt(t, pace.patience)
            if isinstance(found, str):
                self.counts["cuts"] += 1
                pace.cut(now, t)
                why = found
                continue
            pace.accept(now, t, self.counts["newton_iterations"] - before)
            why = ""
            self._take_over(found)
            times.append(t)
            forces.append(found.force)
            if t == targets[0]:
                targets = targets[1:]
                rests = self.problem.moving_s(self.planned[-1]) == self.problem.moving_s(t)
                if self.control.times is None and rests and self.problem.indenter is not None:
                    targets = predict_remaining_times(
                        self.problem.history, self.planned, targets, times, forces
                    )
            yield found

    def _take_over(self, step: Step) -> None:
        """Forces that are left open from here on are those that held the bodies in a step."""
        before, self.problem = self.problem, self.problem.take_over_forces(step.time, step.reactions)
        bodies = zip(before.rigid_bodies, self.problem.rigid_bodies)
        took = [old.motion is not new.motion for old, new in bodies]
        if any(took) and self.takeover is not None:
            self.takeover = self.takeover.update(took, self.system.bodies, step.state, self.laws.modulus)

    def _equilibrate_onset(self) -> bool:
        """True if there is equilibrium at time 0.

        Pre-strained tissue has had it long since; under what acts from then on nothing has relaxed yet.
        """
        what, takes = "load that acts from the beginning", SUDDEN_SHARE * self.problem.history.times[-1]
        if len(self.system.prestretch):
            what, takes = "pre-strained tissue", PRESTRETCH_AGE_S
            rest = self.states[0]
            still = self.memory.build_increment(
                self.system, self.laws, 0.0, takes, rest.displacement, 0.0, rest.drives
            )
            strained = self.system.evaluate(rest.rows, self.laws, still, tangent=False).residual
            self.floor = max(self.floor, 1e-2 * float(np.linalg.norm(strained)))  # no stress may be left
        elif not self.problem.acts_at_once:
            return True
        with limit_numpy_threads():
            found = self._attempt(0.0, self.pace.usual * PATIENCE, takes)
        if isinstance(found, str):
            self.reason = f"the {what} found no equilibrium: {found}"
        else:
            self.onset = found
        self.states = self.states[-1:]
        return not self.reason

    def _attempt(self, t: float, patience: int, takes: float | None = None) -> Step | str:
        """The step to time ``t``, or why there is none; nothing is changed unless it is accepted.

        ``patience``: iterations that are allowed for one equilibrium; ``takes``: another duration than the
        time since the last state, s.
        """
        history = self.problem.history
        dt = t - self.states[-1].time if takes is None else takes
        displacement, drives = history.displacement_at(t), self.touch.shift_drives(self.problem.drives(t))
        stiffness, u = self.stiffness, self._predict(t)
        pressures = tuple(pressure.at(t) for pressure in self.problem.pressures)
        rims = self.system.pressures.compute_rims(self.states[-1].rows, pressures) if pressures else 0.0
        for raises in range(MAX_RAISES, -1, -1):
            may_rise = raises > 0 and not self.control.hold_penalty
            increment = self.memory.build_increment(
                self.system, self.laws, t, dt, displacement, stiffness * self.laws.modulus, drives
            )
            increment = replace(
                increment, grips=self.grips, flat_from=STEEP_PRESSURE / stiffness, pressures=pressures,
                activation=self.problem.activation_at(t),
                rims=rims,
            )  # fmt: skip
            control = NewtonControl(
                self.control.tolerance, patience, self.damping, tangent=self.slope is not None,
                max_penetration=UNBEARABLE_DEPTH * self.deepest if may_rise else np.inf,
            )  # fmt: skip
            found, increment = self._settle(increment, u, control)
            if found.reason:
                return found.reason
            if not (may_rise and found.at.penetration > self.deepest):
                break
            stiffness, u = 3.0 * stiffness, found.u
        return self._accept(found, increment, dt, stiffness)

    def _settle(
        self, increment: Increment, u: Array, control: NewtonControl
    ) -> tuple[Equilibrium, Increment]:
        """An equilibrium, and the increment with the grips and the rims of pressures that hold there."""
        start = self.system.impose(u, increment)
        lags = increment.lags
        loosely = replace(control, tolerance=max(control.tolerance, LOOSE_TOLERANCE)) if lags else control
        roughly = replace(control, reduction=RENEWAL_REDUCTION) if lags else control
        found = self._equilibrate(increment, start, loosely)
        closest, vain = np.inf, 0
        for _ in range(MAX_RENEWALS):
            if found.reason or found.at.penetration > control.max_penetration:
                return found, increment
            if lags:
                settled, spent = couple(
                    self.system, self.laws, increment, found.u, self.factor, control, self.floor, self.seconds
                )
                if settled is not None:
                    self.counts["newton_iterations"] += spent
                    return settled
                self.counts["vain_iterations"] += spent
            again = renew_increment(self.system, increment, found.u)
            if again is increment:
                return found, increment
            increment = again
            found = self._equilibrate(increment, found.u, roughly)
            if not found.iterations:
                return found, increment
            vain = 0 if found.first < CLOSER_SHARE * closest else vain + 1
            closest = min(closest, found.first)
            if vain > MAX_VAIN_RENEWALS or self._is_spent():
                break
        unsettled = found.first
        if not found.reason:
            found = self._equilibrate(increment, found.u, control)
        reason = "" if unsettled <= MAX_UNSETTLED else "friction, or the rim of a pressure, does not settle"
        return replace(found, reason=found.reason or reason, unsettled=unsettled), increment

    def _is_spent(self) -> bool:
        """True if no more Newton iterations are allowed, those that led nowhere counted."""
        used = self.counts["newton_iterations"] + self.counts["vain_iterations"]
        return used >= self.control.most_iterations

    def _equilibrate(self, increment: Increment, guess: Array, control: NewtonControl) -> Equilibrium:
        """From the guess or the last displacement; from the last one where that fails."""
        guesses = [guess, self.system.impose(self.states[-1].rows, increment)]
        found = Equilibrium(guess, Evaluation(np.inf, guess, guess), 0, "")
        for tried in (guesses, guesses[1:]):
            found = equilibrate(
                self.system, self.laws, increment, tried, self.factor, control, self.floor, self.deepest,
                self.seconds,
            )  # fmt: skip
            self.counts["newton_iterations"] += found.iterations
            if not found.reason or found.iterations >= control.max_iterations:
                break  # from elsewhere it would take as many
        return found

    def _predict(self, t: float) -> Array:
        warm, last = self.warm.interpolate(t), self.warm.interpolate(self.states[-1].time)
        if warm is not None:  # what it missed by in the step before, it will miss by in this one, by depth
            if last is None:
                return warm
            now, then = self.problem.history.displacement_at(t), self.states[-1].displacement
            deeper = min(now / then, MAX_DEPTH_RATIO) if now > 0.0 and then > 0.0 else 1.0
            return warm + deeper * (self.states[-1].rows - last)
        weights = self._compute_guess_weights(t)
        return np.asarray(sum(w * state.rows for w, state in zip(weights, self.states)))

    def _compute_guess_weights(self, t: float) -> Array:
        """Weights of the last states in a guess of the one at time ``t``; those before a further body turned
        say nothing of it."""
        travel, little = self.problem.travel, 1e-9 * t
        turned = max((turn for turn in self.problem.turns if turn < t - little), default=-np.inf)
        known = [state for state in self.states if state.time >= turned - little] or self.states[-1:]
        weights = np.zeros(len(self.states))
        weights[-len(known) :] = compute_extrapolation([travel(state.time) for state in known], travel(t))
        return weights

    def _accept(self, found: Equilibrium, increment: Increment, dt: float, stiffness: float) -> Step:
        started = time.perf_counter()
        u, at = found.u, found.at
        worn = self.slopes.is_worn()
        inexact = at.data is None or at.penetration > increment.flat_from
        if inexact and (worn or self.slope is not None):
            at = self.system.evaluate(u, self.laws, replace(increment, flat_from=np.inf))
            found = replace(found, at=at)
        if worn:
            refactor_at(at, self.slopes)
        self.slopes.start_step()
        du = force_slope = None
        if self.slope is None:
            stress = compute_elastic_stresses(self.system, self.laws, u)
        else:
            explicit = self.slope.differentiate_step(self.system, self.laws, self.memory, increment, u, dt)
            stress = explicit.stress
            du, force_slope = self._differentiate(explicit, found, increment)
            self.slope = self.slope.advance(self.system, self.laws, self.memory, explicit, du, dt)
        after = self.memory.advance(self.system, self.laws, stress, dt)
        if self._has_turned(increment.time, at.force):
            after, self.slope = after.drop_past(), self.slope and self.slope.drop_past()
        drives = self.problem.drives(increment.time)
        if self.touch.waits and increment.time >= self.problem.touch_down_s * (1.0 - 1e-9):
            self.touch = self.touch.touch_down(self.system, u, drives, du)
        tools = self.system.tools(u, replace(increment, drives=self.touch.shift_drives(drives)))
        apart = [self.touch.subtract_touch(self.system, du), *[du] * len(tools)]
        self.grips = tuple(g and g.advance(tool, d) for g, tool, d in zip(increment.grips, tools, apart))
        self.memory, self.stiffness = after, stiffness
        self.damping = FIRST_DAMPING if found.damped else 0.0
        self.floor = max(self.floor, 1e-2 * compute_reaction_scale(self.system, at, 0.0))
        coordinates, deepening = self._read_coordinates(u, increment.drives), None
        displacement = increment.displacement
        if self.problem.history.forced:
            displacement = float(coordinates[0, 2])
            deepening = None if du is None else du[self.system.nodes, 2]
        memory = after.drop_past()
        state = self._build_state(
            increment.time, displacement, u, stiffness, du, memory, increment.drives, increment.grips
        )
        self.states = [*self.states[-2:], state]
        if found.residual > self.control.tolerance:
            self.unbalanced.append((displacement, found.residual))
        if found.unsettled > self.control.tolerance:
            self.unsettled.append((displacement, found.unsettled))
        self.counts["steps"] += 1
        self.seconds["accept"] += time.perf_counter() - started
        return Step(
            increment.time, displacement, at.force, at.penetration, at.contact_area, found.iterations,
            force_slope, np.zeros((0, 6)) if at.reactions is None else at.reactions, coordinates, deepening,
            state,
        )  # fmt: skip

    def _read_coordinates(self, u: Array, drives: Drives) -> Array:
        """Where the rigid bodies are (b, 6), mm and rad."""
        tools = self.system.bodies.tools(u, drives)
        return np.array([tool.pose.coordinates for tool in tools]).reshape(-1, 6)

    def _build_state(
        self, time: float, displacement: float, u: Array, stiffness: float, du: Array | None,
        memory: Memory | None, drives: Drives, holding: Sequence[StickyContact | None],
    ) -> State:  # fmt: skip
        n = self.system.nodes
        slopes = (None, None) if du is None else (du[:n], du[n:])
        grips = tuple(grip and grip.drop_derivatives() for grip in holding)
        return State(
            time, displacement, u[:n], stiffness, slopes[0], memory, u[n:], slopes[1], drives, grips,
            self.problem.activation_at(time),
        )  # fmt: skip

    def _has_turned(self, t: float, force: float) -> bool:
        """True if the stress after a step to ``t`` does not go on as it went before: the indenter turned, or
        contact began or ended."""
        met, self.pushing = (force > 0.0) != self.pushing, force > 0.0
        touched = self.states[-1].time > self.problem.touch_down_s * (1.0 + 1e-9)
        if self.control.stress == "linear" or (met and touched):
            return True
        return bool(np.isclose(t, self.problem.kinks, rtol=1e-9, atol=0.0).any())

    def _differentiate(
        self, explicit: ExplicitDerivative, found: Equilibrium, increment: Increment
    ) -> tuple[Array, Array]:
        """Derivatives (n, 3, p) of the displacement and (p,) of the force at equilibrium."""
        system, laws, at, u = self.system, self.laws, found.at, found.u
        d_penalty = laws.modulus_gradient / laws.modulus  # the penalty moves with the mean modulus
        change = explicit.forces + system.contact_force(u, increment)[..., None] * d_penalty
        d_reaction = np.zeros(laws.count)
        for i, (grip, tool) in enumerate(zip(increment.grips, system.tools(u, increment))):
            if grip is None:
                continue
            stiff = (increment.penalty * tool.surface.areas)[..., None, None]
            held = stiff * grip.differentiate_anchors(tool)
            held = np.einsum("ij,fqip->fqjp", tool.body.frame, held).reshape(-1, 3, laws.count)  # in space
            change += tool.distribute_forces(held)
            if i == 0:
                d_reaction -= system.bodies.first_body.frame[2] @ held.sum(axis=0)
        if self.takeover is not None:
            change[system.nodes :] -= self.takeover.differentiate_remaining(
                self.problem.rigid_bodies, system.bodies, increment.time
            )
        coupling = Coupling(system, increment, u)
        b = -change.reshape(-1, laws.count)[system.free]
        pushed = self.touch.differentiate_contact_forces(system, at, coupling)
        if pushed is not None:
            b -= system.bodies.spread_forces(pushed)
            d_reaction += system.bodies.project_on_axis(pushed)
        weights = self._compute_guess_weights(increment.time)
        guess = sum(w * s.slopes for w, s in zip(weights, self.states))
        x = np.asarray(guess).reshape(-1, laws.count)[system.free]
        du = np.zeros((u.size, laws.count))
        du[system.free], d_force = solve_coupled(system, at, self.slopes, b, x, coupling)
        du = du.reshape(*u.shape, laws.count)
        if self.problem.history.forced:  # the force is what is stated
            return du, np.zeros(laws.count)
        return du, at.force * d_penalty + d_reaction + d_force


def limit_numpy_threads() -> AbstractContextManager[object]:
    """While this lasts, NumPy's own linear algebra runs on one thread.

    Its idle threads would spin on the cores that the solver works on, and their number changes last digits.
    """
    return _find_openblas().limit(limits=1)


@cache
def _find_openblas() -> ThreadpoolController:
    """OpenBLAS alone: a limit on all libraries, once lifted, would leave MKL with one thread."""
    return ThreadpoolController().select(internal_api="openblas")


def _check_takeovers(problem: Problem, planned: Array) -> None:
    """Refuse steps (k,), s, that skip the time at which a body's force is taken over."""
    for body in problem.bodies:
        for t in body.motion.times[np.isnan(body.motion.values).any(axis=1)]:
            if not np.isclose(planned, t, rtol=1e-9).any():
                what = f"no step ends at {t:g} s, where a body's force is taken over"
                raise ProblemError(what, remedy="add it to the times")
