// Log-stretch of seeds in a closed-form flow.
#include "closed_variant.cuh"

// seeds: 3 floats each, domain coordinates (with RW_STARTS: x, y and the start time). stages: two a step and one more.
extern "C" __global__ void __launch_bounds__(256)
trace(const __grid_constant__ ClosedData<RW_REAL> data, const Constants<RW_REAL>* __restrict__ stages, RW_REAL h, double gap, Verdict verdict,
      const float* __restrict__ seeds, uint32_t n, Outputs out) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    const float seed[3] = {seeds[3 * size_t(i)], seeds[3 * size_t(i) + 1], seeds[3 * size_t(i) + 2]};
    one(Flow(data, stages, seed), h, gap, verdict, seed, i, out);
}

// {x, y, z, index as bits}; results go to their index. Index 0xffffffff: no seed.
extern "C" __global__ void __launch_bounds__(256)
trace_sorted(const __grid_constant__ ClosedData<RW_REAL> data, const Constants<RW_REAL>* __restrict__ stages, RW_REAL h, double gap, Verdict verdict,
             const float4* __restrict__ sorted, uint32_t n, Outputs out) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    const float4 s = __ldg(sorted + i);
    if (__float_as_uint(s.w) == 0xffffffffu) return;
    const float seed[3] = {s.x, s.y, s.z};
    one(Flow(data, stages, seed), h, gap, verdict, seed, __float_as_uint(s.w), out);
}
