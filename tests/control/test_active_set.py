"""The compiled projection: the conditions of optimality, and the same bits in plain Python."""

import hashlib

import numpy as np
import pytest

from safe_wrappers.control.numerics.compiled import IS_COMPILED
from safe_wrappers.filter.projection import project


def random_problems(count):
    """Of all kinds: with room, through one point, with nearly the same rows, with opposite rows, infeasible, open."""
    rng = np.random.default_rng(0)
    for n in range(count):
        m, k = int(rng.integers(1, 9)), int(rng.integers(1, 12))
        u, normals = rng.uniform(-1.5, 1.5, m), rng.normal(size=(k, m))
        low, high = -rng.uniform(0.1, 1.0, m), rng.uniform(0.1, 1.0, m)
        kind = n % 6
        if kind == 2:
            normals = np.vstack([normals, normals + rng.normal(size=(k, m)) * 10.0 ** rng.uniform(-9, -3)])
        if kind == 3:
            normals = np.vstack([normals, -normals[:2]])
        if kind == 5:
            high = np.where(rng.random(m) < 0.5, np.inf, high)
            normals[rng.random((k, m)) < 0.4] = 0.0
        room = {0: rng.exponential(0.1), 1: 0.0, 4: rng.normal(0.0, 0.5)}.get(kind, 1e-3)
        yield u, normals, normals @ rng.uniform(low, np.minimum(high, 1.0)) + room, low, high


def answers(count):
    """A digest of all that comes out, and the statuses."""
    digest, seen = hashlib.sha256(), set()
    for problem in random_problems(count):
        answer = project(*problem)
        seen.add(answer.status.value)
        for part in (answer.control, answer.multipliers, answer.violation, answer.iterations):
            digest.update(np.asarray(part, dtype=np.float64).tobytes())
    return digest.hexdigest(), sorted(seen)


def test_every_answer_is_optimal_to_round_off():
    projected = 0
    for u, normals, offsets, low, high in random_problems(3000):
        answer = project(u, normals, offsets, low, high)
        if answer.status != "projected":
            continue
        projected += 1
        x, weights = answer.control, answer.multipliers
        missed = (normals @ x - offsets) / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
        assert (missed <= 2e-12).all() and (weights >= 0.0).all()
        pull = np.abs(weights[:, None] * normals).sum(axis=0)
        assert (np.abs(np.clip(u - weights @ normals, low, high) - x) <= 1e-12 + 1e-14 * pull).all()
        assert (missed[weights > 0.0] >= -1e-12).all()
    assert projected > 2000


@pytest.mark.skipif(not IS_COMPILED, reason="there is only one form")
def test_the_random_problems_have_all_answers():
    _, seen = answers(600)
    assert seen == ["inactive", "infeasible", "projected"]
