"""Mutants of leases and of the handover of chunks."""

from benchmarks.mutants.target import Mutant, Target

LEASE = Target(
    "wrappers/lease*/**/*.py",
    (
        "tests/wrappers/test_admission.py",
        "tests/wrappers/test_budget_commands.py",
        "tests/wrappers/test_stopping_budget.py",
        "tests/wrappers/test_teleop_revocation.py",
    ),
    (
        Mutant(
            "return bool(admits(end, position, velocity, duration_s, v_max, a_max, jerk, acceleration).all())",
            "return bool(admits(end, position, velocity, duration_s, v_max, a_max, jerk, acceleration).any())",
        ),
        Mutant(
            "        if not self._rest:\n            return bool(",
            "        if self._rest:\n            return bool(",
        ),
        Mutant(
            "return bool(least_s <= duration_s)",
            "return bool(least_s <= 2.0 * duration_s)",
        ),
        Mutant(
            "localisation, margin = budget.localisation + own[0], budget.margin + own[1]",
            "localisation, margin = budget.localisation, budget.margin",
        ),
        Mutant("budget, delays_s = self._budget, delays_s + self._budget.act_s", "budget = self._budget"),
        Mutant(
            "return float(times.min(initial=np.inf))", "return float(times.mean()) if times.size else np.inf"
        ),
        Mutant("self.clearance = value[value != np.inf]", "self.clearance = value"),
        Mutant(
            'left = self.clearance - self._reserves["margin"] - self._reserves["localisation"]',
            "left = self.clearance",
        ),
        Mutant(
            "ceilings[self.speed > 0.0].min(initial=math.inf)",
            "ceilings.min(initial=math.inf)",
            tests=(
                "tests/wrappers/test_round_trip_watch.py",
                "tests/control/test_round_trip_ceiling.py",
                "tests/wrappers/test_stopping_budget.py",
                "tests/wrappers/test_teleop_revocation.py",
            ),
        ),
        Mutant("        if self.longest_time() >= duration_s:\n            return True\n", ""),
        Mutant("and at_once and self.readable", "and self.readable"),
        Mutant("        if not self.readable:\n            return math.nan\n", ""),
        Mutant(
            "top_speed = math.inf if budget.top_speed is None else budget.top_speed", "top_speed = math.inf"
        ),
        Mutant(
            "(rows.normals @ command <= rows.offsets + _ROW_TOLERANCE).all()",
            "(rows.normals @ command <= rows.offsets + _ROW_TOLERANCE).any()",
        ),
        Mutant("            self._bound.check()\n", ""),
        Mutant(
            '{"braking": braking, "margin": margin, "state_error": localisation}',
            '{"braking": braking}',
        ),
        Mutant(
            'self._stop["jerk"] = budget.jerk', "pass", tests=("tests/wrappers/test_jerk_limited_stop.py",)
        ),
        Mutant(
            "late_s * fastest",
            "late_s * np.linalg.norm(v)",
            tests=("tests/wrappers/test_jerk_limited_stop.py",),
        ),
    ),
)

LEASE_EXPIRY = Target(
    "wrappers/lease_expiry.py",
    (
        "tests/wrappers/test_lease_over_filter.py",
        "tests/wrappers/test_lease_expiry.py",
        "tests/wrappers/test_authority_stack.py",
    ),
    (
        Mutant("refused |= not self._grant(now)", "self._grant(now)"),
        Mutant(
            "covered = now + self.control_dt <= self._until_s + self._same_s",
            "covered = now <= self._until_s + self._same_s",
        ),
        Mutant("expired = not covered and self._until_s > -math.inf", "expired = not covered"),
        Mutant(
            "            if arrived:\n                self._command = given",
            "            self._command = given",
        ),
        Mutant(
            "self._braking, self._blend = False, self._start_blend(self._blend_steps)",
            "self._braking = False",
        ),
        Mutant("            self._until_s = -math.inf\n            if not", "            if not"),
        Mutant(
            "if from_future or observed_s < newest_s - self._same_s or not finite:",
            "if from_future or not finite:",
        ),
        Mutant(
            "if from_future or observed_s < newest_s - self._same_s or not finite:",
            "if observed_s < newest_s - self._same_s or not finite:",
        ),
        Mutant("observed_s > now + self._clock_error_s + self._same_s", "observed_s > now + self._same_s"),
        Mutant(
            "detect + confirm + age + self._brake_steps * self.control_dt + self._clock_error_s",
            "detect + confirm + age + self._clock_error_s",
        ),
        Mutant(
            "detect + confirm + age + self._brake_steps * self.control_dt + self._clock_error_s",
            "detect + confirm + age + self._brake_steps * self.control_dt",
        ),
        Mutant("self._delays_s + max(now - self._newest_s, 0.0)", "self._delays_s"),
        Mutant(
            "max(min(longest_s, self._max_lease_s, self._chunk_s), self._min_lease_s)",
            "max(min(longest_s, self._chunk_s), self._min_lease_s)",
        ),
        Mutant(
            "max(min(longest_s, self._max_lease_s, self._chunk_s), self._min_lease_s)",
            "min(longest_s, self._max_lease_s, self._chunk_s)",
        ),
        Mutant(
            "granted = not math.isnan(longest_s) and lease",
            "granted = lease",
            equal="NaN passes through min and max as their first argument, and is not as long as a step",
        ),
        Mutant(
            "self._until_s = now + lease if granted else -math.inf",
            "self._until_s = now + lease if granted else self._until_s",
        ),
        Mutant("            self._newest_s = observed_s\n", "            pass\n"),
        Mutant("        self._delays_s += self._same_s  # by which", "        # by which"),
        Mutant(
            "sent = self._command.copy() if self._blend is None",
            "sent = self._command if self._blend is None",
        ),
        Mutant("self._chunk_refused |= not admitted", "pass"),
        Mutant("(start, steps, done + 1) if done + 1 < steps else None", "None"),
    ),
)

COMMAND_GATE = Target(
    "wrappers/common/command_gate.py",
    (
        "tests/wrappers/test_lease_over_filter.py",
        "tests/wrappers/test_lease_expiry.py",
        "tests/wrappers/test_authority_stack.py",
    ),
    (Mutant("executed = np.array(info[keys.EXECUTED_ACTION], dtype=np.float64)", "pass"),),
)

HANDOVER = Target(
    "wrappers/*handover*/**/*.py",
    (
        "tests/wrappers/test_chunk_queue.py",
        "tests/wrappers/test_chunks_arriving.py",
        "tests/wrappers/test_upsampling.py",
        "tests/wrappers/test_chunk_handover.py",
    ),
    (
        Mutant("if not newest < observed <= self.now or not", "if not newest <= observed <= self.now or not"),
        Mutant("if not newest < observed <= self.now or not", "if not newest < observed or not"),
        Mutant(
            "boxed = np.clip(commands, self._low, self._high)",
            "boxed = commands",
            equal="every command is clipped once more when it is sent",
        ),
        Mutant(
            "for chunk in reversed([c for c in self._coming if c.due <= self.now]):",
            "for chunk in [c for c in self._coming if c.due <= self.now]:",
        ),
        Mutant("left = chunk.commands[self.now - chunk.observed :]", "left = chunk.commands"),
        Mutant("fresh = newest.commands[self.now - newest.observed :]", "fresh = newest.commands"),
        Mutant("            if self._blend != ENSEMBLE:\n                break\n", ""),
        Mutant("if not (len(left) and admits(left)):", "if not len(left):"),
        Mutant("admits(left)", "admits(left[:1])"),
        Mutant("if not (len(left) and admits(", "if not (admits("),
        Mutant("self._coming = [c for c in self._coming if c.observed > newest.observed]", "pass"),
        Mutant("np.exp(-self._decay * np.arange", "np.exp(self._decay * np.arange"),
        Mutant("(done + 1.0) / (steps + 1.0)", "done / (steps + 1.0)"),
        Mutant("kept = np.clip(control, last - self._step, last + self._step)", "kept = control"),
        Mutant("        sent = np.where(too_far, np.nextafter(sent, last.astype(self._dtype)), sent)\n", ""),
        Mutant(
            "        self._fade = None\n        return len(self._sent) > 0, joined.steps",
            "        return len(self._sent) > 0, joined.steps",
        ),
        Mutant("whole_steps(shortest, self._control_dt) - 1)", "whole_steps(shortest, self._control_dt))"),
        Mutant("        held |= limited\n", ""),
        Mutant("if acting != self._acting and len(self._sent):", "if False:"),
        Mutant("weights @ votes / weights.sum()", "weights @ votes / len(votes)"),
        Mutant("np.where(step / control_dt > rate_limit, np.nextafter(step, 0.0), step)", "step"),
        Mutant("sizes.chunk - sizes.horizon - sizes.delay[1]", "sizes.chunk - sizes.horizon"),
        Mutant("if not delay[1] <= horizon <= size - delay[1]:", "if not horizon <= size - delay[1]:"),
        Mutant("if fewest >= available and sizes.chunk > 1:", "if fewest > available and sizes.chunk > 1:"),
        Mutant("        commands[:: self._steps] = chunk\n", ""),
        Mutant("np.asarray(np.gradient(unit, axis=1)) / steps", "np.asarray(np.gradient(unit, axis=1))"),
    ),
)

CHUNK_HANDOVER = Target(
    "wrappers/chunk_handover.py",
    (
        "tests/wrappers/test_macro_info.py",
        "tests/wrappers/test_chunks_arriving.py",
        "tests/wrappers/test_chunk_handover.py",
    ),
    (
        Mutant(
            "if name in i and (not key.where or i.get(key.where))]",
            "if name in i]",
        ),
        Mutant("getattr(np, key.chunk)", 'getattr(np, {"min": "max"}.get(key.chunk, key.chunk))'),
        Mutant("getattr(np, key.chunk)", 'getattr(np, {"max": "min"}.get(key.chunk, key.chunk))'),
        Mutant("getattr(np, key.chunk)", 'getattr(np, {"sum": "max"}.get(key.chunk, key.chunk))'),
        Mutant("latency = now - command.observed", "latency = now"),
        Mutant("            total += float(reward)", "            total = float(reward)"),
        Mutant("infos.append(dict(info))", "infos.append(info)"),
        Mutant(
            "        if not np.isfinite(chunk).all():\n            return False\n",
            "",
        ),
        Mutant(
            "self.now_s < observed_s <= self.now_s + self._clock_error_s +",
            "self.now_s < observed_s <= self.now_s +",
        ),
        Mutant(
            "math.floor(observed_s / self.control_dt + SAME_STEP)",
            "math.floor(observed_s / self.control_dt)",
        ),
        Mutant("self._delay[1] + 1))", "self._delay[1] + 2))"),
        Mutant("            if terminated or truncated:\n                break\n", ""),
        Mutant("now + command.blend_steps + DIFFERENCES - 1", "now + command.blend_steps"),
        Mutant("(max(blends) + 1) * self.control_dt", "max(blends) * self.control_dt"),
        Mutant(
            "self._executed, self._in_seam = self._executed[-DIFFERENCES:], []",
            "self._in_seam = []",
            equal="only the last control steps' differences are looked at; the memory would grow",
        ),
        Mutant(
            "peak = float(steps.max(initial=0.0)) / self.control_dt",
            "peak = float(at_seam.max(initial=0.0)) / self.control_dt",
        ),
        Mutant(
            "None if command.observed < 0 else command.observed * self.control_dt",
            "command.observed * self.control_dt",
        ),
        Mutant("        self._random.reset(self.env, seed)\n", ""),
        Mutant("        self._queue.reset()\n", ""),
        Mutant("self._fallback.executed(executed)", "pass"),
    ),
)
