# Every target sets up what it needs: Python 3.12, uv, a virtual environment, the pinned packages.
VENV  ?= .venv
PY    := $(VENV)/bin/python
STAMP := $(VENV)/.installed

.PHONY: demo test test-long test-fast check setup lock format clean

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml scripts/setup.sh scripts/check_system.py
	@bash scripts/setup.sh $(VENV)
	@touch $@

demo: $(STAMP)
	@$(VENV)/bin/v2p demo

# Two processes, files whole (their fixtures are dear), one thread each: half the time of one process on two cores.
test: $(STAMP)
	@OMP_NUM_THREADS=1 $(PY) -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder -m "not long"

# What would take the tests beyond a quarter of an hour.
test-long: $(STAMP)
	@OMP_NUM_THREADS=1 $(PY) -m pytest -q -m long

test-fast: $(STAMP)
	@$(PY) -m pytest -q -m "not slow and not long and not gpu and not live_llm"

check: $(STAMP)
	@$(VENV)/bin/ruff check --no-cache .  # a cached verdict is stale when a module moves
	@$(VENV)/bin/ruff format --no-cache --check .
	@$(VENV)/bin/codespell $$(git ls-files '*.py' '*.md' '*.toml' '*.yaml')
	@$(PY) scripts/count_statements.py
	@$(VENV)/bin/pyright --pythonpath $(PY)

format: $(STAMP)
	@$(VENV)/bin/ruff check --fix . && $(VENV)/bin/ruff format .

lock: $(STAMP)
	@uv pip compile pyproject.toml --extra dev --extra vlm --python-version 3.12 --generate-hashes --no-header --no-emit-index-url -o requirements.lock

clean:
	rm -rf $(VENV) outputs
