# Two commands matter: `make demo` and `make test`. Each installs what it needs first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PACKAGES := $(VENV)/.packages
STAMP := $(VENV)/.installed
export OPENBLAS_NUM_THREADS ?= 1
# Else pytest rewrites every test, and each process of a test compiles its modules, in every run.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help install demo up down test test-all faults containers soak day year mutants validate lint tables docs dist matrix coverage bench lock clean

help: ## list the commands
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

install: $(STAMP) ## make .venv from pinned, hashed requirements

# Unpacking takes a processor: two at a time take parts of the pinned packages, a quarter each.
PARTS := $(VENV)/parts
$(PACKAGES): requirements/dev.txt pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed; set PYTHON=…")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV), a few minutes the first time"
	rm -rf $(PARTS) && mkdir $(PARTS)
	awk '/^[a-z]/ { n++ } { print > ("$(PARTS)/" n % 4 ".txt") }' requirements/dev.txt
	ls $(PARTS)/* | xargs -P 2 -n 1 $(BIN)/python -m pip install --quiet --no-compile --no-deps --require-hashes -r
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --no-index -e .
	$(BIN)/python -m pip check --quiet
	@touch $@

# numba inlines kernels of one file into another's and would not see that they have changed.
$(STAMP): $(PACKAGES) $(wildcard pre_core/*.py pre_core/*/*.py services/simulation/two_sided*.py)
	@$(BIN)/python -m services.simulation.warm_up & $(BIN)/python -m services.execution.warm_up; wait
	@touch $@

demo: $(STAMP) ## a truck crosses a bridge: simulated, recorded, identified, drawn
	$(BIN)/driveby demo

up: ## the demo's services as containers (Docker Engine 26.0, Compose 2.26)
	@$(PYTHON) docs/scripts/container_versions.py
	docker compose build
	if docker volume inspect $${COMPOSE_PROJECT_NAME:-driveby}_certs >/dev/null 2>&1; \
	then docker compose run --rm certs certs certs; else docker compose run --rm certs; fi
	docker compose up --detach --wait worker
	docker compose up --detach truck

down: ## end the containers; recordings, results, spools and certificates stay in their volumes
	docker compose --profile '*' down --remove-orphans

# On two cores: two workers compute while the third waits for processes (tests/groups.py).
BESIDE := -n 3 --dist loadgroup

test: $(STAMP) ## the default tests (8 to 12 minutes on 2 cores)
	$(BIN)/python -m pytest $(BESIDE)

test-all: $(STAMP) ## the default tests and the slow ones
	$(BIN)/python -m pytest $(BESIDE) -m "slow or not slow"

faults: $(STAMP) ## everything that tries to lose or break data, but the soak (20 to 30 minutes)
	$(BIN)/python -m pytest tests/faults -m "not soak" --session-timeout=2400

containers: $(STAMP) ## make up, faults, limits, upgrade, cluster, wheels in an engine of containers (an hour)
	$(BIN)/python -m pytest tests/containers -m containers

KILLS ?= 50
MINUTES ?= 60
soak: $(STAMP) ## 50 kills of each kind and an hour of 100 trucks (KILLS=50 MINUTES=60)
	DRIVEBY_SOAK_KILLS=$(KILLS) DRIVEBY_SOAK_MINUTES=$(MINUTES) $(BIN)/python -m pytest tests/faults -m soak -s

day: $(STAMP) ## two trucks for an hour, a worker that is killed: one result per crossing (MINUTES=60)
	$(BIN)/python -m tests.faults.day --minutes $(MINUTES)

year: $(STAMP) ## a year of a fleet: 12 bridges, seasons, a loss, a repair: the right alarms (a minute)
	rm -rf build/year
	$(BIN)/python -m tests.faults.year --out build/year

MUTANTS ?= 40
SEED ?= 1
mutants: $(STAMP) ## do the tests see a wrong token? (MUTANTS=40 SEED=1, hours; goes on where it ended)
	$(BIN)/python -m tests.mutants.run --mutants $(MUTANTS) --seed $(SEED)

WORLDS ?= 64
validate: $(STAMP) ## is the uncertainty true: tables, figure, docs/validation.md (long)
	mkdir -p build
	$(BIN)/driveby validate --method pre --out-of-model $(WORLDS) --records build/worlds.jsonl --json build/validation.json --figures docs/images --page docs/validation.md

lint: $(PACKAGES) ## format, lint, types and import contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

tables: $(STAMP) ## write the tables of the pages and the JSON schemas that follow from code
	$(BIN)/python docs/scripts/tables.py
	$(BIN)/python -m schemas.json.generate

docs: $(STAMP) ## the pages as a site, in build/site
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/docs.txt
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	@echo "build/site/index.html"

dist: $(STAMP) ## wheel and source archive of the commit, in build/dist; the same bytes each time
	rm -rf build/dist build/source
	mkdir -p build/source
	git archive HEAD | tar -x -C build/source
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python docs/scripts/distribution.py build/source build/dist
	rm -rf build/source

PYTHONS ?= $(shell for v in 3.11 3.12 3.13 3.14; do command -v python$$v; done)
matrix: dist ## the wheel and a selection of tests on every Python found, newest and lowest versions
	$(BIN)/python -m tests.matrix build/dist/*.whl $(PYTHONS:%=--python %) --versions newest lowest

# Compiled kernels are invisible to coverage.py; tests of their formulas run them as Python.
INTERPRETED := tests/numerics/test_beam.py tests/numerics/test_lines.py tests/numerics/test_pre_sinc.py tests/numerics/test_splines.py tests/numerics/test_vehicle.py
coverage: $(STAMP) ## branch coverage of the default tests, into studies/coverage.md (half an hour)
	rm -rf build/coverage
	$(BIN)/coverage run -m pytest $(BESIDE)
	NUMBA_DISABLE_JIT=1 $(BIN)/coverage run -m pytest $(INTERPRETED)
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage json --quiet
	$(BIN)/python -m tests.coverage_page build/coverage/coverage.json studies/coverage.md

bench: $(STAMP) ## time everything, with its peers, into studies/benchmarks.md (12 minutes)
	$(BIN)/python -m tests.benchmarks.report

lock: ## write the pinned requirements anew (needs uv)
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --extra all pyproject.toml -o requirements/runtime.txt
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate -c requirements/runtime.txt --extra identify --extra history --extra s3 --extra ros2 --extra cluster pyproject.toml -o requirements/service.txt
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate -c requirements/runtime.txt pyproject.toml -o requirements/truck.txt
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --extra dev pyproject.toml -o requirements/dev.txt
	sed -n '/^docs = \[/,/^]/s/^ *"\(.*\)",.*/\1/p' pyproject.toml | uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate -c requirements/dev.txt - -o requirements/docs.txt
	echo 'setuptools>=77' | uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate - -o requirements/build.txt

clean: ## remove the environment and every cache
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
