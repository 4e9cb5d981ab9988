// Selects the closed-form flow by macros: RW_REAL, RW_FORM, RW_BOUNDARY, RW_STARTS, and RW_DIFFERENCES of variant.cuh.
#pragma once
#include "tracing/closed.cuh"

struct Config {
    static constexpr int FORM = RW_FORM, BOUNDARY = RW_BOUNDARY;
    static constexpr bool STARTS = RW_STARTS;
};
using Flow = rw::ClosedFlow<Config, RW_REAL>;
using FlowData = rw::ClosedData<RW_REAL>;
using FlowTimes = rw::Constants<RW_REAL>;
enum { BLOCK = 256 };
#include "tracing/variant.cuh"
