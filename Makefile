# Everything a new machine needs: `make demo` and `make test` set up what they use.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export OMP_NUM_THREADS ?= 1
# three on two cores: browsers, hosts and killed servers leave one waiting
PYTEST_ARGS ?= -n 3 --dist loadfile --no-loadscope-reorder
BASELINE ?= ../hodge-baseline

.PHONY: help setup demo paper test faults faults-full faults-mutants baseline compare-baseline docs site dist lint format clean
help:
	@echo "make setup   system libraries, $(VENV) and everything in it: 3 GB"
	@echo "make demo    make a room, reconstruct it: runs/demo"
	@echo "make paper   the paper's tables for every sequence that is there: runs/paper"
	@echo "make test    the tests"
	@echo "make faults  crashes, damage, full disks, hostile files: about 10 minutes; faults-full: every case"
	@echo "make faults-mutants  whether the faults find faults"
	@echo "make baseline          what real data gives now, kept in $(BASELINE)"
	@echo "make compare-baseline  what has changed since"
	@echo "make docs    docs/recipes.md from the code"
	@echo "make site    docs/ as a site: build/site/index.html"
	@echo "make dist    sdist and wheel: dist"
	@echo "make lint    ruff, mypy, import directions"

$(STAMP): pyproject.toml benchmarks/paper/method/pyproject.toml constraints.txt tools/system-libraries.sh
	sh tools/system-libraries.sh
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "no venv: apt-get install python3-venv"; exit 1; }
	@echo "into $(VENV): about 3 GB with all libraries, of which 1 GB is downloaded; some minutes"
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev]' -e benchmarks/paper/method
	touch $@

setup: $(STAMP)

demo: $(STAMP)
	$(BIN)/hodge demo --out runs/demo
	@echo "open runs/demo/report.html, or: $(BIN)/hodge view runs/demo"

paper: $(STAMP)
	$(BIN)/python -m benchmarks.paper $(PAPER_ARGS)

test: $(STAMP)
	$(BIN)/python -m pytest $(PYTEST_ARGS)

faults: $(STAMP)
	$(BIN)/python -W ignore tests/faults/faults.py $(FAULTS_ARGS)

faults-full: $(STAMP)
	$(BIN)/python -W ignore tests/faults/faults.py --full $(FAULTS_ARGS)

faults-mutants: $(STAMP)
	$(BIN)/python -W ignore tests/faults/mutants.py

baseline: $(STAMP)
	$(BIN)/python benchmarks/baseline.py store $(BASELINE)

compare-baseline: $(STAMP)
	$(BIN)/python benchmarks/baseline.py compare $(BASELINE)

docs: $(STAMP)
	$(BIN)/python tools/recipe_reference.py

site: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "open build/site/index.html"

dist: $(STAMP)
	rm -rf dist
	$(BIN)/python -m build --no-isolation

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) runs dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis
