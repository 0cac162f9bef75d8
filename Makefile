# make check: the first command for a change. make test: everything. make demo: see it work.
# Each sets itself up on a bare Debian/Ubuntu with Python 3.11+; check installs no system package.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
CLIENT_VENV := .venv-client-generator
CLIENT_STAMP := $(CLIENT_VENV)/.installed
BIN := $(VENV)/bin
PRODUCT := $(VENV)/.product
STAMP := $(VENV)/.stamp
export PYTHONDONTWRITEBYTECODE ?= 1

.DEFAULT_GOAL := help
.PHONY: help setup openni test-system check check-tests test verify tests lowest processors lint security types contracts documents docs planted demo bench load faults kills mutants fuzz sanitize sbom scan lock clean docker-test release bundle

demo:  ## two minutes: a virtual volunteer through the whole of Tidegate; KEEP=1 stays up, PORT=8080 another port
	@$(MAKE) --no-print-directory -j2 $(PRODUCT) openni
	@$(BIN)/tidegate demo $(if $(KEEP),--keep) $(if $(PORT),--port $(PORT))

test: $(STAMP) $(CLIENT_STAMP) test-system  ## every behaviour once: lint, types, contracts, the tests of `--stage test`
	@mkdir -p build; failed=; $(call OTHERS,lint security types contracts); $(MAKE) --no-print-directory tests STAGE=test || failed=" tests"; $(THEIRS)

verify: $(STAMP) $(CLIENT_STAMP) test-system  ## what takes longer: campaigns, whole programs, cameras, browsers on a real service; then how long each module took
	@$(MAKE) --no-print-directory tests STAGE=verify

lab: $(STAMP) $(CLIENT_STAMP) test-system  ## the lab (phantom, evaluation, bench), clusters, other processors' features
	@$(MAKE) --no-print-directory tests STAGE=lab

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

setup: $(STAMP) $(CLIENT_STAMP) openni  ## make .venv from the lock files, and the OpenNI2 runtime where it may

# uv installs what is locked in a tenth of pip's time; it does not read pip's settings, so a mirror is handed to it.
UV_INSTALL = mirror="$${UV_DEFAULT_INDEX:-$${PIP_INDEX_URL:-$$($(BIN)/pip config get global.index-url 2>/dev/null)}}"; \
	$${mirror:+env UV_DEFAULT_INDEX="$$mirror"} $(BIN)/uv pip install

$(BIN)/uv: requirements-dev.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed: $$($(PYTHON) --version) found"; exit 1; }
	@echo "Making $(VENV): Python, then the packages of the lock files"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "python3-venv is missing: apt-get install python3-venv"; exit 1; }
	@for one in uv setuptools; do sed -n "/^$$one==/,/[^\\\\]$$/p" requirements-dev.lock; done >$(VENV)/tools.lock
	@$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r $(VENV)/tools.lock
	@touch $@

# What runs: the packages of the room's lock, Tidegate itself, and the lab beside it.
$(PRODUCT): $(BIN)/uv requirements.lock requirements-lab.lock pyproject.toml setup.py lab/pyproject.toml $(wildcard engine/core/compiled/*.[ch])
	@$(UV_INSTALL) --python $(BIN)/python --require-hashes -r requirements.lock -r requirements-lab.lock
	@echo "Compiling the frame path"
	@$(UV_INSTALL) --quiet --python $(BIN)/python --no-deps --no-build-isolation --editable .
	@$(UV_INSTALL) --quiet --python $(BIN)/python --no-deps --no-build-isolation --editable ./lab
	@$(BIN)/python -c 'from engine.core.compiled import frame_path; print("Frame path:", frame_path())'
	@touch $@

# A generator of clients, for one test: it needs an older typer than the product.
$(CLIENT_STAMP): tests/client_generator.lock $(BIN)/uv
	@$(BIN)/uv venv --quiet --allow-existing --python $(BIN)/python $(CLIENT_VENV)
	@$(UV_INSTALL) --quiet --python $(CLIENT_VENV)/bin/python --require-hashes -r tests/client_generator.lock
	@touch $(CLIENT_STAMP)

$(STAMP): $(PRODUCT) requirements-dev.lock requirements-orbbec.lock
	@$(UV_INSTALL) --python $(BIN)/python --require-hashes -r requirements-dev.lock
	@$(UV_INSTALL) --quiet --python $(BIN)/python --no-deps --require-hashes -r requirements-orbbec.lock
	@touch $@

openni:
	@docker/install-debian-packages.sh libopenni2-0 || echo "Until then recordings are played by Tidegate's own reader; live cameras are not available."

# What the tests use for real beside the Python packages: the runtime, what a driver for it is built with, a browser.
test-system:
	@docker/install-debian-packages.sh libopenni2-0 libopenni2-dev g++ chromium poppler-utils rsyslog rsyslog-relp postgresql curl jq \
		nginx caddy libnss3-tools dcmtk dicom3tools orthanc mono-mcs mono-runtime libmono-system-net-http4.0-cil libmono-system-runtime-serialization4.0-cil libmono-system-xml-linq4.0-cil
	@docker/install-debian-packages.sh chromium-headless-shell || echo "Browser tests run chromium itself, which takes twice the time."

# Hundreds of services and engines are started here: each would compile the whole program anew.
demo check check-tests test verify lab tests: export PYTHONDONTWRITEBYTECODE :=

# Lint, types and contracts run beside the tests.
OTHERS = $(MAKE) --no-print-directory --keep-going $(1) >build/check.log 2>&1 & others=$$!; trap 'kill $$others' INT
THEIRS = wait $$others || failed+=" lint-types-contracts"; cat build/check.log; [ ! "$$failed" ] || { echo "FAILED:$$failed"; exit 1; }

check: $(STAMP)  ## two minutes, no system packages: lint, types, contracts and the fast tests of every package
	@mkdir -p build; failed=; $(call OTHERS,lint types contracts); $(MAKE) --no-print-directory check-tests || failed=" tests"; $(BIN)/python -m tests.support.documents.ages; $(THEIRS)

check-tests:
	$(BIN)/pytest --fast -q -n 2 --dist loadfile --durations=10

# Which test is of which stage and part: tests/support/selection.py. Every part runs, whatever came of those before it.
# Three processes on two cores where no time is judged: one of them often waits for a browser, a database or a service.
tests:
	@rm -rf build/tests/$(STAGE)-*; failed=; \
	part() { echo "-- $(STAGE), $$1"; $(BIN)/pytest -q --stage $(STAGE) --part $$* --junitxml build/tests/$(STAGE)-$$1.xml --durations=15 || failed+=" $$1"; }; \
	part computing -n 3 --dist loadfile --no-loadscope-reorder; [ $(STAGE) = lab ] || { part waiting -n 2 --dist loadfile --no-loadscope-reorder; part alone; }; \
	$(BIN)/python -m tests.support.documents.hazards $(STAGE) build/tests/$(STAGE)-*.xml || failed+=" named-in-safety.md"; \
	$(BIN)/python -m tests.support.durations build/tests/*.xml; \
	[ ! "$$failed" ] || { echo "FAILED:$$failed"; exit 1; }

# What pip may choose at the least: the run-time packages at their lower bounds, everything else as locked.
lowest: $(STAMP)  ## the fast tests with the oldest packages that pyproject.toml accepts
	@mkdir -p build; rm -rf build/lowest; $(BIN)/uv venv --quiet --python $(BIN)/python build/lowest
	@$(BIN)/uv pip compile --quiet --no-header --resolution lowest-direct pyproject.toml --output-file build/lowest.txt
	@cat requirements.lock requirements-lab.lock requirements-dev.lock | grep -oE '^[[:alnum:]_.-]+(\[[a-z]+\])?==[^ ]+' | sort -u >build/locked.txt
	@$(UV_INSTALL) --quiet --python build/lowest/bin/python -r build/locked.txt --override build/lowest.txt
	@$(UV_INSTALL) --quiet --python build/lowest/bin/python --no-deps --require-hashes -r requirements-orbbec.lock
	@$(UV_INSTALL) --quiet --python build/lowest/bin/python --no-deps --no-build-isolation --editable . --editable ./lab
	build/lowest/bin/pytest --fast -q -n 2 --dist loadfile --deselect verification/supply

processors: $(STAMP)  ## the numeric tests under other processor features (x86): no AVX-512, no AVX at all, numpy forms
	nice $(BIN)/python -m tests.support.processor_features -n 2 --dist loadfile

bench: $(STAMP)  ## how fast it is, against the marks, then two minutes of load; QUICK=1 is shorter, MINUTES=60 watches memory for an hour
	$(BIN)/tidegate bench $(if $(QUICK),--quick) $(if $(MINUTES),--memory-minutes $(MINUTES)) $(if $(OUT),--out $(OUT))
	$(BIN)/python -m verification.load --seconds $(if $(QUICK),30,120) $(if $(OUT),--out $(OUT)/load.json)
load: $(STAMP)  ## 200 dashboards, 50 requests a second and an export beside a session; MINUTES=60 for an hour, DASHBOARDS=n
	$(BIN)/python -m verification.load --minutes $(or $(MINUTES),2) --dashboards $(or $(DASHBOARDS),200) --out $(or $(OUT),build/load)/load.json
faults: $(STAMP) test-system  ## break the running service in every way, and judge by what the receiver saw; goes on where it was stopped
	$(BIN)/python -m verification.faults --seeds $(or $(SEEDS),40) --jobs $(or $(JOBS),2) --out $(or $(OUT),build/faults) $(if $(KINDS),--kinds $(KINDS)) $(if $(KEEP),--keep) $(if $(WRITE),--write)
kills: $(STAMP) test-system  ## kill -9 the running service at 200 random moments of its life, and look at what it left; goes on where it was stopped
	$(BIN)/python -m verification.kills --moments $(or $(MOMENTS),200) --jobs $(or $(JOBS),2) --seed $(or $(SEED),1) --out $(or $(OUT),build/kills) $(if $(DATABASE),--database $(DATABASE)) $(if $(KEEP),--keep) $(if $(WRITE),--write)
mutants: $(STAMP)  ## change all that decides in every small way: a test must fail; an interrupted run continues
	PATH="$(CURDIR)/$(BIN):$$PATH" nice -n 10 mutmut run --max-children $(or $(CHILDREN),1)
	$(BIN)/python -m verification.mutants.summary --write
fuzz: $(STAMP)  ## feed every reader of strangers' bytes what it does not expect: MINUTES=60 in all, TARGET=oni only that one
	nice -n 19 $(BIN)/python -m verification.fuzz --minutes $(or $(MINUTES),10) $(TARGET:%=--target %) $(if $(RECORD),--record)
sanitize: $(STAMP)  ## the compiled frame path's tests under the address and undefined-behaviour sanitizers (gcc)
	$(BIN)/python -m tests.support.sanitized
sbom: $(STAMP)  ## write what Tidegate is made of to docker/sbom.cdx.json (CycloneDX), held against the specification
	$(BIN)/python -m verification.supply.sbom
scan: $(STAMP)  ## bandit, ruff's security rules, known vulnerabilities of what is locked, licences
	$(BIN)/python -m verification.supply.scan

planted: $(STAMP)  ## break each mechanism of docs/2-clinical/safety.md once: the test that it names must fail
	nice -n 10 $(BIN)/python -m verification.planted
documents: $(STAMP)  ## write every part of the documents, of the client and of openapi/ that the code makes
	@$(BIN)/tidegate openapi --out openapi
	@for one in alarms audit_routes access_matrix clinical metrics problems qa safety client_models; do $(BIN)/python -m tests.support.documents.$$one --write || exit 1; done

docs-figures: $(STAMP)  ## measure each kind of breathing and each falsification on both sensors (an hour) and write the figures into the documents
	$(BIN)/tidegate evaluate --accuracy --out build/figures
	$(BIN)/tidegate evaluate budget --scenario regular --scenario isovolume --out build/figures
	$(BIN)/tidegate evaluate integrity --slow --in-turn --out build/figures
	$(BIN)/python -m tests.support.documents.figures build/figures

docs: $(STAMP)  ## the documentation as a site, build/docs/index.html
	$(BIN)/python -m sphinx -q -n -W --keep-going -b html docs build/docs && cp build/docs/README.html build/docs/index.html

lint: $(STAMP)  ## ruff, rules and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
security: $(STAMP)  ## bandit; ruff's security rules are in lint
	$(BIN)/bandit -q -c pyproject.toml -r engine service lab tidegate migrations 2>/dev/null
types: $(STAMP)  ## mypy --strict
	$(BIN)/mypy
contracts: $(STAMP)  ## import-linter: who may import whom
	$(BIN)/lint-imports

docker-test: $(STAMP)  ## as root: build the image, run a whole session in it, kill, upgrade, roll back, restore; BASE=, CA_BUNDLE=, IMAGE= (test one that is there)
	@docker/install-debian-packages.sh buildah iproute2 util-linux libopenni2-0
	$(BIN)/python -m verification.image $(if $(IMAGE),--image $(IMAGE)) $(if $(BASE),--base $(BASE)) $(if $(CA_BUNDLE),--ca-bundle $(CA_BUNDLE)) $(if $(OUT),--out $(OUT))

release: $(STAMP)  ## refuse what is not ready; else wheel, source archive, bill of materials and sums in dist/
	$(BIN)/python -m verification.release
bundle: $(STAMP)  ## KEY=FILE signs: one archive to install without a network; IMAGE=FILE brings an image archive along, TRY=1 installs it (root)
	@[ "$(KEY)" ] || { echo "KEY=FILE: the private SSH key that signs the bundle"; exit 1; }
	$(BIN)/python -m verification.bundle --key $(KEY) $(if $(IMAGE),--image $(IMAGE)) $(if $(OUT),--out $(OUT)) $(if $(TRY),--try)

PIP_COMPILE := $(BIN)/pip-compile -q --upgrade --strip-extras --generate-hashes --allow-unsafe --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-header
lock: $(STAMP)  ## resolve the newest versions into the lock files
	$(PIP_COMPILE) -o requirements.lock pyproject.toml
	$(PIP_COMPILE) --extra cluster -c requirements.lock -o requirements-cluster.lock pyproject.toml
	$(PIP_COMPILE) --extra realsense -c requirements.lock -o requirements-cameras.lock pyproject.toml
	echo matplotlib | $(PIP_COMPILE) -c requirements.lock --unsafe-package numpy -o requirements-lab.lock -
	$(PIP_COMPILE) --extra dev -c requirements.lock -o requirements-dev.lock pyproject.toml
	printf 'furo\nmyst-parser\nsphinx\n' | $(PIP_COMPILE) -c requirements-dev.lock -o requirements-docs.lock -
	$(PIP_COMPILE) -o tests/client_generator.lock tests/client_generator.in
clean:  ## remove what was built, keep recordings
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis mutants
