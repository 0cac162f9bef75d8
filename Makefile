# make check: the first command for a change. make test: everything. make demo: see it work.
# Each sets itself up on a bare Debian/Ubuntu with Python 3.11+; check installs no system package.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.stamp
export PYTHONDONTWRITEBYTECODE ?= 1

.DEFAULT_GOAL := help
.PHONY: help setup openni test-system check check-tests test tests-computing tests-waiting tests-alone tests-behind processors lint security types contracts openapi demo bench load faults kills mutants fuzz sanitize sbom scan safety lock clean docker-test docker-test-system release bundle

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

setup: $(STAMP) openni  ## make .venv from the lock file, and the OpenNI2 runtime where it may

$(STAMP): requirements-dev.lock pyproject.toml setup.py $(wildcard engine/core/compiled/*.[ch])
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed: $$($(PYTHON) --version) found"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "python3-venv is missing: apt-get install python3-venv"; exit 1; }
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-dev.lock
	PYTHONWARNINGS=ignore $(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@$(BIN)/python -c 'from engine.core.compiled import frame_path; print("Frame path:", frame_path())'
	@touch $(STAMP)

openni:
	@docker/install-debian-packages.sh libopenni2-0 || echo "Until then recordings are played by Tidegate's own reader; live cameras are not available."

# What the tests use for real beside the Python packages: the runtime, what a driver for it is built with, a browser.
test-system:
	@docker/install-debian-packages.sh libopenni2-0 libopenni2-dev g++ chromium poppler-utils rsyslog rsyslog-relp postgresql curl jq \
		nginx caddy libnss3-tools mono-mcs mono-runtime libmono-system-net-http4.0-cil libmono-system-runtime-serialization4.0-cil libmono-system-xml-linq4.0-cil
	@docker/install-debian-packages.sh chromium-headless-shell || echo "Browser tests run chromium itself, which takes twice the time."

# Four parts. One after the other: what computes and starts services and browsers, where no time is judged; then what starts
# services, kills them and waits; then, with a core to itself, what plays through the OpenNI2 runtime in the tests' own process: the
# runtime's own threads race where they are not run in time, and crash. Beside the last goes what trips an engine, or times a camera,
# in a process of its own in real time and needs little. What waits leaves a third of the processors idle: behind it goes the fourth part, numeric tests that
# start no service, judge no time and have no deadline, in the scheduler's idle class. It is interrupted at once by anything in
# front, where nice 10 was not, and sessions in real time were late; what has a deadline starved there.
ALONE := tests/engine/capture/openni tests/system/virtual_camera tests/system/service/test_real_engine.py \
	tests/service/engine_host/site_rules/test_uncalibrated.py tests/service/cli/test_recordings.py tests/system/tls
BESIDE := tests/campaigns/interlocks/test_live_run.py tests/system/beam_line/test_engine_on_wired_line.py \
	tests/system/virtual_camera/test_latency.py
WAITING := tests/campaigns/faults tests/campaigns/kills tests/campaigns/load tests/system/engine_process \
	tests/service/engine_host/process tests/service/web/stream/test_slow_clients.py tests/service/web/stream/test_over_tls.py \
	tests/system/browser/test_real_service.py tests/system/service/test_shutdown.py tests/system/service/test_process.py tests/system/service/test_folder_lock.py \
	tests/system/client/test_example_programs.py tests/system/client/test_real_service.py tests/system/client/test_whole_fractions.py \
	tests/system/beam_line/test_killed_processes.py tests/system/beam_line/test_qa_drill.py tests/system/beam_line/test_real_receivers.py tests/system/beam_line/test_service_line.py
# Threads that are waited for, for so many seconds, are not for what runs behind.
BEHIND := $(filter-out tests/engine/motion/test_pipeline_models.py tests/engine/motion/learning/test_learner.py \
	tests/engine/motion/learning/test_trainer.py tests/engine/motion/training_process/test_process_trainer.py tests/engine/verification/qa/test_drill.py \
	tests/engine/verification/qa/latency/test_light_driver.py tests/service/cli/test_measure_many.py \
	$(addsuffix /%,tests/engine/verification/performance),$(shell find tests/service/cli -name 'test_measure*.py'; \
	find tests/engine/calibration tests/engine/gating tests/engine/motion tests/engine/verification -name 'test_*.py'))
# In the order of tests/support/selection.py, the longest files first: by itself xdist begins with those of most tests.
BY_TWO := -n 2 --dist loadfile --no-loadscope-reorder
# Three processes on two cores, where no time is judged: one of them often waits for a browser, a database or a service.
BY_THREE := -n 3 --dist loadfile --no-loadscope-reorder
COMMA := ,
SPACE := $(subst ,, )
TIMINGS := build/timings
PART := $(BIN)/python -m tests.support.part
TEST_PARTS := tests-computing tests-waiting tests-alone
LOW_PRIORITY := nice -n 10
# Idle class within its session, and a session of least weight: services and browsers that tests start in sessions of their own
# would share the processors with it half and half.
IDLE_CLASS := setsid sh -c 'echo 19 2>/dev/null >/proc/self/autogroup; exec "$$@"' behind $(if $(shell command -v chrt),chrt --idle 0,nice -n 19)
# With nothing left in front: or a machine that does something else beside would leave it nothing.
AS_ANY_OTHER = { for one in $$(pgrep --session $$behind); do chrt --all-tasks --other --pid 0 $$one; done; echo 0 >/proc/$$behind/autogroup; } 2>/dev/null || true
# Hundreds of services and engines are started here: each would compile the whole program anew.
check check-tests test $(TEST_PARTS) tests-behind: export PYTHONDONTWRITEBYTECODE :=

# Lint, types and contracts run beside the tests. tests/support/selection.py says which tests are fast.
check: $(STAMP)  ## two minutes, no system packages: lint, types, contracts and the fast tests of every package
	@mkdir -p build; trap 'exit 130' INT; outcomes=; failed=0; \
	$(MAKE) --no-print-directory --keep-going lint types contracts >build/check.log 2>&1 & others=$$!; \
	$(MAKE) --no-print-directory check-tests && outcome=passed || { outcome=FAILED; failed=1; }; outcomes="fast tests: $$outcome"; \
	wait $$others && outcome=passed || { outcome=FAILED; failed=1; }; outcomes+=$$'\n'"lint, types, contracts: $$outcome"; \
	cat build/check.log; printf '\n%s\n' "$$outcomes"; exit $$failed

check-tests:
	$(BIN)/pytest --fast -q -n 2 --dist loadfile --durations=10

# Every part runs, whatever came of those before it; the slowest tests of all parts and a line per part come last.
# Lint, types and contracts run beside the first part, numeric tests behind the second and third: then, not beside the first, one
# that waits for a recording which the part behind makes leaves it a core. What runs in the background ignores an interrupt, and
# is killed by it.
test: $(STAMP) test-system  ## everything that must hold: lint, types, contracts, all tests
	@trap 'kill $$others $$behind; exit 130' INT; outcomes=; failed=0; behind=; rm -rf $(TIMINGS) build/unsteady.txt; mkdir -p build; \
	note() { if [ $$2 = 0 ]; then outcomes+="$$1: passed"$$'\n'; else outcomes+="$$1: FAILED"$$'\n'; failed=1; fi; }; \
	$(LOW_PRIORITY) $(MAKE) --no-print-directory --keep-going lint security types contracts >build/check.log 2>&1 & others=$$!; \
	for part in $(TEST_PARTS); do \
		$(MAKE) --no-print-directory $$part; note $$part $$?; \
		[ "$$behind" ] || { $(IDLE_CLASS) $(MAKE) --no-print-directory tests-behind >build/behind.log 2>&1 & behind=$$!; }; \
	done; \
	$(AS_ANY_OTHER); wait $$behind; note tests-behind $$?; cat build/behind.log; \
	wait $$others; note 'lint, types, contracts' $$?; cat build/check.log; \
	$(BIN)/python -m tests.support.documents.traceability --ran $(TIMINGS)/*.tsv; note 'tests named in safety.md' $$?; \
	$(BIN)/python -m tests.support.timings $(TIMINGS)/*.tsv; printf '\n%s' "$$outcomes"; \
	[ ! -e build/unsteady.txt ] || { echo 'UNSTEADY, failed beside others and passed alone:'; cat build/unsteady.txt; }; exit $$failed

tests-computing:
	@$(PART) computing $(BY_THREE) --leave-out $(subst $(SPACE),$(COMMA),$(strip $(ALONE) $(BESIDE) $(WAITING) $(BEHIND)))

tests-waiting:
	$(PART) waiting $(BY_TWO) $(WAITING)

tests-alone:
	@mkdir -p build; \
	$(PART) beside $(BESIDE) >build/beside.log 2>&1 & beside=$$!; \
	$(PART) alone --leave-out $(subst $(SPACE),$(COMMA),$(strip $(BESIDE))) $(ALONE); failed=$$?; \
	wait $$beside || failed=1; cat build/beside.log; exit $$failed

tests-behind:
	@$(PART) behind $(BY_TWO) -o timeout=3600 $(BEHIND)

processors: $(STAMP)  ## the numeric tests under other processor features (x86): no AVX-512, no AVX at all, numpy forms
	nice $(BIN)/python -m tests.support.processor_features $(BY_TWO)

demo: $(STAMP) openni  ## a 60 s volunteer through the whole of Tidegate; KEEP=1 stays up, PORT=8080 another port
	$(BIN)/tidegate demo $(if $(KEEP),--keep) $(if $(PORT),--port $(PORT))

bench: $(STAMP)  ## how fast it is, against the marks, then two minutes of load; QUICK=1 is shorter, MINUTES=60 watches memory for an hour
	$(BIN)/tidegate bench $(if $(QUICK),--quick) $(if $(MINUTES),--memory-minutes $(MINUTES)) $(if $(OUT),--out $(OUT))
	$(BIN)/python -m tests.campaigns.load --seconds $(if $(QUICK),30,120) $(if $(OUT),--out $(OUT)/load.json)

load: $(STAMP)  ## 200 dashboards, 50 requests a second and an export beside a session; MINUTES=60 for an hour, DASHBOARDS=n
	$(BIN)/python -m tests.campaigns.load --minutes $(or $(MINUTES),2) --dashboards $(or $(DASHBOARDS),200) --out $(or $(OUT),build/load)/load.json

faults: $(STAMP) test-system  ## break the running service in every way, and judge by what the receiver saw; goes on where it was stopped
	$(BIN)/python -m tests.campaigns.faults --seeds $(or $(SEEDS),40) --jobs $(or $(JOBS),2) --out $(or $(OUT),build/faults) $(if $(KINDS),--kinds $(KINDS)) $(if $(KEEP),--keep) $(if $(WRITE),--write)

kills: $(STAMP) test-system  ## kill -9 the running service at 200 random moments of its life, and look at what it left; goes on where it was stopped
	$(BIN)/python -m tests.campaigns.kills --moments $(or $(MOMENTS),200) --jobs $(or $(JOBS),2) --seed $(or $(SEED),1) --out $(or $(OUT),build/kills) $(if $(DATABASE),--database $(DATABASE)) $(if $(KEEP),--keep) $(if $(WRITE),--write)

mutants: $(STAMP)  ## change all that decides in every small way: a test must fail; an interrupted run continues
	PATH="$(CURDIR)/$(BIN):$$PATH" nice -n 10 mutmut run --max-children $(or $(CHILDREN),1)
	$(BIN)/python -m tests.campaigns.mutants.summary --write

clean-mutants:
	rm -rf mutants

fuzz: $(STAMP)  ## feed every reader of strangers' bytes what it does not expect: MINUTES=60 in all, TARGET=oni only that one
	nice -n 19 $(BIN)/python -m tests.campaigns.fuzz --minutes $(or $(MINUTES),10) $(TARGET:%=--target %) $(if $(RECORD),--record)

sanitize: $(STAMP)  ## the compiled frame path's tests under the address and undefined-behaviour sanitizers (gcc)
	$(BIN)/python -m tests.support.sanitized

sbom: $(STAMP)  ## write what Tidegate is made of to docker/sbom.cdx.json (CycloneDX), held against the specification
	$(BIN)/python -m tests.campaigns.supply.sbom

scan: $(STAMP)  ## bandit, ruff's security rules, known vulnerabilities of what is locked, licences
	$(BIN)/python -m tests.campaigns.supply.scan

safety: $(STAMP)  ## write the tables of docs/2-clinical/safety.md; PLANTED=1 breaks each mechanism: its test must fail
	$(BIN)/python -m tests.support.documents.safety --write
	@if [ "$(PLANTED)" ]; then nice -n 10 $(BIN)/python -m tests.campaigns.planted.planted; fi

openapi: $(STAMP)  ## write the contract to openapi/
	$(BIN)/tidegate openapi --out openapi

lint: $(STAMP)  ## ruff, rules and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

security: $(STAMP)  ## bandit; ruff's security rules are in lint
	$(BIN)/bandit -q -c pyproject.toml -r engine service migrations 2>/dev/null

types: $(STAMP)  ## mypy --strict
	$(BIN)/mypy

contracts: $(STAMP)  ## import-linter: who may import whom
	$(BIN)/lint-imports

docker-test-system:
	@docker/install-debian-packages.sh buildah iproute2 util-linux libopenni2-0

docker-test: $(STAMP) docker-test-system  ## as root: build the image, run a whole session in it, kill, upgrade, roll back, restore; BASE=, CA_BUNDLE=, IMAGE= (test one that is there)
	$(BIN)/python -m tests.campaigns.image $(if $(IMAGE),--image $(IMAGE)) $(if $(BASE),--base $(BASE)) $(if $(CA_BUNDLE),--ca-bundle $(CA_BUNDLE)) $(if $(OUT),--out $(OUT))

release: $(STAMP)  ## refuse what is not ready; else wheel, source archive, bill of materials and sums in dist/
	$(BIN)/python -m tests.campaigns.release

bundle: $(STAMP)  ## KEY=FILE signs: one archive to install without a network; IMAGE=FILE brings an image archive along, TRY=1 installs it (root)
	@[ "$(KEY)" ] || { echo "KEY=FILE: the private SSH key that signs the bundle"; exit 1; }
	$(BIN)/python -m tests.campaigns.bundle --key $(KEY) $(if $(IMAGE),--image $(IMAGE)) $(if $(OUT),--out $(OUT)) $(if $(TRY),--try)

lock: $(STAMP)  ## resolve the newest versions into the lock files
	$(BIN)/pip-compile -q --upgrade --strip-extras --generate-hashes --allow-unsafe --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-header -o requirements.lock pyproject.toml
	$(BIN)/pip-compile -q --upgrade --extra cluster --strip-extras --generate-hashes --allow-unsafe --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-header -c requirements.lock -o requirements-cluster.lock pyproject.toml
	$(BIN)/pip-compile -q --upgrade --extra dev --strip-extras --generate-hashes --allow-unsafe --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-header -c requirements.lock -o requirements-dev.lock pyproject.toml

clean:  ## remove what was built, keep recordings
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
