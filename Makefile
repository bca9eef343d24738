# make demo and make test work on a fresh machine with Python 3.11 or newer: they make the environment they need.
VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin

.PHONY: bench demo test lint pictures clean

demo: $(VENV)/.installed
	$(BIN)/dynoscope demo --out demo

test: $(VENV)/.installed-test
	$(BIN)/python -m pytest

# In short, some minutes; each takes arguments for more, see the tops of the files.
bench: $(VENV)/.installed-test
	$(BIN)/python -m benchmarks.ingest --rows 100000
	$(BIN)/python -m benchmarks.throttle --part 1 5 --seeds 3
	$(BIN)/python -m benchmarks.thermocouple --seeds 1

# Every tab of every recipe, drawn without a screen: needs mesa-vulkan-drivers, and chromium for the report.
pictures: $(VENV)/.installed-test
	$(BIN)/python -m benchmarks.pictures --out pictures

lint: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/.installed-test: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) demo pictures build dist
