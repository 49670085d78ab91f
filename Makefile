# One command a stage. `make help` lists them; ARGS passes any setting on, e.g.
#   make train OBJECT=connecting_rod ARGS="trainer.max_epochs=20 seed=1"

PYTHON ?= $(or $(shell command -v python3.11 2>/dev/null),$(shell command -v python3 2>/dev/null),python3.11)
VENV := .venv
PY := $(VENV)/bin/python
# Younger than what it was made from = the environment is complete and up to date.
STAMP := $(VENV)/.setup-complete
# Of the installed packages a fifth that is hardly ever imported here.
UNUSED := /(tests?|torch/(testing|_inductor)|ray/(data|llm|rllib|serve|train|tune)|databricks|plotly/graph_objs|fontTools)/

OBJECT ?=
OBJECTS ?=
TABLE ?=
ROWS ?=
NAME ?=
MESH ?=
UNITS ?=
BODY ?=
SENSOR ?=
BIN ?=
DISTANCE ?=
CAMERA ?=
RUN ?=
TRIALS ?=
TO ?=
VERSION ?=
DIR ?=
ARGS ?=
PYTEST_ARGS ?=
# A folder of your own with configuration files, and modules that they name (docs/variants.md).
CONF ?=
ifneq ($(CONF),)
export ATTENTIONVOTE_CONF := $(abspath $(CONF))
endif
object := $(if $(OBJECT),object=$(OBJECT))
# Of a new part's cell.
cell = $(if $(SENSOR),sensor=$(SENSOR)) $(if $(BIN),"bin='$(BIN)'") $(if $(DISTANCE),distance=$(DISTANCE)) $(if $(CAMERA),"camera='$(CAMERA)'")
# Of one training, each with a GPU of its own (docs/several-processes.md).
PROCESSES ?=
several := $(if $(PROCESSES),pipelines/start_processes.py --standalone --nproc-per-node=$(PROCESSES))

smoke_object = $(or $(OBJECT),connecting_rod)
bundle := outputs/export/$(OBJECT)/latest
# A bundle's folder is named after its part: said before any set-up.
needs_object := $(filter serve bench-serve,$(MAKECMDGOALS))
ifneq ($(needs_object),)
ifeq ($(OBJECT),)
$(error OBJECT must be given, e.g. make $(firstword $(needs_object)) OBJECT=connecting_rod)
endif
endif

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup system train sweep fleet benchmark smoke export evaluate promote rollback reproduce history prune score serve keys bench bench-serve image generate view check-data write-data part ui test test-fast lint format clean

help: ## Show this list
	@awk 'BEGIN {FS = ":.*## "} /^[a-z-]+:.*## / {printf "  %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP) ## Create .venv with the pinned dependencies (every other target does it when needed)

$(STAMP): pyproject.toml constraints.txt
	@$(MAKE) --no-print-directory system
	@echo "setup: installing the pinned dependencies into $(VENV) (once, some minutes)" >&2
	@$(PY) -m pip --version >/dev/null 2>&1 || "$(PYTHON)" -m venv $(VENV) >&2
	@$(PY) -m pip install --disable-pip-version-check --no-input --no-compile -c constraints.txt \
		-e '.[train,cad,cluster,team,benchmark,dev]' >&2 \
		|| { echo "setup: the installation failed (pip's reason is above); run the same command to try again" >&2; exit 1; }
	@# pip would compile on one core, and all of it; what is left out or fails is compiled when it is imported.
	@$(PY) -m compileall -qq -j 0 -x '$(UNUSED)' $(VENV)/lib >&2 || true
	@touch $@

# The wheels bring their own libraries (checked with ldd): what the system must have is a Python 3.11 with
# venv and a C compiler for geometry/pointops.c.
system:
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || { \
		echo "setup: Python 3.11 is needed, found $$("$(PYTHON)" --version 2>/dev/null || echo none);" \
		"install it (Debian: python3.11) or name it, PYTHON=/path/to/python3.11" >&2; exit 1; }
	@"$(PYTHON)" -c 'import venv, ensurepip' 2>/dev/null || { \
		echo "setup: Python's venv module is missing; install it (Debian: python3.11-venv)" >&2; exit 1; }
	@echo '#include <math.h>' | cc -E - >/dev/null 2>&1 || { \
		echo "setup: a C compiler with headers (cc) is missing; install it (Debian: gcc libc6-dev)" >&2; exit 1; }
	@"$(PYTHON)" -c 'import ctypes; ctypes.CDLL("libstdc++.so.6")' 2>/dev/null || { \
		echo "setup: the library libstdc++.so.6 is missing; install it (Debian: libstdc++6)" >&2; exit 1; }
	@"$(PYTHON)" -c 'import ctypes; ctypes.CDLL("libusb-1.0.so.0")' 2>/dev/null || { \
		echo "setup: the library libusb-1.0.so.0, which Open3D loads, is missing;" \
		"install it (Debian: libusb-1.0-0)" >&2; exit 1; }

train: $(STAMP) ## Train, test and track a model: OBJECT=connecting_rod [PROCESSES=8] [ARGS="experiment=paper ..."]; resumes
	@$(PY) $(several) pipelines/train.py $(object) $(ARGS)

sweep: $(STAMP) ## Search the settings that train best: OBJECT=connecting_rod [TRIALS=30 ARGS="workers=2 save_as=rod"]
	@$(PY) pipelines/sweep.py $(object) $(if $(TRIALS),trials=$(TRIALS)) $(ARGS)

fleet: $(STAMP) ## One model a part, and a leaderboard: OBJECTS=all or gear,brick [ARGS="experiment=paper workers=2"]
	@$(PY) pipelines/fleet.py $(if $(OBJECTS),"objects='$(OBJECTS)'") $(ARGS)

benchmark: $(STAMP) ## The paper's numbers beside ours: TABLE=3..9, fig8 or fig11 [OBJECTS=gear,brick ARGS="train=true"]
	@$(PY) pipelines/benchmark.py $(if $(TABLE),table=$(if $(filter fig%,$(TABLE)),$(TABLE:fig%=figure_%),table_$(TABLE))) \
		$(if $(OBJECTS),"objects='$(OBJECTS)'") $(ARGS)

smoke: $(STAMP) ## The whole chain on tiny settings, at most 3 minutes on 2 cores: scenes, training, export, champion, a cell's check
	@$(PY) pipelines/train.py object=$(smoke_object) experiment=smoke $(ARGS)
	@$(PY) pipelines/export.py object=$(smoke_object) trained=outputs/smoke/train root=outputs/smoke/data \
		outputs=outputs/smoke/export signing_keys=outputs/smoke/keys scenes=3 limits.scenes=3 golden=1
	@$(PY) pipelines/promote.py object=$(smoke_object) simulation=smoke evaluation.cycles=3 root=outputs/smoke/data \
		bundles=outputs/smoke/export trusted_key=outputs/smoke/keys/signing.pub tracking.store=outputs/smoke/mlflow.db \
		"gates={scenes:3,floors:{ap_10:0,precision_10:0,recall_10:0},parity:{scenes:3},provenance:[data,signature]}"
	@$(VENV)/bin/attentionvote verify-bundle outputs/smoke/export/$(smoke_object)/latest \
		--key outputs/smoke/keys/signing.pub --self-test >&2

export: $(STAMP) ## Prove the trained model equal to one ONNX file, sign the bundle: OBJECT=connecting_rod [RUN=...]
	@$(PY) pipelines/export.py $(object) $(if $(RUN),"run='$(RUN)'") $(ARGS)

evaluate: $(STAMP) ## Measure the exported model as cells run it, on a frozen set it has never seen: OBJECT=connecting_rod
	@$(PY) pipelines/evaluate.py $(object) $(ARGS)

promote: $(STAMP) ## Register the exported model, make it champion if every gate holds: OBJECT=connecting_rod
	@$(PY) pipelines/promote.py $(object) $(ARGS)

rollback: $(STAMP) ## Bring the champion before back, or a former one: OBJECT=connecting_rod [TO=3]
	@$(PY) pipelines/rollback.py $(object) $(if $(TO),to=$(TO)) $(ARGS)

reproduce: $(STAMP) ## Make a registered version again and compare: OBJECT=connecting_rod [VERSION=3]
	@$(PY) pipelines/reproduce.py $(object) $(if $(VERSION),version=$(VERSION)) $(ARGS)

history: $(STAMP) ## Show who moved the champion, when, from where to where, and why: OBJECT=connecting_rod
	@$(PY) pipelines/history.py $(object) $(ARGS)

prune: $(STAMP) ## Show data, trainings and bundles that nobody refers to, with sizes: [ARGS=remove=true removes them]
	@$(PY) pipelines/prune.py $(ARGS)

score: $(STAMP) ## Score any method's result files, Sileane's or BOP's: ARGS="gt=DIR results=DIR poseutils=FILE"
	@$(PY) pipelines/score.py $(ARGS)

serve: $(STAMP) ## Serve the newest bundle on this machine, as a cell does: OBJECT=connecting_rod [ARGS="--port 8080"]
	@$(VENV)/bin/attentionvote serve $(bundle) $(ARGS)

keys: $(STAMP) ## Make the pair of keys that signs bundles (export does it when there is none)
	@$(VENV)/bin/attentionvote keys $(ARGS)

bench: $(STAMP) ## Every fast path beside its reference, in one run: [ROWS=ball-query,normals ARGS="rounds=7"]
	@$(PY) pipelines/bench.py $(if $(ROWS),"rows='$(ROWS)'") $(ARGS)

bench-serve: $(STAMP) ## Load the server with 4 clients for a minute: OBJECT=connecting_rod [ARGS="--seconds 60"]
	@$(PY) pipelines/bench_serve.py $(bundle) $(ARGS)

image: ## Build the cell's container image with docker or buildah: [BASE=... ARGS=NAME]
	@docker/build.sh $(ARGS)

generate: $(STAMP) ## Drop parts into a bin by physics and keep the scenes: OBJECT=connecting_rod
	@$(PY) pipelines/generate.py $(object) $(ARGS)

view: $(STAMP) ## Write an interactive 3D page and pictures of a scene: OBJECT=connecting_rod
	@$(PY) pipelines/view.py $(object) $(ARGS)

check-data: $(STAMP) ## Look at a dataset (IPA, Sileane or BOP layout): what it is and what is wrong with it: DIR=data/ipa
	@$(PY) pipelines/check_data.py $(if $(DIR),"directory='$(DIR)'") $(ARGS)

write-data: $(STAMP) ## Write generated scenes as IPA or BOP data: OBJECT=gear [ARGS="format=bop split=test"]
	@$(PY) pipelines/write_data.py $(object) $(ARGS)

part: $(STAMP) ## Add your own part: NAME=bracket MESH=bracket.step [UNITS=mm BODY=1 SENSOR=phoxi_m BIN=360x280x160 DISTANCE=800]
	@$(PY) pipelines/part.py $(if $(NAME),name=$(NAME)) $(if $(MESH),"mesh='$(MESH)'") $(if $(UNITS),units=$(UNITS)) \
		$(if $(BODY),body=$(BODY)) $(cell) $(ARGS)

ui: $(STAMP) ## Open the tracked runs in a browser (MLflow)
	@$(PY) pipelines/ui.py $(ARGS)

test: $(STAMP) ## Run every test
	@$(PY) -m pytest -n 2 --dist loadfile $(PYTEST_ARGS)

test-fast: $(STAMP) ## Run the tests that take seconds
	@$(PY) -m pytest -m "not slow" $(PYTEST_ARGS)

lint: $(STAMP) ## Check style, types and import directions
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .
	@$(PY) -m mypy
	@$(VENV)/bin/lint-imports --no-logo

format: $(STAMP) ## Rewrite the sources in the project's style
	@$(PY) -m ruff check --fix .
	@$(PY) -m ruff format .

clean: ## Remove caches and build products; keeps .venv, data and outputs
	@rm -rf build src/*.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis .import_linter_cache
	@find src pipelines tests -name __pycache__ -type d -prune -exec rm -rf {} +
