"""Mutants of simulation, predictive shielding and discrete actions."""

from benchmarks.mutants.target import Mutant, Target

SHIELD = Target(
    "constraints/predictive_shield.py",
    ("tests/constraints/test_predictive_shield.py", "tests/wrappers/test_action_shield.py"),
    (
        Mutant("                if slack >= 0.0:\n                    break\n", ""),
        Mutant("key=lambda index: index != self._survivor", "key=lambda index: index"),
        Mutant("if slack > best.slack:", "if slack < best.slack:"),
        Mutant("not (rollout.reached or rollout.ended)", "not rollout.reached"),
        Mutant("return min(slack, _NOT_REACHED)", "return slack"),
        Mutant("(values - self._needed[: len(values)]).min()", "values.min()"),
        Mutant("self._now - self._needed.max() >= far", "self._now >= far"),
        Mutant("np.where(np.isnan(values), np.inf, -values)", "np.where(np.isnan(values), np.inf, values)"),
        Mutant(
            "return self._survivor if known is None else known.backup, control",
            "return self._survivor, control",
        ),
        Mutant("return -float(view.info[spec.h])", "return float(view.info[spec.h])"),
        Mutant(
            "        if np.isfinite(self.plant.state).all():\n            for",
            "        if True:\n            for",
        ),
        Mutant("            return -math.inf  # the backup", "            return 0.0  # the backup"),
        Mutant(
            "return self._last if isinstance(backup, str)",
            "return 0.0 * self._last if isinstance(backup, str)",
        ),
    ),
)

SIMULATION = Target(
    "plants/simulator/*.py",
    ("tests/plants/simulator", "tests/vector/test_vector_simulation.py"),
    (
        Mutant("        mujoco.mj_copyData(own, model, data)\n", ""),
        Mutant("            raw.render_mode = None\n        copied", "            pass\n        copied"),
        Mutant("        if any(id(getattr(one", "        if False and any(id(getattr(one"),
        Mutant(
            "            for attributes, before in wrappers:\n                attributes.update(before)\n", ""
        ),
        Mutant(
            "            raw._np_random, raw.render_mode = generator, drawing\n",
            "            raw.render_mode = drawing\n",
        ),
        Mutant(
            "        os.waitpid(child, 0)\n        if not answer:",
            "        os.waitpid(child, 0)\n        if False:",
        ),
        Mutant('options = {"include_rng": True} if', "options = {} if True or"),
        Mutant("        if behind[-1][2] or behind[-1][3]:\n", "        if behind[-1][2]:\n"),
        Mutant("    raw._np_random = generator\n", ""),
        Mutant("zip(names, simulated, real, strict=True)", "zip(names[:1], simulated, real)"),
        Mutant("    if a.tobytes() == b.tobytes():\n        return None\n", "    return None\n"),
        Mutant(
            "                    if not found.values[-1] >= least:",
            "                    if found.values[-1] < least:",
        ),
        Mutant("found.reached = until is not None and until(view)", "found.reached = False"),
        Mutant("if found.ended or found.reached:", "if found.reached:"),
        Mutant("if policy is not None and step + 1 < horizon:", "if policy is not None and step < 1:"),
        Mutant("            if self.same_noise:\n", "            if True:\n"),
        Mutant("        if control is None:\n            self.simulation.start()\n", ""),
    ),
)

DISCRETE = Target(
    "wrappers/action_shield.py",
    ("tests/wrappers/test_action_shield.py",),
    (
        Mutant("if given is None or not self.action_space.contains(action):", "if given is None:"),
        Mutant("            admitted[int(np.argmax(slacks))] = True\n", "            pass\n"),
        Mutant("        self.observe()\n        every", "        every"),
        Mutant("table.any(axis=", "table.all(axis="),
        Mutant("return np.ones(int(self._counts.sum())", "return np.zeros(int(self._counts.sum())"),
    ),
)
