# make demo    installs what is missing, builds, replays the sliding double gyre, says where the pictures are
# make test    the whole suite
CARGO ?= cargo
PACKAGES := pkg-config libhdf5-dev libnetcdf-dev
SUDO := $(shell [ "$$(id -u)" = 0 ] || echo sudo)

.PHONY: all demo test packages build check bench clean

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

bench: packages
	$(CARGO) bench

clean:
	$(CARGO) clean
	rm -rf out
