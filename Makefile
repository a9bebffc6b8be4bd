# make demo   how many cart-poles a radio cell supports: installs, prints the table, draws the figure
# make test   installs and runs the tests; make test ARGS='-k camera' runs some
# make lint   ruff on everything, mypy --strict on hjepa_cli/core, who may import whom
# make site   the documentation as a site, in site/; links and anchors are checked
# make clean  removes .venv and what tools leave behind
#
# PYTHON=python3.12 chooses the interpreter (3.11 or newer).

export PYTHON ?= python3
ARGS ?=

.PHONY: demo test lint site clean

demo:
	@scripts/venv plot
	.venv/bin/hjepa scale --snr 10:30 --checkpoint desktop-h4m2l1 $(ARGS)

test:
	@scripts/venv test
	.venv/bin/python -m pytest -n auto --dist loadfile $(ARGS)

lint:
	@scripts/venv lint
	.venv/bin/ruff check .
	.venv/bin/mypy
	.venv/bin/lint-imports --no-cache --no-logo

site:
	@scripts/venv docs
	.venv/bin/zensical build --strict

clean:
	rm -rf site .cache .venv .mypy_cache .ruff_cache .pytest_cache dist
