# make run         from a bare machine to a first table with pictures: six to nine minutes on 2 cores, installation included
# make install     the package and its command `epo` in .venv (`make run` does it)
# make dev         install what the tests and checks need as well
# make test        install everything and run the tests      make test-slow   the tests that take long
# make lint        check style and types
# make smoke       train every experiment for a few steps on drawn scenes (a minute)
# make docs        build the documentation as a site, with references of API and configuration, in build/docs
# make tables      write docs/tables and the pages of results (docs/*.md.j2) anew from the results files in results/
# make checkpoint  train the checkpoints that ship with the package anew (an hour; one: NAME=rpi/v_lstm_epo)
# make asan        test the kernel with the sanitizers of addresses and undefined behaviour (Clang, Linux)
# make wheel       build a package for this platform, with the compiled layer, in dist/
# make clean       remove the compiled layer, tables and figures of reports, packages, and caches of tools
#
# PyTorch's build for CUDA is the default on Linux and needs 5 GB. Another one, for CPUs say:
#   TORCH_INDEX=https://download.pytorch.org/whl/cpu make run

PYTHON ?= python3
VENV ?= .venv
RUNS ?= runs/first
OUT ?= .
BUILDER ?= html
BIN := $(VENV)/bin
EPO := $(BIN)/epo
# One stamp for what running needs, one for what the site needs as well, and one for what testing needs as well (simulator,
# Ray, MLflow, browser, type checker).
INSTALLED := $(VENV)/.installed
DOCUMENTABLE := $(VENV)/.documentable
TESTABLE := $(VENV)/.testable

.PHONY: run install dev test test-slow smoke asan lint docs tables checkpoint wheel clean

install: $(INSTALLED)

KERNEL_FOLDER := epo_lightning/solvers/gauss_newton/kernel
KERNEL := $(wildcard $(KERNEL_FOLDER)/*.?pp)
SOURCES := pyproject.toml constraints.txt $(KERNEL)
# A comma would end an argument of `call`.
WITH_DOCS := local,docs
WITH_TESTS := local,dev,docs

# The requirements of some extras; an extra may name others, as epo_lightning[sim,local].
define LIST_REQUIREMENTS
import re, sys, tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
def requirements(extra):
    for line in project["optional-dependencies"][extra]:
        others = re.fullmatch(r"epo_lightning\[(.*)\]", line)
        yield from (r for other in others[1].split(",") for r in requirements(other)) if others else [line]
print(*project["dependencies"], *(r for extra in sys.argv[1].split(",") for r in requirements(extra)), sep="\n")
endef
export LIST_REQUIREMENTS

# uv unpacks the packages in a tenth of pip's time. It does not read pip's settings: the one that names folders of wheels is
# handed on, and pip takes over where uv fails (a mirror that stands in pip.conf alone, for example).
# --no-compile: Python compiles the modules that are used, when they are used, instead of twelve thousand at once.
export UV_FIND_LINKS ?= $(PIP_FIND_LINKS)
INSTALL_PACKAGES = { $(BIN)/uv pip install -q --python $(BIN)/python $(1) || $(BIN)/pip install -q --no-compile $(1); }

# Where this is set, as in some containers, every process would compile three thousand modules anew, which takes it 15 seconds.
unexport PYTHONDONTWRITEBYTECODE

# $(1): the extras. The layer is compiled on one core while packages are downloaded and unpacked on another.
# Without a compiler its build fails, and the layer runs in PyTorch; solvers say so when they are used.
define INSTALL
@$(PYTHON) -c "import sys; v = '%d.%d' % sys.version_info[:2]; sys.exit(sys.version_info < (3, 11) and sys.executable + ' is Python ' + v + ', and 3.11 or later is needed: name another one by PYTHON=python3.12')"
@echo "installing into $(VENV): one to five minutes and the download, while the layer is compiled in the background ..."
$(PYTHON) -m venv $(VENV)
$(BIN)/pip install -q --no-compile uv || true
$(if $(TORCH_INDEX),$(call INSTALL_PACKAGES,--index-url $(TORCH_INDEX) -c constraints.txt torch))
@$(BIN)/python -c "$$LIST_REQUIREMENTS" $(1) > $(VENV)/requirements.txt
$(BIN)/python $(KERNEL_FOLDER)/build.py > /dev/null 2>&1 & \
$(call INSTALL_PACKAGES,-c constraints.txt -r $(VENV)/requirements.txt) && wait
$(call INSTALL_PACKAGES,--no-deps -e '.[$(1)]')
@$(BIN)/python -c "import epo_lightning.experiment.train"
endef

$(INSTALLED): $(SOURCES)
	$(call INSTALL,local)
	touch $@

dev: $(TESTABLE)

$(DOCUMENTABLE): $(SOURCES)
	$(call INSTALL,$(WITH_DOCS))
	touch $(INSTALLED) $@

$(TESTABLE): $(SOURCES)
	$(call INSTALL,$(WITH_TESTS))
	touch $(INSTALLED) $(DOCUMENTABLE) $@

# One thread per run and one run per core: small batches gain nothing from a second thread.
run: $(INSTALLED)
	$(EPO) generate data=rpi_hard_reduced
	$(EPO) sweep first_table runs=$(RUNS) callbacks.progress=lines hydra/launcher=local
	$(EPO) report first_table runs=$(RUNS) out=$(OUT)
	@echo
	@echo "V-LSTM forecasts each agent alone, +SC all agents together, +EPO by a game that it infers. Smaller SADE and SFDE [m] are better."
	@echo "Expected in the first three rows: +EPO below +SC, and both far below V-LSTM. These rows are trained with a remedy against modes that are"
	@echo "never taught (docs/rpi_results.md). The last two rows have no remedy: with so little training, chance decides whether all modes learn."
	@echo "This was a tenth of the data and eight epochs. All data and twenty epochs take a quarter of an hour for each of nine runs:"
	@echo "  $(EPO) generate && $(EPO) sweep rpi_relaxed budget=long && $(EPO) report rpi_relaxed"

test: $(TESTABLE)
	$(BIN)/python -m pytest

test-slow: $(TESTABLE)
	$(BIN)/python -m pytest -m slow

smoke: $(TESTABLE)
	$(BIN)/python -m pytest -m 'slow or not slow' tests/experiment/test_smoke.py

# The kernel under AddressSanitizer and UndefinedBehaviorSanitizer, in a library of its own, built by Clang. One test limits the
# address space, of which the sanitizers reserve terabytes.
asan: $(TESTABLE)
	$(BIN)/python -m epo_lightning.solvers.gauss_newton.kernel.build --sanitize
	EPO_KERNEL=$(CURDIR)/$(KERNEL_FOLDER)/epo_kernel.sanitized.so.1 \
	LD_PRELOAD="$$(clang++ -print-file-name=libclang_rt.asan-$$(uname -m).so)" \
	ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
	$(BIN)/python -m pytest -n 0 tests/solvers/gauss_newton tests/solvers/feedback -k "not too_little_memory"

lint: $(TESTABLE)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# -W: a reference that leads nowhere ends it. BUILDER=dummy checks the site without writing it.
docs: $(DOCUMENTABLE)
	$(BIN)/python -m sphinx -q -W --keep-going -j auto -b $(BUILDER) docs build/docs

tables: $(patsubst results/%.json,docs/tables/%/results.md,$(wildcard results/*.json)) $(patsubst %.j2,%,$(wildcard docs/*.md.j2))

docs/%.md: docs/%.md.j2 $(wildcard results/*.json results/drive/*.json) $(INSTALLED)
	$(EPO) report template=$<

docs/tables/%/results.md: results/%.json $(INSTALLED)
	$(EPO) report results=$< out=build/tables/$* > /dev/null
	rm -rf $(@D) && mkdir -p $(@D)
	cp -r build/tables/$*/*.md $$(ls -d build/tables/$*/figures 2> /dev/null) $(@D)

checkpoint: $(TESTABLE)
	$(BIN)/python -m epo_lightning.experiment.ship $(NAME)

wheel: $(INSTALLED)
	$(BIN)/pip wheel -q --no-deps -w dist .

clean:
	rm -rf epo_lightning/solvers/gauss_newton/kernel/epo_kernel.* figures results.md results.csv results.tex comparisons.csv index.html build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
