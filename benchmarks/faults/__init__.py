"""The fault matrix: every wrapper and every constraint under every fault (`python -m benchmarks.fault_matrix`)."""
