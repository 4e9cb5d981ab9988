# make demo    installs what is missing, builds, replays the sliding double gyre, says where the pictures are
# make test    the whole suite, and that the GPU kernels compile (NVRTC is fetched into target/); what needs real archives runs where they are
# make test-data   that part alone; RIDGEWATCH_DATA=folder says where they are
# make test-long   what takes minutes: subscribers that stall for a minute, in Rust and in Python
# make gpu-check   packs tests and benchmarks for a machine with a GPU and, where there is one, runs them
CARGO ?= cargo
PACKAGES := pkg-config libhdf5-dev libnetcdf-dev g++
PYTHON ?= python3
# The compiler of the GPU kernels, for the test that they compile; of the CUDA version that cudarc is bound to.
NVRTC := target/nvrtc
NVRTC_VERSION := 13.0.88
SUDO := $(shell [ "$$(id -u)" = 0 ] || echo sudo)

# The collection of real archives that tests/archive_real.rs reads.
RIDGEWATCH_DATA ?= $(abspath ../shared/data)

.PHONY: all demo test test-data test-long packages build check bench gpu-check clean

all: build

# Only what is missing is installed; where there is no apt, the names are printed.
packages:
	@missing=""; for p in $(PACKAGES); do dpkg -s $$p >/dev/null 2>&1 || missing="$$missing $$p"; done; \
	if [ -n "$$missing" ]; then \
	  if command -v apt-get >/dev/null; then \
	    echo "installing$$missing"; $(SUDO) apt-get update -qq && $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $$missing >/dev/null; \
	  else \
	    echo "please install the equivalents of:$$missing (or build with: cargo build --release --features vendored)"; exit 1; \
	  fi; \
	fi

build: packages
	$(CARGO) build --release

demo: build
	$(CARGO) run --release --quiet -- replay configs/double_gyre.toml --out out/demo --overwrite
	@echo "pictures: out/demo/frames/*.png   figures: out/demo/records.jsonl, out/demo/summary.json"

# One profile for everything: dependencies are built once, and numerics run optimised.
test: packages
	$(CARGO) test --release --workspace
	@if $(MAKE) --no-print-directory $(NVRTC)/done; then \
	  LD_LIBRARY_PATH="$(CURDIR)/$(NVRTC)/nvidia/cu13/lib:$$LD_LIBRARY_PATH" $(CARGO) test --release --test kernels_compile -- --ignored; else \
	  echo "NOT RUN: whether the GPU kernels compile, since NVRTC could not be fetched (needs python3-pip and the network)"; fi
	@if [ ! -d "$(RIDGEWATCH_DATA)" ]; then \
	  echo "NOT RUN: the tests on real archives, since $(RIDGEWATCH_DATA) is not there (set RIDGEWATCH_DATA)"; \
	elif $(MAKE) --no-print-directory .venv/installed; then $(MAKE) --no-print-directory test-data; else \
	  echo "NOT RUN: the tests on real archives, since their Python packages could not be fetched (needs python3-venv and the network)"; fi

test-data: packages .venv/installed
	RIDGEWATCH_DATA="$(RIDGEWATCH_DATA)" $(CARGO) test --release --test archive_real -- --ignored --nocapture

test-long: packages .venv/installed
	PYTHON="$(CURDIR)/.venv/bin/python" $(CARGO) test --release --test publish_stall -- --ignored --nocapture

.venv/installed:
	$(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet numpy scipy netCDF4 pyzmq
	touch $@

$(NVRTC)/done:
	$(PYTHON) -m pip install -q --no-deps --target $(NVRTC) nvidia-cuda-nvrtc==$(NVRTC_VERSION)
	touch $@

# The second step is for the machine with the GPU: what travels is .gpu/check, and its `run` needs nothing else.
gpu-check: packages
	scripts/gpu-check-prepare .gpu/check
	@if nvidia-smi >/dev/null 2>&1; then OUT=out/gpu-check .gpu/check/run; else echo "no GPU here: take .gpu/check to one and start .gpu/check/run"; fi

bench: packages
	$(CARGO) bench

clean:
	$(CARGO) clean
	rm -rf out
