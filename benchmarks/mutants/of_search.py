"""Mutants of the search for an admissible action, and of rollout constraints."""

from benchmarks.mutants.target import Mutant, Target

_FIRST_KEPT = "\n        return next((control for control in every if "

SEARCH = Target(
    "filter/**/*.py",
    ("tests/filter",),
    (
        # Overshoot, blend, backup and the kept target survived before the search was tested stage by stage.
        Mutant("_OVERSHOOTS = (0.02, 0.1)", "_OVERSHOOTS = ()"),
        Mutant("_OVERSHOOTS = (0.02, 0.1)", "_OVERSHOOTS = (0.02, 0.2)"),
        Mutant("_BLENDS = (0.1, 0.25, 0.5, 0.75)", "_BLENDS = ()"),
        Mutant("_BLENDS = (0.1, 0.25, 0.5, 0.75)", "_BLENDS = (0.1, 0.25, 0.5)"),
        Mutant("for j in range(target.size):", "for j in range(0):"),
        Mutant("            return Decision(backup, Stage.BACKUP)", "            pass"),
        Mutant("backup is not None or self._keeps(target, strict)", "backup is not None"),
        Mutant("self.shorten(proposal, target, strict) if admitted", "target if admitted"),
        Mutant(
            "return True, self.shorten(proposal, control, strict), joined", "return True, control, joined"
        ),
        Mutant("_TRIES = 3", "_TRIES = 2"),
        Mutant("_TRIES = 3", "_TRIES = 4"),
        Mutant("_WORTH = 0.05", "_WORTH = 0.0"),
        Mutant("_BEYOND = 0.05", "_BEYOND = 0.0"),
        Mutant("            nearer = self._rounded(proposal", "            nearer = np.asarray(proposal"),
        Mutant(
            "if result.status is Status.INACTIVE:\n            return result, control",
            "if True:\n            return result, control",
        ),
        Mutant("_SECANTS = 2", "_SECANTS = 1"),
        Mutant("_SECANTS = 2", "_SECANTS = 3"),
        Mutant("_DIFFERENCES = 4", "_DIFFERENCES = 3"),
        Mutant("_DIFFERENCES = 4", "_DIFFERENCES = 5"),
        Mutant("_AGAIN), provisional=True)", "_AGAIN), provisional=False)"),
        Mutant("_AGAIN = 0.1", "_AGAIN = 0.0"),
        Mutant("and slacks[:k].min() < 0.0", ""),
        Mutant("_LINEARIZATIONS = 6", "_LINEARIZATIONS = 5"),
        Mutant("_LINEARIZATIONS = 6", "_LINEARIZATIONS = 7"),
        Mutant("(not contradictory or self._within(control, strict))", "True"),
        Mutant(
            "and (not contradictory or self._within(control, strict))",
            "and not contradictory",
        ),
        Mutant(
            f"for control in known){_FIRST_KEPT}self._keeps(control, strict)",
            f"for control in known){_FIRST_KEPT}self._admitted(control)",
        ),
        Mutant("candidate = self.candidate(proposal, strict)", "candidate = None"),
        Mutant(
            f"if control is not None]{_FIRST_KEPT}self._keeps(control, strict)",
            f"if control is not None]{_FIRST_KEPT}self._admitted(control)",
        ),
        Mutant(
            "every = (self._rounded(control, *strict) for control in known)",
            "every = (control for control in known)",
        ),
        Mutant(
            "[self._rounded(control, *strict) for control in known if",
            "[control for control in known if",
        ),
        Mutant(
            "            rows = strict\n            result, control = self._project(proposal, *rows)",
            "            rows = strict",
        ),
        Mutant("*(u for u in self._tried if self._within(u, strict))]", "*self._tried]"),
        Mutant("*(u for u in self._tried if self._within(u, strict))]", "]"),
        Mutant("(c.slack(control) / c.scale for", "(c.slack(control) for"),
        Mutant("if not self._fallback.brakes:", "if False:"),
        Mutant(
            "if least is target else Stage.LEAST_VIOLATION",
            "if least is not target else Stage.LEAST_VIOLATION",
        ),
        Mutant(
            "[c.linearize(control) for c in self._predicting if not c.admits(control)]",
            "[c.linearize(control) for c in self._predicting]",
        ),
        Mutant("result.status is Status.PROJECTED and self._admitted(more)", "self._admitted(more)"),
        Mutant("rows[1] - share * excess", "rows[1] - share"),
        Mutant("        self._tried = []\n        decision", "        decision"),
        Mutant("                self._tried.append(control)\n", ""),
        Mutant("            if result.status is Status.FAILED:\n                break", "            pass"),
        Mutant("decision.refused = None  # of", "pass  # of"),
        Mutant("if not self._predicting or self._admitted(control):", "if True:"),
        Mutant(
            "        if self._admitted(control):\n            return self._projected(proposal, control, Stage.ROWS",
            "        if False:\n            return self._projected(proposal, control, Stage.ROWS",
        ),
        Mutant("decision.changed |= bool((proposal != boxed).any())", "pass"),
        Mutant("self._fallback(self._plant, last, self._low, self._high, None, readable=False)", "last"),
        Mutant(
            "self._no_rows: Rows = np.zeros((0, low.size)), np.zeros(0)",
            "self._no_rows: Rows = _NO_ROWS",
            tests=("tests/control/test_drive_among_discs.py",),
        ),
        Mutant(
            "least, most = np.clip(acting[0], low, high), np.clip(acting[1], low, high)",
            "least, most = low, high",
        ),
        Mutant(
            "np.where(result.control == force / unit, nominal, result.control * unit)",
            "result.control * unit",
        ),
    ),
)

ROLLOUT = Target(
    "constraints/rollout.py",
    (
        "tests/constraints/test_rollout_response.py",
        "tests/constraints/test_predicted.py",
        "tests/constraints/test_predicted_displacements.py",
    ),
    (
        Mutant("_KEPT = 10", "_KEPT = 0"),
        Mutant("_KEPT = 10", "_KEPT = 11"),
        Mutant("_SAME_RESPONSE = 1", "_SAME_RESPONSE = 0"),
        Mutant("_SAME_RESPONSE = 1", "_SAME_RESPONSE = 2"),
        Mutant("_INSTANTS = (1, 2, 3, 5, 8,", "_INSTANTS = (1, 2, 3, 8,"),
        Mutant(
            "in (*_INSTANTS, each)",
            "in _INSTANTS",
            tests=("tests/constraints/test_predicted_displacements.py",),
        ),
        Mutant("_RESOLUTION = 1e-6", "_RESOLUTION = 0.0"),
        Mutant("RECOVERY_S = 0.1", "RECOVERY_S = 0.2"),
        Mutant(
            "self._least - most >= self.spec.margin + self.tolerance",
            "self._least >= self.spec.margin + self.tolerance",
        ),
        Mutant("fallen > most + self.tolerance:", "fallen > 2.0 * most:"),
        Mutant(
            "                stacklevel=2,\n            )\n            self.max_decrease = most = None",
            "                stacklevel=2,\n            )",
        ),
        Mutant("(*self._recent, self._least)[-self.spec.horizon :]", "(*self._recent, self._least)[-1:]"),
        Mutant("(*self._recent, self._least)[-self.spec.horizon :]", "(*self._recent, self._least)"),
        Mutant(
            "[left.min(axis=0) - self._outside, left[-1] - self._closer()]",
            "[left.min(axis=0) - self._outside]",
        ),
        Mutant(
            "[left.min(axis=0) - self._outside, left[-1] - self._closer()]", "[left[-1] - self._closer()]"
        ),
        Mutant(
            "np.exp(-self.spec.horizon * self.plant.control_dt / RECOVERY_S)",
            "np.exp(-self.plant.control_dt / RECOVERY_S)",
        ),
        Mutant("return least if least == least else -np.inf", "return least"),
        Mutant("np.where(control < 0.0, _STEP, -_STEP)", "_STEP"),
        Mutant("least = left + (response * away).sum(axis=-1)", "least = left"),
        Mutant("        left[-1] += self._outside - self._closer()\n", ""),
        Mutant("np.minimum(value - self.spec.margin, 0.0)", "np.minimum(value, 0.0)"),
        Mutant("if self._linear is None:", "if True:"),
        Mutant(
            "self.plant.observation_id >= self._response[1]", "self.plant.observation_id > self._response[1]"
        ),
        Mutant("if self._response is None or self.plant.observation_id", "if self.plant.observation_id"),
    ),
)
