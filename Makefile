# make demo    installs what is missing, builds, replays the sliding double gyre, says where the pictures are
# make test    the whole suite, and that the GPU kernels compile (NVRTC is fetched into target/); what needs real archives runs where they are
# make test-data   that part alone; RIDGEWATCH_DATA=folder says where they are
# make test-reader   networks read with NumPy
# make test-long   what takes minutes: subscribers that stall for a minute, in Rust and in Python
# make vendored    builds with HDF5 and NetCDF inside, where their libraries cannot be had or the program is to run elsewhere
# make adapters   builds the C library, the Fortran module and, where pip and the network are there, the Python wheel, into out/adapters
# make install-adapters PREFIX=...   puts them (header, libraries, module, pkg-config file) where a solver's build finds them
# make test-adapters   their tests against compilers: gfortran, mpicc, Python. What is missing is installed where apt is (gfortran, openmpi-bin,
#    libopenmpi-dev, python3-venv), or named as NOT RUN; maturin, numpy, pytest and mypy go into out/adapters/venv alone
# make live-figures   takes the figures of docs/live.md that need no GPU and prints their tables; some 20 minutes, with SHORT=1 a few that show only that they run
# make header   writes the C header anew from the library's source; a test holds the two to each other
# make gpu-check   packs tests and benchmarks for a machine with a GPU and, where there is one, runs them and writes what was measured into
#    docs/; it fails where something was not run or failed
CARGO ?= cargo
PACKAGES := pkg-config libhdf5-dev libnetcdf-dev g++
PYTHON ?= python3
# CMake for `vendored`, where there is none; of the last version that reads the build files of these libraries without complaint.
CMAKE := target/cmake
CMAKE_VERSION := 3.31.6
# The compiler of the GPU kernels, for the test that they compile; of the CUDA version that cudarc is bound to.
NVRTC := target/nvrtc
NVRTC_VERSION := 13.0.88
# Whose stubtest holds the Python package's types to the module.
MYPY_VERSION := 2.4.1
SUDO := $(shell [ "$$(id -u)" = 0 ] || echo sudo)

# The collection of real archives that tests/archive/real.rs reads.
RIDGEWATCH_DATA ?= $(abspath ../shared/data)

# What `make adapters` builds goes here; where it is installed.
ADAPTERS := out/adapters
PREFIX ?= /usr/local
VERSION := $(shell sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)

.PHONY: all demo test test-data test-reader test-long packages python-packages vendored build check bench gpu-check clean header adapters install-adapters adapter-packages test-adapters python-adapter live-figures

all: build

# $(call install,PACKAGES,ALTERNATIVE): where there is no apt, the names are printed.
define install
  if command -v apt-get >/dev/null; then \
    echo "installing" $(1); $(SUDO) apt-get update -qq && $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $(1) >/dev/null; \
  else \
    echo "please install the equivalents of:" $(1) $(2); exit 1; \
  fi
endef

# Only what is missing is installed: nothing where pkg-config finds the libraries, or where modules say where they are.
packages:
	@command -v c++ >/dev/null && command -v pkg-config >/dev/null && { pkg-config --exists hdf5 netcdf || [ -n "$$HDF5_DIR" -a -n "$$NETCDF_DIR" ]; } && exit 0; \
	missing=""; for p in $(PACKAGES); do dpkg -s $$p >/dev/null 2>&1 || missing="$$missing $$p"; done; \
	if [ -n "$$missing" ]; then $(call install,$$missing,"(or: make vendored)"); fi

# What fetches Python packages into target/ and .venv. Debian's python3 comes without pip and venv; others' have them.
python-packages:
	@$(PYTHON) -c 'import ensurepip, pip, venv' 2>/dev/null || { $(call install,python3-pip python3-venv); }

# CMake and the C compiler build the libraries; nothing of them need be installed.
vendored:
	@command -v c++ >/dev/null && command -v make >/dev/null || { $(call install,g++ make); }
	@command -v cmake >/dev/null || $(MAKE) --no-print-directory $(CMAKE)/done
	PATH="$$PATH:$(CURDIR)/$(CMAKE)/cmake/data/bin" $(CARGO) build --release --features vendored

$(CMAKE)/done: | python-packages
	$(PYTHON) -m pip install -q --no-deps --target $(CMAKE) cmake==$(CMAKE_VERSION)
	touch $@

build: packages
	$(CARGO) build --release

demo: build
	$(CARGO) run --release --quiet -- replay configs/double_gyre.toml --out out/demo --overwrite
	@echo "pictures: out/demo/frames/*.png   figures: out/demo/records.jsonl, out/demo/summary.json"

# One profile for everything: dependencies are built once, and numerics run optimised.
test: packages python-packages
	$(CARGO) test --release --workspace
	@if $(MAKE) --no-print-directory $(NVRTC)/done; then \
	  LD_LIBRARY_PATH="$(CURDIR)/$(NVRTC)/nvidia/cu13/lib:$$LD_LIBRARY_PATH" $(CARGO) test --release --test kernels_compile -- --ignored; else \
	  echo "NOT RUN: whether the GPU kernels compile, since NVRTC could not be fetched (needs the network)"; fi
	@if [ ! -d "$(RIDGEWATCH_DATA)" ]; then \
	  echo "NOT RUN: the tests on real archives, since $(RIDGEWATCH_DATA) is not there (set RIDGEWATCH_DATA)"; \
	elif $(MAKE) --no-print-directory .venv/installed; then $(MAKE) --no-print-directory test-data; else \
	  echo "NOT RUN: the tests on real archives, since their Python packages could not be fetched (needs the network)"; fi
	@if $(MAKE) --no-print-directory .venv/installed; then $(MAKE) --no-print-directory test-reader; else \
	  echo "NOT RUN: the tests of the NumPy reader of networks, since NumPy could not be fetched (needs the network)"; fi

test-data: packages .venv/installed
	RIDGEWATCH_DATA="$(RIDGEWATCH_DATA)" $(CARGO) test --release --test archive -- --ignored --nocapture

test-reader: packages .venv/installed
	PYTHON="$(CURDIR)/.venv/bin/python" $(CARGO) test --release --test network_reader -- --ignored

test-long: packages .venv/installed
	PYTHON="$(CURDIR)/.venv/bin/python" $(CARGO) test --release --test publish_stall -- --ignored --nocapture

.venv/installed: | python-packages
	$(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet numpy scipy netCDF4 pyzmq
	touch $@

$(NVRTC)/done: | python-packages
	$(PYTHON) -m pip install -q --no-deps --target $(NVRTC) nvidia-cuda-nvrtc==$(NVRTC_VERSION)
	touch $@

# The second step is for the machine with the GPU: what travels is .gpu/check, and its `run` needs nothing else.
gpu-check: packages
	scripts/gpu-check-prepare .gpu/check
	@if nvidia-smi >/dev/null 2>&1; then \
	  status=0; OUT=out/gpu-check .gpu/check/run || status=$$?; \
	  scripts/gpu-check-write out/gpu-check && exit $$status; else \
	  echo "no GPU here: take .gpu/check to one, start .gpu/check/run there, and give what it leaves to scripts/gpu-check-write"; fi

header:
	RIDGEWATCH_WRITE_HEADER=1 $(CARGO) test --release -p ridgewatch-adapter --test c_library the_header_is_that_of_the_library

# Rust and a C linker suffice for the library itself.
adapters:
	$(CARGO) build --release -p ridgewatch-adapter
	mkdir -p $(ADAPTERS)/lib $(ADAPTERS)/include
	cp target/release/libridgewatch_adapter.so target/release/libridgewatch_adapter.a $(ADAPTERS)/lib/
	cp adapters/c/include/ridgewatch.h $(ADAPTERS)/include/
	@if command -v gfortran >/dev/null; then \
	  gfortran -O2 -std=f2018 -fPIC -J $(ADAPTERS)/include -c adapters/fortran/ridgewatch.f90 -o $(ADAPTERS)/ridgewatch.o && \
	  rm -f $(ADAPTERS)/lib/libridgewatch_fortran.a && ar rcs $(ADAPTERS)/lib/libridgewatch_fortran.a $(ADAPTERS)/ridgewatch.o && \
	  rm $(ADAPTERS)/ridgewatch.o; else \
	  echo "NOT BUILT: the Fortran module, since gfortran is not installed"; fi
	@$(MAKE) --no-print-directory python-adapter || echo "NOT BUILT: the Python wheel (needs python3-venv and the network, or maturin)"

python-adapter: $(ADAPTERS)/venv/installed
	$(ADAPTERS)/venv/bin/maturin build --release --quiet -m adapters/python/Cargo.toml --target-dir target/python --out $(ADAPTERS)/wheel

# Anew where what is installed may have changed.
$(ADAPTERS)/venv/installed: Makefile
	$(PYTHON) -m venv $(ADAPTERS)/venv
	$(ADAPTERS)/venv/bin/pip install --quiet 'maturin>=1.7,<2' numpy pytest mypy==$(MYPY_VERSION)
	touch $@

install-adapters: adapters
	install -d $(DESTDIR)$(PREFIX)/lib/pkgconfig $(DESTDIR)$(PREFIX)/include
	install -m 644 $(ADAPTERS)/lib/libridgewatch_* $(DESTDIR)$(PREFIX)/lib/
	install -m 644 $$(ls $(ADAPTERS)/include/*.h $(ADAPTERS)/include/*.mod 2>/dev/null) $(DESTDIR)$(PREFIX)/include/
	sed -e 's|@PREFIX@|$(PREFIX)|' -e 's|@VERSION@|$(VERSION)|' adapters/c/ridgewatch.pc.in > $(DESTDIR)$(PREFIX)/lib/pkgconfig/ridgewatch.pc

# Only what is missing, and only for these tests.
adapter-packages:
	@missing=""; command -v gfortran >/dev/null || missing="$$missing gfortran"; command -v mpicc >/dev/null || missing="$$missing openmpi-bin libopenmpi-dev"; \
	if [ -n "$$missing" ] && command -v apt-get >/dev/null; then \
	  $(SUDO) apt-get update -qq && $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $$missing >/dev/null || echo "could not install$$missing"; fi

test-adapters: packages python-packages adapter-packages adapters
	$(CARGO) test --release -p ridgewatch-wire -p ridgewatch-adapter
	@if command -v gfortran >/dev/null; then $(CARGO) test --release -p ridgewatch-adapter --test fortran_module -- --ignored; else \
	  echo "NOT RUN: the tests of the Fortran module, since gfortran is not installed"; fi
	@if [ "$$(id -u)" = 0 ]; then $(CARGO) test --release -p ridgewatch-wire -- --ignored --skip gigabytes && $(CARGO) test --release --test publish -- --ignored; else \
	  echo "NOT RUN: a ring or a run folder on a full file system, files of another user, since these tests need root"; fi
	@if [ "$$(awk '/^MemAvailable/ { print int($$2 / 1000000) }' /proc/meminfo)" -ge 16 ]; then $(CARGO) test --release -p ridgewatch-wire --test follow -- --ignored gigabytes; else \
	  echo "NOT RUN: a relay of steps of 2 GB, since that test needs 16 GB of memory"; fi
	@$(MAKE) --no-print-directory install-adapters PREFIX=$(CURDIR)/$(ADAPTERS)/installed
	scripts/adapters-installed $(ADAPTERS)/installed
	@if ls $(ADAPTERS)/wheel/*.whl >/dev/null 2>&1; then \
	  $(ADAPTERS)/venv/bin/pip install --quiet --force-reinstall --no-deps $(ADAPTERS)/wheel/*.whl && $(ADAPTERS)/venv/bin/pytest -q adapters/python/tests && \
	  $(ADAPTERS)/venv/bin/python -m mypy.stubtest ridgewatch_adapter; else \
	  echo "NOT RUN: the tests of the Python package, since its wheel was not built"; fi
	$(CARGO) build --release --bin ridgewatch --example live_window
	scripts/live-mpi-check

live-figures: packages adapter-packages adapters
	$(CARGO) build --release --bin ridgewatch --example subscriber --example live_window
	scripts/live-figures $(if $(SHORT),--short)

bench: packages
	$(CARGO) bench

clean:
	$(CARGO) clean
	rm -rf out
