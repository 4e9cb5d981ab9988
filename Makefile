# make demo            installs missing packages, builds, replays the sliding double gyre and prints where the pictures are
# make test            runs the whole suite and compiles the GPU kernels (NVRTC is fetched into target/); tests of real archives run if the archives are present
# make test-data       runs only the tests of real archives; RIDGEWATCH_DATA=folder names the folder of the archives
# make test-reader     tests the NumPy reader of networks
# make test-exports    checks exported fields with cfchecks and xarray, which go into target/exports; installs libudunits2-0 if apt is available
# make test-clients    runs the Python clients of examples/ (notebook widget, tev) beside a run
# make test-movies     tests films in MP4; installs ffmpeg if apt is available
# make test-dashboard  tests the dashboard's page in Chromium, with Node.js; installs chromium if apt is available, and the packages of package-lock.json
# make test-long       runs the tests that take minutes: subscribers that stall, in Rust and in Python, three floods of ten minutes (SECONDS=60: a minute),
#                      with root also from another user, a Python client that steers, reading a store from far away, and `make fuzz`
# make vendored        builds with HDF5 and NetCDF linked in, for machines without these libraries
# make adapters        builds the C library, the Fortran module and, if pip and the network are available, the Python wheel, into out/adapters
# make install-adapters PREFIX=...   installs header, libraries, module and pkg-config file for the build of a solver. The flags of the pkg-config file let
#                      a solver find the shared library in PREFIX/lib when it runs
# make fuzz            runs each fuzz target in tests/fuzz for FUZZ_SECONDS (60); cargo-fuzz goes into target/cargo-fuzz only
# make deny            checks licences, sources and duplicates of the dependencies against deny.toml; cargo-deny goes into target/cargo-deny only
# make test-adapters   runs the tests of the adapters that need gfortran, mpicc, Python, root or 16 GB. Missing compilers are installed if apt is available
#                      (gfortran, openmpi-bin, libopenmpi-dev, python3-venv), else named as NOT RUN; maturin, numpy, pytest and mypy go into
#                      out/adapters/venv only
# make live-figures    measures the figures of docs/live.md that need no GPU and prints their tables, in some 20 minutes; with SHORT=1 in a few
#                      minutes, which only show that each measurement runs
# make header          generates the C header from the library's source; a test compares the two
# make gpu-check       packs tests and benchmarks for a machine with a GPU. If this machine has one, it runs them and writes the results into docs/;
#                      it fails if something failed or could not run
CARGO ?= cargo
PACKAGES := pkg-config libhdf5-dev libnetcdf-dev g++
PYTHON ?= python3
# CMake for `vendored`, if none is installed: the last version that reads the build files of these libraries without warnings.
CMAKE := target/cmake
CMAKE_VERSION := 3.31.6
# The compiler of the GPU kernels, for the test that compiles them; from the CUDA version that cudarc is bound to.
NVRTC := target/nvrtc
NVRTC_VERSION := 13.0.88
# mypy's stubtest compares the type stubs of the Python package with the module.
MYPY_VERSION := 2.4.1
# The fuzzer of tests/fuzz.
CARGO_FUZZ := target/cargo-fuzz
CARGO_FUZZ_VERSION := 0.13.2
# Checks the dependencies.
CARGO_DENY := target/cargo-deny
CARGO_DENY_VERSION := 0.19.0
# The CF checker, the table of standard names that it looks words up in, and libraries of programs that read exports.
EXPORTS := target/exports
CFCHECKER_VERSION := 4.1.0
# Without what VTK draws by: 105 MB. rasterio brings GDAL.
VTK_VERSION := 9.4.2
RASTERIO_VERSION := 1.4.4
FUZZ_TARGETS := ring message zmtp netcdf checkpoint scene
FUZZ_SECONDS ?= 60
SUDO := $(shell [ "$$(id -u)" = 0 ] || echo sudo)

DASHBOARD_TESTS := tests/dashboard/browser

# Folder of the real archives that tests/archive/real.rs reads.
RIDGEWATCH_DATA ?= $(abspath ../shared/data)

# Output folder of `make adapters`, and where `make install-adapters` installs it.
ADAPTERS := out/adapters
PREFIX ?= /usr/local
# The shared library's name for programs that were linked with it, after the version of its interface.
SONAME := libridgewatch_adapter.so.$(shell sed -n 's/^.define RW_VERSION //p' adapters/c/include/ridgewatch.h)
VERSION := $(shell sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)

.PHONY: all demo test test-data test-reader test-clients test-exports test-movies test-dashboard test-long fuzz deny packages python-packages vendored build check bench gpu-check clean header adapters install-adapters adapter-packages test-adapters python-adapter live-figures

all: build

# $(call install,PACKAGES,ALTERNATIVE): without apt, prints the names and fails.
define install
  if command -v apt-get >/dev/null; then \
    echo "installing" $(1); $(SUDO) apt-get update -qq && $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $(1) >/dev/null; \
  else \
    echo "please install the equivalents of:" $(1) $(2); exit 1; \
  fi
endef

# Installs only missing packages: nothing if pkg-config finds the libraries, or if HDF5_DIR and NETCDF_DIR name them.
packages:
	@command -v c++ >/dev/null && command -v pkg-config >/dev/null && { pkg-config --exists hdf5 netcdf || [ -n "$$HDF5_DIR" -a -n "$$NETCDF_DIR" ]; } && exit 0; \
	missing=""; for p in $(PACKAGES); do dpkg -s $$p >/dev/null 2>&1 || missing="$$missing $$p"; done; \
	if [ -n "$$missing" ]; then $(call install,$$missing,"(or: make vendored)"); fi

# pip and venv, which fetch Python packages into target/ and .venv. Debian's python3 comes without them.
python-packages:
	@$(PYTHON) -c 'import ensurepip, pip, venv' 2>/dev/null || { $(call install,python3-pip python3-venv); }

# CMake and the C compiler build HDF5 and NetCDF, so neither has to be installed.
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

# All tests use the release profile: dependencies are built once, and numerics run optimised.
test: packages python-packages
	@# Serves an archive over HTTPS.
	@command -v openssl >/dev/null || { $(call install,openssl); }
	@# Without the examples; `.ci/run` checks that they compile.
	$(CARGO) test --release --workspace --tests
	$(CARGO) test --release --workspace --doc
	@if $(MAKE) --no-print-directory $(NVRTC)/done; then \
	  LD_LIBRARY_PATH="$(CURDIR)/$(NVRTC)/nvidia/cu13/lib:$$LD_LIBRARY_PATH" $(CARGO) test --release --test kernels_compile -- --ignored; else \
	  echo "NOT RUN: the test that the GPU kernels compile, since NVRTC could not be fetched (needs the network)"; fi
	@if [ ! -d "$(RIDGEWATCH_DATA)" ]; then \
	  echo "NOT RUN: the tests on real archives, since $(RIDGEWATCH_DATA) does not exist (set RIDGEWATCH_DATA)"; \
	elif $(MAKE) --no-print-directory .venv/installed; then $(MAKE) --no-print-directory test-data; else \
	  echo "NOT RUN: the tests on real archives, since their Python packages could not be fetched (needs the network)"; fi
	@if $(MAKE) --no-print-directory .venv/installed; then $(MAKE) --no-print-directory test-reader; else \
	  echo "NOT RUN: the tests of the NumPy reader of networks, since NumPy could not be fetched (needs the network)"; fi

test-data: packages .venv/installed
	RIDGEWATCH_DATA="$(RIDGEWATCH_DATA)" $(CARGO) test --release --test archive -- --ignored --nocapture --skip far_away

test-reader: packages .venv/installed
	PYTHON="$(CURDIR)/.venv/bin/python" $(CARGO) test --release --test network_reader -- --ignored

$(EXPORTS)/done: Makefile | python-packages
	$(PYTHON) -m venv $(EXPORTS)/venv
	$(EXPORTS)/venv/bin/pip install --quiet cfchecker==$(CFCHECKER_VERSION) netCDF4 xarray rasterio==$(RASTERIO_VERSION)
	$(EXPORTS)/venv/bin/pip install --quiet --no-deps vtk==$(VTK_VERSION)
	$(EXPORTS)/venv/bin/pip install --quiet --no-deps --upgrade --target $(EXPORTS)/tables compliance-checker
	touch $@

test-exports: packages
	$(CARGO) build --release --bin ridgewatch
	@ldconfig -p | grep -q libudunits2 || { command -v apt-get >/dev/null && $(SUDO) apt-get update -qq && \
	  $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq libudunits2-0 >/dev/null || true; }
	@if ! ldconfig -p | grep -q libudunits2; then echo "NOT RUN: the checks of exported fields, since libudunits2 is not installed"; \
	elif ! $(MAKE) --no-print-directory $(EXPORTS)/done; then echo "NOT RUN: the checks of exported fields, since their Python packages could not be fetched"; \
	else scripts/check-exports target/release/ridgewatch $(EXPORTS)/venv $(EXPORTS)/tables $(wildcard $(RIDGEWATCH_DATA)); fi

test-clients: packages
	$(CARGO) build --release --bin ridgewatch
	@if $(MAKE) --no-print-directory .venv/installed; then .venv/bin/python scripts/check-clients target/release/ridgewatch; else \
	  echo "NOT RUN: the Python clients, since their packages could not be fetched (needs the network)"; fi

test-movies: packages
	@command -v ffmpeg >/dev/null || { command -v apt-get >/dev/null && $(SUDO) apt-get update -qq && \
	  $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq ffmpeg >/dev/null || true; }
	@if command -v ffmpeg >/dev/null; then $(CARGO) test --release --test run movie:: -- --ignored; else \
	  echo "NOT RUN: the tests of films in MP4, since ffmpeg is not installed"; fi

# The dashboard's page in Debian's Chromium, with Node's test runner.
test-dashboard: packages
	$(CARGO) build --release --bin ridgewatch
	@command -v chromium >/dev/null || { command -v apt-get >/dev/null && $(SUDO) apt-get update -qq && \
	  $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq chromium >/dev/null || true; }
	@if ! command -v chromium >/dev/null; then echo "NOT RUN: the tests of the dashboard's page, since chromium is not installed"; \
	elif ! node -e 'const [a, b] = process.versions.node.split("."); process.exit(a > 20 || (a == 20 && b >= 19) ? 0 : 1)' 2>/dev/null; then \
	  echo "NOT RUN: the tests of the dashboard's page, since Node.js 20.19 or newer is not installed"; \
	elif ! npm --prefix $(DASHBOARD_TESTS) ci --silent --no-audit --no-fund; then echo "NOT RUN: the tests of the dashboard's page, since npm cannot fetch their packages"; \
	else cd $(DASHBOARD_TESTS) && CHROMIUM=$$(command -v chromium) RIDGEWATCH=$(CURDIR)/target/release/ridgewatch npm test; fi

test-long: packages .venv/installed
	$(CARGO) test --release --test archive far_away -- --ignored --nocapture
	PYTHON="$(CURDIR)/.venv/bin/python" $(CARGO) test --release --test publish_stall -- --ignored --nocapture
	PYTHON="$(CURDIR)/.venv/bin/python" $(CARGO) test --release --test dashboard python -- --ignored
	@if [ "$$(id -u)" = 0 ]; then $(CARGO) test --release -p ridgewatch-zmtp -- --ignored; else \
	  echo "NOT RUN: the test that other users are refused, since it needs root"; fi
	FLOOD_SECONDS="$(or $(SECONDS),600)" $(CARGO) test --release --test publish_flood -- --ignored --nocapture
	$(CARGO) build --release --bin ridgewatch
	@if command -v chromium >/dev/null && npm --prefix $(DASHBOARD_TESTS) ci --silent --no-audit --no-fund; then cd $(DASHBOARD_TESTS) && \
	  PYTHON="$(CURDIR)/.venv/bin/python" RIDGEWATCH=$(CURDIR)/target/release/ridgewatch CHROMIUM=$$(command -v chromium) node figures.js "$(or $(SECONDS),600)" 20; \
	else echo "NOT RUN: the dashboard's server with many clients, since chromium or its npm packages are missing"; fi
	$(MAKE) --no-print-directory fuzz

$(CARGO_FUZZ)/bin/cargo-fuzz:
	$(CARGO) install --quiet --locked --root $(CARGO_FUZZ) cargo-fuzz --version $(CARGO_FUZZ_VERSION)

# Without a sanitizer, so that a stable toolchain suffices: what is looked for are panics, hangs and memory. Inputs that were found stay in target/fuzz.
fuzz: packages $(CARGO_FUZZ)/bin/cargo-fuzz
	@# The versions of the dependencies are those of the program.
	@cp Cargo.lock tests/fuzz/Cargo.lock
	@for target in $(FUZZ_TARGETS); do \
	  mkdir -p target/fuzz/corpus/$$target target/fuzz/temporary; \
	  seeds=""; [ $$target != scene ] || seeds=configs; \
	  TMPDIR="$(CURDIR)/target/fuzz/temporary" PATH="$(CURDIR)/$(CARGO_FUZZ)/bin:$$PATH" $(CARGO) fuzz run --fuzz-dir tests/fuzz --target-dir target/fuzz --sanitizer none $$target \
	    target/fuzz/corpus/$$target $$seeds -- -max_total_time=$(FUZZ_SECONDS) -timeout=10 -rss_limit_mb=1024 -max_len=8192 -print_final_stats=1 || exit 1; \
	done

$(CARGO_DENY)/bin/cargo-deny:
	@# Unoptimised: it is built in a minute, and checks in seconds.
	CARGO_PROFILE_DEV_DEBUG=0 $(CARGO) install --quiet --locked --debug --root $(CARGO_DENY) cargo-deny --version $(CARGO_DENY_VERSION)

# Without the advisories, whose database needs the network: `target/cargo-deny/bin/cargo-deny check advisories`.
deny: $(CARGO_DENY)/bin/cargo-deny
	$(CARGO_DENY)/bin/cargo-deny --locked check --hide-inclusion-graph bans licenses sources

.venv/installed: Makefile | python-packages
	$(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet numpy scipy netCDF4 pyproj pyzmq xarray zarr anywidget
	touch $@

$(NVRTC)/done: | python-packages
	$(PYTHON) -m pip install -q --no-deps --target $(NVRTC) nvidia-cuda-nvrtc==$(NVRTC_VERSION)
	touch $@

# Copy .gpu/check to the machine with the GPU; `run` in it needs nothing else.
gpu-check: packages
	scripts/gpu-check-prepare .gpu/check
	@if nvidia-smi >/dev/null 2>&1; then \
	  status=0; OUT=out/gpu-check .gpu/check/run || status=$$?; \
	  scripts/gpu-check-write out/gpu-check && exit $$status; else \
	  echo "no GPU on this machine: copy .gpu/check to one with a GPU, start .gpu/check/run, and give its output folder to scripts/gpu-check-write"; fi

header:
	RIDGEWATCH_WRITE_HEADER=1 $(CARGO) test --release -p ridgewatch-adapter --test c_library the_header_is_that_of_the_library

# The library itself needs only Rust and a C linker.
adapters:
	$(CARGO) build --release -p ridgewatch-adapter
	mkdir -p $(ADAPTERS)/lib $(ADAPTERS)/include
	cp target/release/libridgewatch_adapter.a $(ADAPTERS)/lib/
	rm -f $(ADAPTERS)/lib/libridgewatch_adapter.so*
	cp target/release/libridgewatch_adapter.so $(ADAPTERS)/lib/$(SONAME)
	ln -s $(SONAME) $(ADAPTERS)/lib/libridgewatch_adapter.so
	cp adapters/c/include/ridgewatch.h $(ADAPTERS)/include/
	@if command -v gfortran >/dev/null; then \
	  gfortran -O2 -std=f2018 -fPIC -J $(ADAPTERS)/include -c adapters/fortran/ridgewatch.f90 -o $(ADAPTERS)/ridgewatch.o && \
	  rm -f $(ADAPTERS)/lib/libridgewatch_fortran.a && ar rcs $(ADAPTERS)/lib/libridgewatch_fortran.a $(ADAPTERS)/ridgewatch.o && \
	  rm $(ADAPTERS)/ridgewatch.o; else \
	  echo "NOT BUILT: the Fortran module, since gfortran is not installed"; fi
	@$(MAKE) --no-print-directory python-adapter || echo "NOT BUILT: the Python wheel (needs python3-venv and the network, or maturin)"

python-adapter: $(ADAPTERS)/venv/installed
	$(ADAPTERS)/venv/bin/maturin build --release --quiet -m adapters/python/Cargo.toml --target-dir target/python --out $(ADAPTERS)/wheel

# Depends on the Makefile, which names the packages.
$(ADAPTERS)/venv/installed: Makefile
	$(PYTHON) -m venv $(ADAPTERS)/venv
	$(ADAPTERS)/venv/bin/pip install --quiet 'maturin>=1.7,<2' numpy pytest mypy==$(MYPY_VERSION)
	touch $@

install-adapters: adapters
	install -d $(DESTDIR)$(PREFIX)/lib/pkgconfig $(DESTDIR)$(PREFIX)/include
	install -m 644 $(ADAPTERS)/lib/libridgewatch_*.a $(DESTDIR)$(PREFIX)/lib/
	install -m 755 $(ADAPTERS)/lib/$(SONAME) $(DESTDIR)$(PREFIX)/lib/
	ln -sf $(SONAME) $(DESTDIR)$(PREFIX)/lib/libridgewatch_adapter.so
	install -m 644 $$(ls $(ADAPTERS)/include/*.h $(ADAPTERS)/include/*.mod 2>/dev/null) $(DESTDIR)$(PREFIX)/include/
	sed -e 's|@PREFIX@|$(PREFIX)|' -e 's|@VERSION@|$(VERSION)|' adapters/c/ridgewatch.pc.in > $(DESTDIR)$(PREFIX)/lib/pkgconfig/ridgewatch.pc

# Compilers for the tests of the adapters; installs only missing ones. Programs that use MPI bring mpicc without the headers that it needs.
adapter-packages:
	@missing=""; command -v gfortran >/dev/null || missing="$$missing gfortran"; \
	echo '#include <mpi.h>' | mpicc -fsyntax-only -xc /dev/stdin 2>/dev/null || missing="$$missing openmpi-bin libopenmpi-dev"; \
	if [ -n "$$missing" ] && command -v apt-get >/dev/null; then \
	  $(SUDO) apt-get update -qq && $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $$missing >/dev/null || echo "could not install$$missing"; fi

test-adapters: packages python-packages adapter-packages adapters
	@if command -v gfortran >/dev/null; then $(CARGO) test --release --workspace --test fortran_module -- --ignored; else \
	  echo "NOT RUN: the tests of the Fortran module, since gfortran is not installed"; fi
	@if [ "$$(id -u)" = 0 ]; then $(CARGO) test --release --workspace --test messages --test ring --test publish -- --ignored; else \
	  echo "NOT RUN: the tests of full file systems and of files of another user, since they need root"; fi
	@if [ "$$(awk '/^MemAvailable/ { print int($$2 / 1000000) }' /proc/meminfo)" -ge 16 ]; then $(CARGO) test --release --workspace --test follow -- --ignored gigabytes; else \
	  echo "NOT RUN: the relay test with steps of 2 GB, since it needs 16 GB of memory"; fi
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
