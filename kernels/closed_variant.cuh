// The closed-form flow and the integrator that macros pick: RW_REAL, RW_FORM, RW_BOUNDARY, RW_DIFFERENCES, RW_STARTS.
#pragma once
#include "closed.cuh"
#include "integrate.cuh"

using namespace rw;

struct Config {
    static constexpr int FORM = RW_FORM, BOUNDARY = RW_BOUNDARY;
    static constexpr bool STARTS = RW_STARTS;
};
using Flow = ClosedFlow<Config, RW_REAL>;

RW_FN void one(const Flow& flow, RW_REAL h, double gap, const Verdict& verdict, const float (&seed)[3], size_t at, const Outputs& out) {
    const double from[3] = {seed[0], seed[1], seed[2]};
    if constexpr (RW_DIFFERENCES) give(flow, trace_differences(flow, verdict.steps, h, gap, from), verdict, seed, at, out);
    else give(flow, trace_tangent(flow, verdict.steps, h, from), verdict, seed, at, out);
}
