// Kernels that trace seeds, for the flow that the including file selects by macros. It defines `Config`, `Flow` (constructed from a `FlowData`,
// an array of `FlowTimes` and a seed) and BLOCK, the threads of a block. RW_DIFFERENCES selects central differences instead of the tangent.
#pragma once
#include "tracing/integrate.cuh"

using namespace rw;

RW_FN void trace_seed(const Flow& flow, RW_REAL h, double difference_step, const ResultPolicy& policy, const float (&seed)[3], size_t at,
                      const Outputs& out) {
    const double from[3] = {seed[0], seed[1], seed[2]};
    if constexpr (RW_DIFFERENCES) write_results(flow, trace_differences(flow, policy.steps, h, difference_step, from), policy, seed, at, out);
    else write_results(flow, trace_tangent(flow, policy.steps, h, from), policy, seed, at, out);
}

#if RW_DEVICE
// Seeds: 3 floats each, domain coordinates (with RW_STARTS: x, y and the start time). Results are in the order of the seeds.
extern "C" __global__ void __launch_bounds__(BLOCK)
trace(const __grid_constant__ FlowData data, const FlowTimes* __restrict__ times, RW_REAL h, double difference_step, ResultPolicy policy,
      const float* __restrict__ seeds, uint32_t n, Outputs out) {
    const uint32_t i = blockIdx.x * uint32_t(BLOCK) + threadIdx.x;
    if (i >= n) return;
    const float seed[3] = {seeds[3 * size_t(i)], seeds[3 * size_t(i) + 1], seeds[3 * size_t(i) + 2]};
    trace_seed(Flow(data, times, seed), h, difference_step, policy, seed, i, out);
}

// Seeds sorted by cell: {x, y, z, index as bits}. Results go to the index; index 0xffffffff marks an entry without a seed.
extern "C" __global__ void __launch_bounds__(BLOCK)
trace_sorted(const __grid_constant__ FlowData data, const FlowTimes* __restrict__ times, RW_REAL h, double difference_step, ResultPolicy policy,
             const float4* __restrict__ sorted, uint32_t n, Outputs out) {
    const uint32_t i = blockIdx.x * uint32_t(BLOCK) + threadIdx.x;
    if (i >= n) return;
    const float4 s = __ldg(sorted + i);
    if (__float_as_uint(s.w) == 0xffffffffu) return;
    const float seed[3] = {s.x, s.y, s.z};
    trace_seed(Flow(data, times, seed), h, difference_step, policy, seed, __float_as_uint(s.w), out);
}
#endif
