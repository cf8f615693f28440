# Every target makes its own environment: nothing but Python 3.11+, make and the package index is needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint lint-code lint-types lint-docs docs bench lock clean

demo: $(STAMP)  ## a small synthetic study, rendered and measured, with its report
	$(BIN)/rsa-vision demo demo

test: $(STAMP)  ## one worker a processor, each with one thread: more of them get in the way
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

lint: lint-code lint-types lint-docs  ## side by side with make -j

lint-code: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

lint-types: $(STAMP)
	$(BIN)/mypy

lint-docs: $(STAMP)
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build/html

docs: $(STAMP)  ## with the real films, drawn: minutes
	$(BIN)/sphinx-build -W -D draw_real_films=1 -b html docs docs/_build/html

bench: $(STAMP)  ## hours: marker images against the bound, whole examinations and names against the truth
	$(BIN)/python benchmarks/detection.py
	$(BIN)/python benchmarks/reach.py
	$(BIN)/python benchmarks/identification.py
	$(BIN)/python benchmarks/pair_calibration.py
	$(BIN)/python benchmarks/hard_films.py

lock:  ## renew requirements.lock (hashes, no addresses)
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/pip install --quiet pip-tools
	$(VENV)-lock/bin/pip-compile --quiet --all-extras --generate-hashes --allow-unsafe --strip-extras --no-emit-index-url --no-emit-trusted-host --no-emit-find-links --no-header --output-file requirements.lock pyproject.toml
	rm -rf $(VENV)-lock

$(STAMP): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $(STAMP)

clean:
	rm -rf $(VENV) $(VENV)-lock docs/_build dist demo
