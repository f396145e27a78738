# make run     from a bare machine to the paper's table and figures, at a reduced budget (a quarter of an hour on 2 cores)
# make test    the tests          make test-slow   those that take minutes          make lint   style and types
# make smoke   every experiment for a few steps, on drawn scenes (a minute)
# make wheel   a package for this platform, with the compiled layer, in dist/
# make clean   remove what these made, but for the data in cache/
#
# TORCH_INDEX=<address of a package index> make install   chooses another build of PyTorch (CPU only, another CUDA)

PYTHON ?= python3
VENV ?= .venv
RUNS ?= runs/reduced
OUT ?= .
BIN := $(VENV)/bin
EPO := $(BIN)/epo
STAMP := $(VENV)/.installed

.PHONY: run install test test-slow smoke lint wheel clean

install: $(STAMP)

KERNEL := $(wildcard epo_lightning/solvers/gauss_newton/kernel/*.?pp)

$(STAMP): pyproject.toml constraints.txt $(KERNEL)
	$(PYTHON) -m venv $(VENV)
	$(if $(TORCH_INDEX),$(BIN)/pip install -q --index-url $(TORCH_INDEX) -c constraints.txt torch)
	$(BIN)/pip install -q -c constraints.txt -e '.[dev]'
	touch $@

# One thread per run, two runs at a time: small batches gain nothing from a second thread.
run: $(STAMP)
	$(EPO) generate data=rpi_reduced
	$(EPO) sweep rpi_main data=rpi_reduced budget=reduced seed=0 runs=$(RUNS) callbacks.progress=lines \
		hydra/launcher=local hydra.launcher.n_jobs=2
	$(EPO) report rpi_main runs=$(RUNS) out=$(OUT)
	@echo
	@echo "This was the REDUCED budget: a fifth of the data and a few epochs, so the numbers show that everything works, not which row is best."
	@echo "The paper's settings, on all data (a day on 2 cores; with budget=long about an hour per run):"
	@echo "  $(EPO) generate"
	@echo "  $(EPO) sweep rpi_main"
	@echo "  $(EPO) report rpi_main"

test: $(STAMP)
	$(BIN)/python -m pytest

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow

smoke: $(STAMP)
	$(BIN)/python -m pytest tests/experiment/test_smoke.py

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

wheel: $(STAMP)
	$(BIN)/pip wheel -q --no-deps -w dist .

clean:
	rm -rf epo_lightning/solvers/gauss_newton/kernel/epo_kernel.* runs/reduced figures results.md results.csv results.tex comparisons.csv index.html build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
