"""Mutants of the projection."""

from benchmarks.mutants.target import Mutant, Target

PROJECTION = Target(
    "filter/**/*.py",
    ("tests/control/test_projection.py", "tests/control/test_projection_scale.py", "tests/filter"),
    (
        Mutant("FEASIBILITY_TOLERANCE = 1e-9", "FEASIBILITY_TOLERANCE = 1e-6"),
        Mutant("EXACT_SHARE = 1e-3", "EXACT_SHARE = 1e3"),
        Mutant("_SOFT = 1e-8", "_SOFT = 1e-2"),
        Mutant("ORDINARY_BOX = 16.0", "ORDINARY_BOX = 1e9"),
        Mutant("kept = normals @ control - offsets <= 10.0 *", "kept = normals @ control - offsets <= 1e7 *"),
        Mutant("return bool((kept & np.isfinite(length)).all())", "return bool(kept.all())"),
        Mutant("if inside and dot <= limit:", "if dot <= limit:"),
        Mutant("        if leave <= 0.0:\n            continue\n", ""),
        Mutant("    events.sort()\n", ""),
        Mutant("        falling += change\n", ""),
        Mutant("        value -= falling * (at - lam)\n", ""),
        Mutant("lam += (value - limit) / falling", "lam = (value - limit) / falling"),
        Mutant("x = bottom if x < bottom else top", "x = top"),
        Mutant("if excess > slack and falling > 0.0:", "if False:"),
        Mutant(
            "hopeless = bool((lowest > b + slack).any())",
            "hopeless = False",
            equal="only saves time: what no corner of the box meets has no projection, as the solver finds",
        ),
        Mutant("hopeless = bool((lowest > b + slack).any())", "hopeless = True"),
        Mutant(
            "np.where(a > 0.0, a * hi, np.where(a < 0.0, a * lo, 0.0))",
            "np.where(a > 0.0, a * lo, np.where(a < 0.0, a * hi, 0.0))",
        ),
        Mutant("    if excess <= 10.0 * slack:\n", "    if True:\n"),
        Mutant("if not np.isfinite(x).all() or bool((g @ x - h > allowed).any()):", "if False:"),
        Mutant("- x).max()) > _OPTIMALITY_TOLERANCE:", "- x).max()) > 1e9:"),
        Mutant("relaxed = np.maximum(h, g @ least) + 0.1 * allowed", "relaxed = h + 0.1 * allowed"),
        Mutant(
            "harmless = (length < _OVERFLOWING) & (b >= _OVERFLOWING)", "harmless = np.zeros(b.size, bool)"
        ),
        Mutant(
            "violation = part.violation if status is not Status.FAILED else math.inf",
            "violation = part.violation",
        ),
        Mutant("multipliers = weights[: h.size] / left[-1]", "multipliers = weights[: h.size]"),
        Mutant(
            "status = Status.FAILED if (feasible or not solved) else Status.INFEASIBLE",
            "status = Status.INFEASIBLE",
        ),
        Mutant("unit = 1.0 if box.ordinary else control_unit(box, u, excess, length)", "unit = 1.0"),
        Mutant("answer[1] * (unit * unit)", "answer[1]"),
        Mutant("weights * unit / norm", "weights"),
        Mutant(
            'if answer is None and solver != "daqp":',
            "if False:",
            equal="another way to the same answer: by distance, where a named solver and its least violation fail",
        ),
        Mutant(
            'np.maximum(info["lam"][n:], 0.0)',
            'info["lam"][n:]',
            equal="daqp's multipliers of rows without a lower bound are not negative",
        ),
    ),
)
