# Everything lives in .venv of this checkout; nothing else on the machine is touched.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
OUT    ?= demo-out
LEARNT ?= train-out

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup demo test lint bench bench-peers soak wire ablation questions viewer-test terminal-test cluster-test train install-service clean

help:
	@echo "make demo    walk through a virtual street, map it, measure the map (writes $(OUT)/)"
	@echo "make test    the tests (those on real recordings need ARTEMIS_DATA)"
	@echo "make lint    ruff and mypy"
	@echo "make bench   what a frame costs on this machine"
	@echo "make bench-peers  what the odometry costs a frame, beside KISS-ICP and small_gicp (fetched; a few minutes)"
	@echo "make soak    a virtual walk of 20 minutes: flat cost, bounded memory"
	@echo "make wire    a minute played on the wire by virtual devices: losses and CPU of the service (some minutes)"
	@echo "make viewer-test  GLB and browser view in headless Chromium (fetches three.js with npm)"
	@echo "make terminal-test  tui and demo --tui in tmux at 80x24 and 160x48, from start to report (some minutes)"
	@echo "make cluster-test  four recordings on two Dask workers, one of which is killed (a minute or two)"
	@echo "make train   render views of the virtual worlds, train and export the shipped network (an hour or two, torch)"
	@echo "make install-service   as root: the systemd service and what belongs to it (docs/operator.md)"
	@echo "make ablation  the paper's ablations (Tables III and IV) on a virtual world"
	@echo "make questions  questions to maps for what virtual worlds have and have not (some minutes)"
	@echo "make setup   only create $(VENV); every target does it when needed"
	@echo "make clean   remove $(VENV) and everything that was generated"

setup: $(READY)

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed; name one with: make PYTHON=python3.12"; exit 2; }
	@echo "setting up $(VENV) (once; a minute or two)"
	@$(PYTHON) -m venv $(VENV) || \
	  { echo "python3 -m venv does not work here; on Debian and Ubuntu: apt install python3-venv"; exit 2; }
	@PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install -qq --only-binary :all: -e '.[dev]'
	@touch $@
	@echo "ready: $(BIN)/artemis-edge"

demo: $(READY)
	@$(BIN)/artemis-edge demo --out $(OUT)

test: $(READY)
	@$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

lint: $(READY)
	@$(BIN)/ruff check --quiet . && $(BIN)/ruff format --quiet --check . && $(BIN)/mypy --no-error-summary
	@echo "ruff and mypy: nothing to complain about"

bench: $(READY)
	@$(BIN)/artemis-edge bench

bench-peers: $(READY)
	@PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install -qq --only-binary :all: -e '.[dev,loop]' 'kiss-icp>=1.3'
	@$(BIN)/python tests/bench/bench_peers.py

soak: $(READY)
	@$(BIN)/python tests/soak/walk.py

wire: $(READY)
	@$(BIN)/python tests/soak/wire_minute.py
	@$(BIN)/python tests/bench/bench_livox.py --seconds 30 --mode triple
	@$(BIN)/python tests/soak/replug_devices.py
	@$(BIN)/python tests/soak/kill_mapping.py
	@$(BIN)/python tests/soak/kill_recorder.py

viewer-test: $(READY)
	@command -v npm >/dev/null || { echo "npm is needed: on Debian and Ubuntu: apt install npm chromium"; exit 2; }
	@cd tests/viewer && npm install --no-audit --no-fund --no-package-lock --silent
	@ARTEMIS_VIEWER=1 $(BIN)/python -m pytest tests/viewer

terminal-test: $(READY)
	@command -v tmux >/dev/null || { echo "tmux is needed: on Debian and Ubuntu: apt install tmux"; exit 2; }
	@ARTEMIS_TERMINAL=1 $(BIN)/python -m pytest tests/test_tui_terminal.py tests/soak/test_demo_terminal.py

cluster-test: $(READY)
	@PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install -qq --only-binary :all: -e '.[dev,cluster]'
	@ARTEMIS_CLUSTER=1 $(BIN)/python -m pytest tests/soak/test_cluster.py

# Seeds: learnt from, calibrated with, judged by. Worlds that are used otherwise have seeds far below these.
train: $(READY)
	@PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install -qq --only-binary :all: -e '.[dev,train]'
	@$(BIN)/python training/views.py --out $(LEARNT)/learn --seeds 10000:10024 --views 20
	@$(BIN)/python training/views.py --out $(LEARNT)/learn --seeds 10024:10034 --views 12 --width 960
	@$(BIN)/python training/views.py --out $(LEARNT)/calibrate --seeds 20000:20001 --views 16
	@$(BIN)/python training/views.py --out $(LEARNT)/judge --seeds 20001:20005 --views 18
	@$(BIN)/python training/train.py --views $(LEARNT)/learn --check $(LEARNT)/calibrate --out $(LEARNT)/weights.pt
	@$(BIN)/python training/export.py --weights $(LEARNT)/weights.pt --calibrate $(LEARNT)/calibrate \
	  --out artemis_edge/segmentation/shipped
	@$(BIN)/python training/score.py --views $(LEARNT)/judge

# As root, from a checkout at /opt/artemis-edge. ROOT is for packagers and for trying it out.
ROOT ?=
install-service: $(READY)
	@test "$(CURDIR)" = /opt/artemis-edge -o -n "$(ROOT)" || \
	  { echo "the unit starts /opt/artemis-edge/.venv/bin/artemis-edge: move the checkout there first"; exit 2; }
	@test -n "$(ROOT)" || id artemis >/dev/null 2>&1 || \
	  useradd --system --home-dir /var/lib/artemis --shell /usr/sbin/nologin artemis
	@install -D -m 644 -t $(ROOT)/etc/systemd/system systemd/artemis-edge.service systemd/artemis-can0.service
	@install -D -m 644 -t $(ROOT)/etc/sysctl.d systemd/60-artemis.conf
	@install -D -m 644 -t $(ROOT)/etc/systemd/network systemd/20-artemis-lidar.network
	@install -D -m 644 -t $(ROOT)/etc/udev/rules.d firmware_cfg/udev/99-artemis.rules
	@test -e $(ROOT)/etc/artemis/rig.toml || { mkdir -p $(ROOT)/etc/artemis && \
	  { cat firmware_cfg/profiles/field.toml; printf '\n[service]\nrecord_at_start = false\n'; } >$(ROOT)/etc/artemis/rig.toml; }
	@test -n "$(ROOT)" || { install -d -m 750 -o artemis -g artemis /var/cache/artemis && \
	  runuser -u artemis -- env HOME=/var/lib/artemis ARTEMIS_CACHE_DIR=/var/cache/artemis $(CURDIR)/$(BIN)/artemis-edge warm-up; }
	@test -n "$(ROOT)" || { systemctl daemon-reload; sysctl -q --system; udevadm control --reload; }
	@echo "edit /etc/artemis/rig.toml, name the LiDAR's port in /etc/systemd/network/20-artemis-lidar.network, then:"
	@echo "  systemctl enable --now artemis-can0 artemis-edge"

ablation: $(READY)
	@$(BIN)/python -m artemis_edge.session.ablation --out ablation-out

questions: $(READY)
	@$(BIN)/python tests/bench/bench_semantics.py absent --worlds street courtyard bench

clean:
	@rm -rf $(VENV) $(OUT) $(LEARNT) ablation-out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
