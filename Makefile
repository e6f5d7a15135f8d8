# One virtual environment, locked versions, nothing from the machine but Python and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
KITTI ?= ../shared/kitti
CAD ?= ../shared/cad
STREETS ?= build/streets

.DEFAULT_GOAL := help
.PHONY: help demo docs pictures realism test fuzz trust check lint types bench checkpoint table1 tables clean

help: ## this list
	@grep -E '^[a-z0-9]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("augkitti needs Python 3.11 to 3.13; set PYTHON=") if not (3, 11) <= sys.version_info[:2] <= (3, 13) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[view]" --requirement requirements-dev.txt
	touch $@

demo: $(STAMP) ## generate from the embedded street, split, validate, draw a pair
	$(BIN)/python -m pipelines.demo

realism: $(STAMP) ## the realism report on the embedded streets, into build/realism (1: not all checks passed)
	$(BIN)/augkitti realism --resimulate --out build/realism || test $$? -eq 1

docs: $(STAMP) ## the documentation as a site, into build/site; a dead link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo build/site/index.html

pictures: $(STAMP) ## the pictures of the documentation, drawn anew from the embedded street
	$(BIN)/python docs/_pictures.py

test: $(STAMP) ## the tests (real scans are used where AUGKITTI_TEST_KITTI has them)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 tests

lint: $(STAMP) ## form: ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP) ## types: mypy, strict
	$(BIN)/mypy

fuzz: $(STAMP) ## 2,000 damaged files of each format to every reader; prints the table of docs/reliability.md
	$(BIN)/python tests/fuzz_readers.py

trust: $(STAMP) ## the same bytes from killed runs, one and two processes, other processors; prints the digests
	$(BIN)/python benchmarks/trust.py $(KITTI) $(CAD)

check: lint types test ## what CI runs

bench: $(STAMP) ## speed and accuracy figures of docs/figures.md, on KITTI=, CAD= and STREETS= (made if absent)
	test -d $(STREETS) || $(BIN)/augkitti synthesize --out $(STREETS) --drives 10 --frames 3 --seed 0
	$(BIN)/python benchmarks/rays.py $(KITTI)
	$(BIN)/python benchmarks/ego_motion.py $(KITTI)
	$(BIN)/python benchmarks/ground.py $(KITTI) $(STREETS)
	$(BIN)/python benchmarks/movers.py --seed 11
	$(BIN)/python benchmarks/movers.py --kitti $(KITTI)
	$(BIN)/python benchmarks/cad_library.py $(CAD)
	$(BIN)/python benchmarks/window_shares.py $(KITTI) $(CAD)
	$(BIN)/python benchmarks/generate.py $(KITTI) $(CAD)
	$(BIN)/python benchmarks/workers.py $(KITTI) $(CAD)
	$(BIN)/python benchmarks/workers.py $(KITTI) $(CAD) --memory 100 2000 --jobs 2
	$(BIN)/python benchmarks/encodings.py $(KITTI) $(CAD)
	$(BIN)/python benchmarks/million.py
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt open3d libusb-package
	$(BIN)/python benchmarks/casting.py $(KITTI) $(CAD) --rounds 3
	$(BIN)/python benchmarks/street_vs_real.py $(KITTI) $(STREETS)
	$(BIN)/python benchmarks/network.py $(KITTI)

STEPS ?= 2800

build/k/splits.json: | $(STAMP)
	env -u AUGKITTI_KITTI $(BIN)/augkitti generate --n 1600 --out build/ak --jobs 2 --resume
	env -u AUGKITTI_KITTI $(BIN)/augkitti generate --n 1600 --cars 0 --out build/k --jobs 2 --resume
	$(BIN)/augkitti split build/ak
	$(BIN)/augkitti split build/k --like build/ak/splits.json

TORCHRUN := OMP_NUM_THREADS=1 $(BIN)/torchrun --nproc-per-node 2 -m training train --threads 1 --data build/k=0.25 --data build/ak
RESUMED = $(if $(wildcard $(1)/checkpoint.pt),--resume)

checkpoint: build/k/splits.json ## the shipped checkpoint, trained on embedded streets: 45 minutes on two cores, into build/shipped
	$(TORCHRUN) --config small --steps $(STEPS) --out build/shipped $(call RESUMED,build/shipped)
	$(TORCHRUN) --config training/configs/small_detection.yaml --init build/shipped --steps 350 --validation none --out build/detection $(call RESUMED,build/detection)
	$(BIN)/pointflownet export build/detection --out training/checkpoints/small.pt
	$(BIN)/pointflownet evaluate training/checkpoints/small.pt --data build/k --data build/ak --split test --json build/shipped/test.json

table1: build/k/splits.json ## what augmented pairs add to plain ones, in small: an hour on two cores, into build/table1
	$(BIN)/python benchmarks/table1.py build/k build/ak

tables: $(STAMP) ## Tables 1 and 2 and the paper's figures on 60 embedded streets of their own: half an hour on two cores, into build/paper/report
	env -u AUGKITTI_KITTI PATH="$(CURDIR)/$(BIN):$$PATH" N=300 SEED=1 CONFIG=small STEPS=250 PROCESSES=2 LIMIT=30 \
	  K_AK=training/checkpoints/small.pt pipelines/paper_tables.sh build/paper

clean: ## remove the environment and caches
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis build *.egg-info
