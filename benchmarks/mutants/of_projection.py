"""Mutants of the projection."""

from benchmarks.mutants.target import Mutant, Target

_TESTS = (
    "tests/filter/test_projection_failed.py",
    "tests/control/test_active_set.py",
    "tests/control/test_projection.py",
    "tests/control/test_projection_scale.py",
    "tests/control/test_projection_batch.py",
    "tests/filter",
)

PROJECTION = Target(
    "filter/**/*.py",
    _TESTS,
    (
        Mutant("FEASIBILITY_TOLERANCE: Final = 1e-9", "FEASIBILITY_TOLERANCE: Final = 1e-6"),
        Mutant("EXACT_SHARE: Final = 1e-3", "EXACT_SHARE: Final = 1e3"),
        Mutant("_SOFT: Final = 1e-10", "_SOFT: Final = 1e-2"),
        Mutant("ORDINARY_BOX: Final = 16.0", "ORDINARY_BOX: Final = 1e9"),
        Mutant("kept = _within(rows, slacks, 10.0)", "kept = _within(rows, slacks, 1e7)"),
        Mutant("control)[0] == _READ\n", "control)[0] >= 0\n"),
        Mutant(
            "_excess(point, columns, rows, TARGET) == 0.0 and inside:",
            "_excess(point, columns, rows, TARGET) == 0.0:",
        ),
        Mutant("    if inside and _within(rows, slacks, 1.0):", "    if _within(rows, slacks, 1.0):"),
        Mutant("    if not _within(rows, slacks, 10.0):\n", "    if False:\n"),
        Mutant("    if named and asking > 1:", "    if named and asking > 0:"),
        Mutant("usual = usual and abs(normals[i, j]) < LARGEST", "usual = usual"),
        Mutant("length > _SHORTEST and offset < OVERFLOWING", "length > _SHORTEST"),
        Mutant("corner = point[LOW, j] if slope > 0.0", "corner = point[LOW, j] if slope < 0.0"),
        Mutant("& (b > -OVERFLOWING)", "& (b < OVERFLOWING)"),
        Mutant("rows[WEIGHT, i] = softened[WEIGHT, i]", "rows[WEIGHT, i] = 0.0"),
        Mutant("Projection(control, Status.FAILED, math.inf,", "Projection(control, Status.FAILED, 0.0,"),
        Mutant("if not np.isfinite(x).all() or bool((g @ x - h > allowed).any()):", "if False:"),
        Mutant("- x).max()) <= OPTIMALITY_TOLERANCE:", "- x).max()) <= 1e9:"),
        Mutant("    if solver != OWN:  # its failure", "    if False:  # its failure"),
        Mutant("multipliers[asking] = answer[1] * unit / norm", "multipliers[asking] = answer[1]"),
        Mutant(
            'np.maximum(info["lam"][n:], 0.0)',
            'info["lam"][n:]',
            equal="daqp's multipliers of rows without a lower bound are not negative",
        ),
    ),
)

ACTIVE_SET = Target(
    "control/numerics/active_set.py",
    _TESTS,
    (
        Mutant("_DEPENDENT: Final = 1e-13", "_DEPENDENT: Final = 1e-6"),
        Mutant("_DEPENDENT: Final = 1e-13", "_DEPENDENT: Final = 0.0"),
        Mutant("            along[SHARE, a] += part\n", "            along[SHARE, a] = part\n"),
        Mutant("square > _CANCELLED * whole:", "True:"),
        Mutant(
            "    for _ in range(2):\n        for a in range(count):\n            i = active[a]",
            "    for _ in range(0):\n        for a in range(count):\n            i = active[a]",
        ),
        Mutant("            used, place = rows[WEIGHT, i] / change, a\n", "            pass\n"),
        Mutant(
            "                used, place = point[PRESSURE, j] / push, count + j\n", "                pass\n"
        ),
        Mutant("held = held or active[a] == i", "pass"),
        Mutant("point[PRESSURE, j] = abs(target - point[X, j])", "point[PRESSURE, j] = 0.0"),
        Mutant(
            "            start, count = place, count - 1\n",
            "            start, count = count - 1, count - 1\n",
        ),
        Mutant("over -= step * square", "pass"),
        Mutant("weight += step", "weight = step"),
        Mutant("            point[SIDE, place - count] = 0.0\n", "            pass\n"),
    ),
)
