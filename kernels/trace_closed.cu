// Log-stretch of seeds in a closed-form flow. Macros: RW_REAL, RW_FORM, RW_BOUNDARY, RW_DIFFERENCES.
#include "closed.cuh"
#include "integrate.cuh"

using namespace rw;

struct Config {
    static constexpr int FORM = RW_FORM, BOUNDARY = RW_BOUNDARY;
};
using Flow = ClosedFlow<Config, RW_REAL>;

__device__ __forceinline__ void one(const Flow& flow, RW_REAL h, double gap, const Verdict& verdict, const float (&seed)[3], size_t at, const Outputs& out) {
    const double from[3] = {seed[0], seed[1], seed[2]};
#if RW_DIFFERENCES
    give(flow, trace_differences(flow, verdict.steps, h, gap, from), verdict, seed, at, out);
#else
    give(flow, trace_tangent(flow, verdict.steps, h, from), verdict, seed, at, out);
#endif
}

// seeds: 3 floats each, domain coordinates. stages: two a step and one more.
extern "C" __global__ void __launch_bounds__(256)
trace(const __grid_constant__ ClosedData<RW_REAL> data, const Constants<RW_REAL>* __restrict__ stages, RW_REAL h, double gap, Verdict verdict,
      const float* __restrict__ seeds, uint32_t n, Outputs out) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    const float seed[3] = {seeds[3 * size_t(i)], seeds[3 * size_t(i) + 1], seeds[3 * size_t(i) + 2]};
    one(Flow{data, stages}, h, gap, verdict, seed, i, out);
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
    one(Flow{data, stages}, h, gap, verdict, seed, __float_as_uint(s.w), out);
}
