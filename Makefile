# From nothing but Python 3.11 to 3.14 and make: `make demo` and `make test` set up what they need.

PYTHON ?= $(firstword $(shell command -v python3.11 python3.12 python3.13 python3.14 python3))
VENV   ?= .venv
BIN    := $(VENV)/bin
RUNS   := $(VENV)/.runs
READY  := $(VENV)/.ready
DOCS   := $(VENV)/.docs-ready
OUT    ?= out/demo
SOURCES = src tests $(wildcard benchmarks examples docs tools ros2)

.PHONY: help setup demo test quick mutate fuzz lint format types layers check bench scenario-table pages notebooks docs dist release lock clean

help:
	@echo "make demo    the paper's experiment and a tall bottle, planned, checked and simulated; pages in $(OUT)"
	@echo "make test    run the tests"
	@echo "make quick   the tests for every day, a little over a minute on two cores"
	@echo "make mutate  do the tests notice wrong changes? N=300 SEED=0 MODULE=salver.models TESTS=tests/models/arm/test_arm.py"
	@echo "make fuzz    what becomes of inputs that nobody means? N=600 SEED=0 MINUTES=60 ONLY=\"urdf journal\""
	@echo "make check   lint, types and import layers"
	@echo "make bench   run the speed benchmarks and write docs/performance.md"
	@echo "make scenario-table   docs/scenarios.md: the shortest safe durations, checked in the engine"
	@echo "make pages   write options, keys and names of the program into the pages of docs/ again"
	@echo "make notebooks   run the notebooks and keep them with their outputs"
	@echo "make docs    build the documentation into site/"
	@echo "make dist    build wheel and sdist into dist/, the same bytes each time"
	@echo "make release is HEAD tagged as its version, and does the wheel do what the README says? PYTHONS=\"python3.11 python3.13\""
	@echo "make lock    resolve the dependencies again"
	@echo "make clean   remove what was built (the virtual environment too)"

setup: $(READY)

# What a user has, then what the tests and tools need.
$(RUNS): requirements.lock pyproject.toml
	@"$(PYTHON)" -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info[:2] <= (3, 14) else "salver needs Python 3.11 to 3.14; name one with: make PYTHON=/path/to/python3.11")'
	"$(PYTHON)" -m venv $(VENV)
	$(BIN)/python -m pip install -qq --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-deps --no-build-isolation -e .
	rm -rf $(VENV)/lib/python3*/site-packages/cmeel.prefix/include # 200 MB of Pinocchio's C++ headers
	@touch $@

$(READY): $(RUNS) requirements-dev.lock
	$(BIN)/python -m pip install -qq --disable-pip-version-check --require-hashes -r requirements-dev.lock
	@touch $@

$(DOCS): $(READY) requirements-docs.lock
	$(BIN)/python -m pip install -qq --disable-pip-version-check --require-hashes -r requirements-docs.lock
	@touch $@

demo: $(RUNS)
	$(BIN)/salver demo -o $(OUT)

# One worker for each core, so one thread of linear algebra for each worker; compiled once, for all the processes that
# tests start.
PYTEST = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --dist worksteal

test: $(READY)
	$(PYTEST)

quick: $(READY)
	$(PYTEST) -m "not slow"

mutate: $(READY)
	$(BIN)/python tools/mutate.py -n $(or $(N),300) --seed $(or $(SEED),0) $(addprefix --module ,$(MODULE)) $(addprefix --tests ,$(TESTS))

fuzz: $(READY)
	$(BIN)/python tools/fuzz -n $(or $(N),600) --seed $(or $(SEED),0) $(addprefix --minutes ,$(MINUTES)) $(addprefix --only ,$(ONLY))

lint: $(READY)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)

format: $(READY)
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

types: $(READY)
	$(BIN)/mypy

layers: $(READY)
	$(BIN)/lint-imports --no-logo

check: lint types layers

bench: $(READY)
	$(BIN)/python docs/make_performance.py

scenario-table: $(READY)
	$(BIN)/python benchmarks/scenario_table.py docs/scenarios.md

pages: $(READY)
	$(BIN)/python docs/make_pages.py

notebooks: $(READY)
	$(BIN)/python docs/make_notebooks.py

docs: $(DOCS)
	$(BIN)/python docs/make_figures.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@! grep -rnoE '<(script|link|img|iframe)[^>]*(src|href)="?(https?:)?//[^ >]*' site --include='*.html' | grep -v 'rel="canonical"' || { echo 'the site would ask other servers' >&2; exit 1; }
	@echo "Open site/index.html"

PYTHONS ?= $(PYTHON)

dist release: $(READY)
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python tools/dist.py $(if $(filter release,$@),--release $(PYTHONS))

LOCK = $(BIN)/uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
  --no-emit-find-links --custom-compile-command "make lock" --quiet

lock: $(READY)
	$(BIN)/python -m pip install -qq --disable-pip-version-check uv
	$(LOCK) pyproject.toml --extra full --group dev -o requirements-dev.lock
	$(LOCK) pyproject.toml --extra full --group build -c requirements-dev.lock -o requirements.lock
	$(LOCK) --group docs -c requirements-dev.lock -o requirements-docs.lock

clean:
	rm -rf $(VENV) build dist site out .mypy_cache .pytest_cache .ruff_cache .import_linter_cache
