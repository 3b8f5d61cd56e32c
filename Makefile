PYTHON ?= python3
BIN := .venv/bin
# One BLAS thread: the matrices are tiny and the runs are parallel processes.
export OMP_NUM_THREADS ?= 1

.PHONY: demo test test-library test-slow mutants fuzz lint check lock sbom bench table shelf endurance figures gallery docs clean

# Tests draw nothing; the demo tries which GL can.
test test-library test-slow fuzz: export MUJOCO_GL ?= disabled

# LOCKED=1: only files whose hashes are in requirements.lock; on Linux with the CUDA build of torch.
.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
ifdef LOCKED
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
else
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
endif
	@touch $@

# First the policies that ship with the repository, each in a process of its own, then two that are trained here.
ENJOY = $(BIN)/safe-wrappers enjoy configs/policies/
FILM = --episodes 20 --output runs/demo/shipped_
demo: .venv/installed
	@echo "1 of 2: two policies that ship with the repository (configs/policies), each trained for 2,000,000 control steps:"
	@($(ENJOY)unfiltered --filter none $(FILM)unfiltered.webp && $(ENJOY)unfiltered --filter protect $(FILM)afterwards.webp) & \
		unfiltered=$$!; $(ENJOY)filtered $(FILM)filtered.webp; filtered=$$?; wait $$unfiltered && exit $$filtered
	@echo "2 of 2: two policies that are trained here, for two minutes each, then evaluated over 20 episodes:"
	@$(BIN)/safe-wrappers compare configs/demo.yaml --report
	@echo "This verdict is of the policies that were trained here; those of 2,000,000 control steps are at the top."

# The order of files is that of tests/conftest.py.
PARALLEL = -n 2 --dist loadfile --no-loadscope-reorder
test: .venv/installed
	$(BIN)/python -m pytest $(PARALLEL)

# The library alone, without torch and gymnasium-robotics: make test-library PYTHON=python3.13 MUJOCO=4.0.0
MUJOCO = $(shell sed -n 's/^mujoco==//p' constraints.txt)
LIBRARY_VENV = .venv-$(notdir $(PYTHON))-mujoco-$(MUJOCO)
test-library:
	$(PYTHON) -m venv --clear $(LIBRARY_VENV)
	sed 's/^mujoco==.*/mujoco==$(MUJOCO)/' constraints.txt > $(LIBRARY_VENV)/constraints.txt
	$(LIBRARY_VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c $(LIBRARY_VENV)/constraints.txt -e '.[test]'
	$(LIBRARY_VENV)/bin/python -m pytest $(PARALLEL) --ignore tests/train --ignore tests/sb3

test-slow: .venv/installed
	$(BIN)/python -m pytest -n 2 -m slow

# Small mistakes in the filter, constraints, plants and wrappers, one at a time in a copy: do the tests notice them?
mutants: .venv/installed
	$(BIN)/python -m benchmarks mutants

# Property tests with random examples, again and again until the time is up, once at least; what fails becomes an
# explicit example of its test. What is neither passed nor failed (interrupted, not collected) ends it at once.
MINUTES ?= 60
fuzz: .venv/installed
	@end=$$(($$(date +%s) + 60 * $(MINUTES))); failed=0; \
	while :; do \
		$(BIN)/python -m pytest -q -n 2 -m "hypothesis and not slow" --hypothesis-profile=fuzz tests; \
		case $$? in 0) ;; 1) failed=1 ;; *) exit 2 ;; esac; \
		[ $$(date +%s) -lt $$end ] || exit $$failed; \
	done

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf build/types && mkdir -p build/types/safe_wrappers
	ln -s $(CURDIR)/safe_wrappers/* $(CURDIR)/envs $(CURDIR)/train $(CURDIR)/examples build/types/safe_wrappers/
	cd build/types && ../../$(BIN)/mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache -p safe_wrappers

check: lint test

TOOLS = uv==0.13.9 cyclonedx-bom==7.5.0
.venv-tools/installed: Makefile
	$(PYTHON) -m venv .venv-tools
	.venv-tools/bin/python -m pip install --quiet --disable-pip-version-check $(TOOLS)
	@touch $@

# constraints.txt with the hashes of all files, for every system and Python; after a change of either file.
lock: .venv-tools/installed
	.venv-tools/bin/uv pip compile --quiet --universal --generate-hashes --no-annotate --custom-compile-command "make lock" \
		--python-version 3.11 -c constraints.txt --extra dev pyproject.toml -o requirements.lock

# All packages with their hashes, as CycloneDX has it.
sbom: .venv-tools/installed
	mkdir -p build
	.venv-tools/bin/cyclonedx-py requirements requirements.lock --pyproject pyproject.toml --of JSON -o build/sbom.json
	@echo "build/sbom.json"

.venv/bench: .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	@touch $@

# One table, six minutes: beside bare envs, other packages, and the version before.
bench: .venv/bench
	$(BIN)/python -m benchmarks bench

.venv/shelf: .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[shelf]'
	@touch $@

# Other packages' envs, simulated: about three hours on two cores.
shelf: .venv/shelf
	$(BIN)/python -m benchmarks shelf

.venv/sbx: .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[sbx]'
	@touch $@

# What safety costs in return, task by task: days on two cores; goes on where it was stopped.
table: .venv/sbx
	$(BIN)/python -m benchmarks table

# Attackers against the proved filters: an hour and a half of one core; goes on where it was stopped.
endurance: .venv/installed
	$(BIN)/python -m benchmarks endurance

# Long figures of the README and docs/results, about five hours on two cores; those with a target of their own (table,
# endurance, shelf, ...) are not among them: each page names its command.
RUN = $(BIN)/python -m benchmarks
COMPARED = pointgoal1_300k pointgoal1_learners velocity_experts halfcheetah_velocity_ppo swimmer_velocity_ppo ant_velocity_ppo \
	outages saferover_ppo occluded_crossing_ppo
figures: .venv/installed
	$(RUN) protected --steps 3000
	for name in trained_adversary leases slip impact occlusion teleop kills training_time; do $(RUN) $$name || exit 1; done
	for config in $(COMPARED); do $(BIN)/safe-wrappers compare configs/$$config.yaml --report || exit 1; done

# The films of docs/gallery.md: about ten minutes. MUJOCO_GL=osmesa or egl where there is no window.
gallery: .venv/installed
	$(BIN)/python -m benchmarks gallery

.venv/docs: .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@touch $@

# The site, for file:// too: nothing in it comes from elsewhere. Pictures are drawn anew; a warning is an error.
docs: .venv/docs
	rm -rf build/docs
	$(BIN)/python -m sphinx -b html -E -W --keep-going -q docs build/docs
	@echo "build/docs/index.html"

clean:
	rm -rf .venv .venv-* build dist *.egg-info safe_wrappers.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
