// Selects the gridded flow by macros: RW_REAL, RW_AXES (2, 3), RW_SPHERE, RW_STORAGE (see Storage), RW_CUBIC, RW_MISSING, RW_KEEP, RW_SCALED,
// RW_EVEN, RW_WRAP, RW_SEAM (bit k: axis k), and RW_DIFFERENCES of variant.cuh.
#pragma once
#include "tracing/sphere.cuh"

struct Config {
    static constexpr int N = RW_AXES, COMPONENTS = RW_SPHERE ? RW_AXES + 1 : RW_AXES, STORAGE = RW_STORAGE, EVEN = RW_EVEN, WRAP = RW_WRAP, SEAM = RW_SEAM;
    static constexpr bool CUBIC = RW_CUBIC, MISSING = RW_MISSING, KEEP = RW_KEEP, SCALED = RW_SCALED;
};
#if RW_SPHERE
using Flow = rw::SphereFlow<Config, RW_REAL>;
#else
using Flow = rw::GridFlow<Config, RW_REAL>;
#endif
using FlowData = rw::GridData<RW_REAL>;
using FlowTimes = rw::GridStep<RW_REAL>;
enum { BLOCK = 128 };
#include "tracing/variant.cuh"
