// The gridded flow and the integrator that macros pick: RW_REAL, RW_AXES (2, 3), RW_SPHERE, RW_STORAGE (see Storage), RW_CUBIC,
// RW_MARKS, RW_KEEP, RW_SCALED, RW_EVEN, RW_WRAP, RW_SEAM (bit k: axis k), RW_DIFFERENCES.
#pragma once
#include "sphere.cuh"
#include "integrate.cuh"

using namespace rw;

struct Config {
    static constexpr int N = RW_AXES, COMPONENTS = RW_SPHERE ? RW_AXES + 1 : RW_AXES, STORAGE = RW_STORAGE, EVEN = RW_EVEN, WRAP = RW_WRAP, SEAM = RW_SEAM;
    static constexpr bool CUBIC = RW_CUBIC, MARKS = RW_MARKS, KEEP = RW_KEEP, SCALED = RW_SCALED;
};
#if RW_SPHERE && RW_AXES == 3
using Flow = LayeredSphereFlow<Config, RW_REAL>;
#elif RW_SPHERE
using Flow = SphereFlow<Config, RW_REAL>;
#else
using Flow = GridFlow<Config, RW_REAL>;
#endif

RW_FN void one(const Flow& flow, RW_REAL h, double gap, const Verdict& verdict, const float (&seed)[3], size_t at, const Outputs& out) {
    const double from[3] = {seed[0], seed[1], seed[2]};
    if constexpr (RW_DIFFERENCES) give(flow, trace_differences(flow, verdict.steps, h, gap, from), verdict, seed, at, out);
    else give(flow, trace_tangent(flow, verdict.steps, h, from), verdict, seed, at, out);
}
