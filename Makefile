# See CONTRIBUTING.md.
PYTHON = .venv/bin/python

.PHONY: setup quick test check format ci docs dist

setup:
	python3 -m venv .venv
	.venv/bin/pip install -c constraints.txt -e ".[test]"

quick:
	$(PYTHON) -m pytest -m quick

test:
	$(PYTHON) -m pytest -m "not slow"

check:
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

format:
	.venv/bin/ruff format .
	.venv/bin/ruff check --fix .

ci:
	.ci/run

docs:
	$(PYTHON) docs/tools/configuration_page.py
	$(PYTHON) docs/tools/concept_pictures.py
	$(PYTHON) -m mkdocs build --strict

dist:
	.ci/release_check
