"""Mutants of the four clearances that have a backup manoeuvre."""

from benchmarks.mutants.target import Mutant, Target

_FORGOTTEN = "Detour(self._memory.side, self._memory.steps - 1)"

HEADING_DRIVE = Target(
    "*/backup/[bdh]*.py",
    (
        "tests/constraints/test_heading_drive_reach.py",
        "tests/constraints/test_heading_drive_clearance.py",
        "tests/control/test_heading_drive.py",
        "tests/control/test_drive_among_discs.py",
        "tests/wrappers/test_closed_loop_point_goal.py",
    ),
    (
        Mutant(_FORGOTTEN, "Detour()"),
        Mutant(_FORGOTTEN, "self._memory"),
        Mutant("detour_steps = 50", "detour_steps = 0"),
        Mutant("return 1.0 if across <= 0.0 else -1.0", "return 1.0 if across > 0.0 else -1.0"),
        Mutant("return self._memory.side if self._memory.steps > 0 else 0.0", "return 0.0"),
        Mutant("    if not nearest:\n        return 0.0", "    if False:\n        return 0.0"),
        Mutant("return min(target, _to_disc(backup, at.swivel, x, y, room))", "return target"),
        Mutant("DECAY_PER_HOLD: Final = 0.5", "DECAY_PER_HOLD: Final = 2.0"),
        Mutant("[self.drive, *self.drive.corners()]", "[self.drive, self.drive]"),
        Mutant("        if left > best:\n", "        if False:\n"),
        Mutant("0.25 * _aim(body, at, best) + 0.75 * at.least", "at.least"),
        Mutant("if not at.safe or turn != 0.0:", "if True:"),
        Mutant("if at.safe and best < _needed_outside(body, at, best):", "if False:"),
        Mutant("    if value < CLOSE_M:\n", "    if False:\n"),
        Mutant("    if beyond > 0.0:\n", "    if False:\n"),
        Mutant("end_distance(path, x, y) - swivel) - room", "end_distance(path, x, y)) - room"),
        Mutant("while place > 0 and bounds[place - 1] > bound:", "while False:"),
        Mutant("        if bound != bound:\n", "        if False:\n"),
        Mutant("bounds[close] < cutoff:", "bounds[close] < 0.5 * cutoff:"),
        Mutant("= -by_drive, -by_turn", "= -by_drive, by_turn"),
        Mutant("return brake_control(body, ahead) if brake else 0.0,", "return brake_control(body, ahead),"),
        Mutant("if way != 0.0:", "if False:"),
        Mutant("OVERSHOOTS: Final = (0.02, 0.1)", "OVERSHOOTS: Final = ()"),
        Mutant("TRIES: Final = 3", "TRIES: Final = 2"),
        Mutant("BLENDS: Final = (0.1, 0.25, 0.5, 0.75)", "BLENDS: Final = (0.1, 0.25, 0.5)"),
        Mutant("    for mixed in range(2):", "    for mixed in range(0):"),
        Mutant("    if not admits(models, at, back, 0.0, brake):\n", "    if False:\n"),
        Mutant("unit[j] = (most[j] - least[j]) / (high[j] - low[j])", "unit[j] = 1.0"),
        Mutant(
            "if left < at.loss and left < _needed",
            "if left < _needed",
            equal="one hold uses up at most the loss: where more is left, at least half of the clearance is",
        ),
        Mutant("RECOVERY_RATE: Final = 1.0", "RECOVERY_RATE: Final = 0.0"),
    ),
)

COASTING = Target(
    "constraints/backup/[bc]*.py",
    (
        "tests/constraints/test_coasting_rest.py",
        "tests/constraints/test_coasting_clearance.py",
        "tests/wrappers/test_closed_loop_car_goal.py",
    ),
    (
        Mutant(_FORGOTTEN, "Detour()"),
        Mutant(_FORGOTTEN, "self._memory"),
        Mutant("detour_steps = 25", "detour_steps = 0"),
        Mutant("return -1.0 if way[0] * y", "return 1.0 if way[0] * y"),
        Mutant("pairs if outer_is_first else pairs[:, ::-1]", "pairs"),
        Mutant("if after.least >= self.spec.margin:", "if after.least >= 0.0:"),
        Mutant("min(least) if course.rests else -math.inf", "min(least)"),
        Mutant("if fallen > self._within + _SAME_M:", "if False:"),
        Mutant("[*around, 0.5 * acting, self._still]", "around"),
        Mutant("return rest.least < self.spec.margin and kept", "return kept"),
        Mutant("return rest.least < self.spec.margin and kept", "return False"),
        Mutant("            return rest.least >= 0.0", "            return True"),
        Mutant("(np.abs(seen - self._seen) <= _STILL).all()", "True"),
        Mutant("best = max(self._after(drive).end", "best = min(self._after(drive).end"),
        Mutant("_RECOVERED = 0.5", "_RECOVERED = 1.1"),
        Mutant("sorted(self._drives(), key=lambda u: -self._after(u).end)[:1]", "self._drives()[:1]"),
        Mutant("close = now < room", "close = now < 0.5 * room"),
        Mutant("if after.least < 0.0:", "if after.least < 0.01:"),
        Mutant(
            "np.minimum(np.maximum(control, low), high) + 0.0",
            "np.minimum(np.maximum(control, low), high)",
        ),
        Mutant("return after.end if self._least < 0.0 else after.least", "return after.end"),
    ),
)

ESCAPE = Target(
    "constraints/backup/escape_clearance.py",
    (
        "tests/constraints/test_escape_boxes.py",
        "tests/constraints/test_escape_clearance.py",
        "tests/wrappers/test_closed_loop_occlusion.py",
    ),
    (
        Mutant("shorter = going_on - 1 if", "shorter = going_on if"),
        Mutant("        if going_on is not None:", "        if False:"),
        Mutant(
            "self._wanted = self.spec.margin + outside * np.exp(-times[1:] / _RECOVERY_S)",
            "self._wanted = self.spec.margin + 0.0 * times[1:]",
        ),
        Mutant("if -self.spec.margin < self._best < 0.0 else 0.0", "if self._best < 0.0 else 0.0"),
        Mutant("if -self.spec.margin < self._best < 0.0 else 0.0", "if False else 0.0"),
        Mutant("firsts[0 if left[0] >= 0.0 else int(left.argmax())]", "firsts[0]"),
        Mutant(
            "moved = centers + times[:, None, None] * velocity",
            "moved = centers + 0.0 * times[:, None, None] * velocity",
        ),
        Mutant("_nearest_first(np.concatenate([good, closer]), asked)", "np.concatenate([good, closer])"),
        Mutant("            closer = closer[self._slacks(closer).max(axis=1) >= 0.0]\n", ""),
        Mutant(
            "np.concatenate([*radii, np.zeros(0)]) + self.spec.radius",
            "np.concatenate([*radii, np.zeros(0)])",
        ),
        Mutant(
            "times = self.plant.control_dt * np.concatenate([[0.0], 1.0 + self._escapes.instants])",
            "times = self.plant.control_dt * np.concatenate([[0.0], self._escapes.instants])",
        ),
        Mutant(
            "((led_to - velocity) ** 2).sum(axis=1).argmin()",
            "((led_to - velocity) ** 2).sum(axis=1).argmax()",
        ),
        Mutant(
            "if now - float(np.hypot(abs(x - here_x).max(), abs(y - here_y).max())) <= self.spec.margin:",
            "if now <= self.spec.margin:",
        ),
        Mutant("gap - self.spec.radius, out=nearest", "gap, out=nearest"),
        Mutant("_GOING_S = (0.3, 0.8)", "_GOING_S = (0.3,)"),
        Mutant(
            "return left - self._needed() if left == left else -np.inf",
            "return left if left == left else -np.inf",
        ),
    ),
)

WAYS = Target(
    "control/backup/way_clearances.py",
    ("tests/control/test_way_clearances.py",),
    (
        Mutant("along = max(abs(y[c, m, k] - ahead_y[k]) - half_y[k], 0.0)", "along = 0.0"),
        Mutant("if disc[3] - reach <= margin:", "if disc[3] <= margin:"),
        Mutant("if plane[5] - reach <= margin:", "if plane[5] <= margin:"),
        Mutant("highest[1] + room >= low:", "highest[1] - room >= low:"),
        Mutant(
            "math.sqrt(across * across + along * along) - disc[2]",
            "math.sqrt(across * across + along * along)",
        ),
        Mutant(" + (flat_y[i] - plane[1]) * plane[3]", ""),
        Mutant("over < left[c, m] or over != over:", "over < left[c, m]:"),
    ),
)

WALL = Target(
    "*/backup/[pw]*.py",
    (
        "tests/constraints/test_point_decision.py",
        "tests/constraints/test_wall_corners.py",
        "tests/constraints/test_wall_clearance.py",
    ),
    (
        Mutant("return _left_after(among, motion, room, control) >= needed - _NOISE_M", "return True"),
        Mutant("min(0.0, left) - _NOISE_M", "0.0"),
        Mutant("if across >= beside:", "if across < beside:"),
        Mutant("_TURNS: Final = 4", "_TURNS: Final = 0"),
        Mutant(
            "return min(target, _left_after(among, motion, room, backup(among, motion, room, left)))",
            "return target",
        ),
        Mutant("math.sqrt(max(room * room - other * other, 0.0))", "room"),
        Mutant("while place > 0 and away[place - 1] > far:", "while False:"),
        Mutant("        for first in range(2):", "        for first in range(1):"),
        Mutant(
            "share = min(1.0, wanted / hypot(gap[0], gap[1])) if corner else 0.0",
            "share = 0.5 if corner else 0.0",
        ),
        Mutant("offsets[count] = max(sign * limit, sign * halt[axis])", "offsets[count] = sign * limit"),
        Mutant(
            "return max(constants.low, min(along.control_to_rest_at(constants, x, v, target), constants.high))",
            "return along.control_to_rest_at(constants, x, v, target)",
        ),
        Mutant("room = reach + self.spec.margin", "room = reach"),
        Mutant("target = start - gap if before else end + gap", "target = start - gap"),
        Mutant("motion[2], motion[3] = now.vx, now.vy", "pass"),
        Mutant("    return left >= -HAIR_M", "    return not left < -HAIR_M"),
        Mutant(
            "            low = middle\n        else:\n            high = middle", "            low = middle"
        ),
    ),
)
