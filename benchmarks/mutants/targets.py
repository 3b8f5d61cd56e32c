"""What is mutated, by name."""

from benchmarks.mutants.of_backups import COASTING, ESCAPE, HEADING_DRIVE, WALL, WAYS
from benchmarks.mutants.of_projection import ACTIVE_SET, PROJECTION
from benchmarks.mutants.of_search import ROLLOUT, SEARCH
from benchmarks.mutants.of_simulation import DISCRETE, SHIELD, SIMULATION
from benchmarks.mutants.of_wrappers import CHUNK_HANDOVER, COMMAND_GATE, HANDOVER, LEASE, LEASE_EXPIRY
from benchmarks.mutants.target import Target

TARGETS: dict[str, Target] = {
    "search": SEARCH,
    "projection": PROJECTION,
    "active set": ACTIVE_SET,
    "rollout": ROLLOUT,
    "heading drive": HEADING_DRIVE,
    "coasting": COASTING,
    "escape": ESCAPE,
    "ways": WAYS,
    "wall": WALL,
    "shield": SHIELD,
    "simulation": SIMULATION,
    "discrete": DISCRETE,
    "lease": LEASE,
    "lease expiry": LEASE_EXPIRY,
    "command gate": COMMAND_GATE,
    "handover": HANDOVER,
    "chunk handover": CHUNK_HANDOVER,
}
