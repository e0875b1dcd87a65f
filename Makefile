# Everything runs inside .venv, installed from the lock files; nothing else is touched.
# Without a network: PIP_NO_INDEX=1 PIP_FIND_LINKS=/folder/of/wheels make ...
PYTHON ?= python3
BIN := .venv/bin
# Files among processes (tests/conftest.py says how many), each with one thread for matrices: more
# threads wait for each other.
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n logical --dist loadfile --no-loadscope-reorder
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet

.PHONY: help demo test short peers check quick style imports types physics hooks format docs pictures bench battery soak fuzz audit coverage clean

help:  ## say what there is (this)
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

demo: .venv/run  ## a simulated PLC, a live twin beside it, a leak that opens half-way
	$(BIN)/python tools/demo.py

test: .venv/dev  ## the whole test suite
	$(PYTEST)

short: .venv/dev  ## the tests that are not marked slow, in some ten minutes
	$(PYTEST) -m "not slow"

# What the tests speak to, if it is there: a broker, a browser, PLCs of other make.
peers:  ## a broker, a browser and PLCs of other make for the tests
	$(PYTHON) tests/needs.py

check: quick  ## what CI runs: format, lint, types, import contracts, tests
	$(PYTEST)

quick: style imports types physics  ## the same without the tests

style: .venv/dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

imports: .venv/dev
	$(BIN)/lint-imports

types: .venv/dev
	$(BIN)/mypy

physics: .venv/dev
	$(BIN)/basedpyright --pythonpath $(BIN)/python

hooks:  ## let git run make quick before each commit
	git config core.hooksPath tools/hooks

format: .venv/dev  ## format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: .venv/dev  ## the documentation as pages in site/, its notebooks run anew
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --fresh-env --quiet docs site
	@echo "open site/index.html"

# Those that need neither a run beside them nor many minutes; CONTRIBUTING.md has the others.
pictures: .venv/dev  ## pictures of the documentation, as far as one command makes each
	$(BIN)/python tools/architecture.py
	$(BIN)/python tools/measured_gripper.py
	$(BIN)/python tools/trend_picture.py docs/pictures/trend.png
	$(BIN)/python tools/overview_picture.py docs/pictures/all-ejectors.png

bench: .venv/dev  ## how fast it is, beside a floor in the same run
	$(BIN)/python tools/bench.py

# One thread for matrices, as the command line has it: more wait for each other.
battery: .venv/dev  ## how often hidden effects are found, in two worlds (hours)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tools/battery.py --cases battery.jsonl --write docs/battery.md

soak: .venv/dev  ## what grows in a day of compressed time (HOURS=24) and an hour of real time (REAL_HOURS=1)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tools.soak --hours $(or $(HOURS),24) --real-hours $(or $(REAL_HOURS),1)

fuzz: .venv/dev  ## ten million damaged inputs for all that decodes bytes from elsewhere, a night (INPUTS=100_000)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tools.fuzz --inputs $(or $(INPUTS),10_000_000)

audit: .venv/dev .venv/audit/done  ## materials, licences, known weaknesses (without a network: ADVISORIES=all.zip of osv.dev)
	$(BIN)/python tools/audit.py audit $(if $(ADVISORIES),--advisories '$(ADVISORIES)')

coverage: .venv/dev  ## which branches the tests take, also in processes that they start
	$(PYTEST) --cov --cov-report=json:coverage.json --cov-report=
	$(BIN)/python tools/coverage_table.py coverage.json

clean:  ## take away what was made here
	rm -rf .venv demo site audit coverage.json .coverage* twin/page/node_modules

.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "ejector-twin needs Python 3.11 or newer; say which with: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv .venv \
		|| { echo "Python cannot make a virtual environment; on Debian or Ubuntu: apt install python3-venv"; exit 2; }

.venv/run: .venv/bin/python requirements.lock pyproject.toml hatch_build.py twin/page/package-lock.json
	$(PIP) --require-hashes -r requirements.lock
	$(PIP) --no-build-isolation --no-deps --editable .
	@test -d twin/page/node_modules/uplot \
		|| echo "npm is missing or reached no registry: twin serve does not start, all else does (docs/installation.md)"
	$(BIN)/python -m compileall -q twin drivers
	touch $@

.venv/service: .venv/run requirements-service.lock
	$(PIP) --require-hashes -r requirements-service.lock
	touch $@

.venv/dev: .venv/run requirements-dev.lock
	$(PIP) --require-hashes -r requirements-dev.lock
	touch $@

.venv/audit/done: .venv/bin/python requirements-audit.lock
	$(PYTHON) -m venv .venv/audit
	.venv/audit/bin/python -m pip --disable-pip-version-check install --quiet --require-hashes -r requirements-audit.lock
	touch $@
