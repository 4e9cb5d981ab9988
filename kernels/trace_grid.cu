// Log-stretch of seeds in a window of snapshots. Macros: RW_REAL, RW_AXES (2, 3), RW_SPHERE, RW_STORAGE (0: f32, 1: f16), RW_CUBIC, RW_MARKS,
// RW_KEEP, RW_SCALED, RW_EVEN, RW_WRAP, RW_SEAM (bit k: axis k), RW_DIFFERENCES.
#include "sphere.cuh"
#include "integrate.cuh"

using namespace rw;

struct Config {
    static constexpr int N = RW_AXES, COMPONENTS = RW_SPHERE ? 3 : RW_AXES, STORAGE = RW_STORAGE, EVEN = RW_EVEN, WRAP = RW_WRAP, SEAM = RW_SEAM;
    static constexpr bool CUBIC = RW_CUBIC, MARKS = RW_MARKS, KEEP = RW_KEEP, SCALED = RW_SCALED;
};
#if RW_SPHERE
using Flow = SphereFlow<Config, RW_REAL>;
#else
using Flow = GridFlow<Config, RW_REAL>;
#endif

__device__ __forceinline__ void one(const Flow& flow, RW_REAL h, double gap, const Verdict& verdict, const float (&seed)[3], size_t at, const Outputs& out) {
    const double from[3] = {seed[0], seed[1], seed[2]};
#if RW_DIFFERENCES
    give(flow, trace_differences(flow, verdict.steps, h, gap, from), verdict, seed, at, out);
#else
    give(flow, trace_tangent(flow, verdict.steps, h, from), verdict, seed, at, out);
#endif
}

// Seeds as they come: 3 floats each, domain coordinates. With them results are in the order of the seeds.
extern "C" __global__ void __launch_bounds__(128)
trace(const __grid_constant__ GridData<RW_REAL> data, const GridStep<RW_REAL>* __restrict__ steps, RW_REAL h, double gap, Verdict verdict,
      const float* __restrict__ seeds, uint32_t n, Outputs out) {
    const uint32_t i = blockIdx.x * 128u + threadIdx.x;
    if (i >= n) return;
    const float seed[3] = {seeds[3 * size_t(i)], seeds[3 * size_t(i) + 1], seeds[3 * size_t(i) + 2]};
    one(Flow{data, steps}, h, gap, verdict, seed, i, out);
}

// Seeds in the order of their cells: {x, y, z, index as bits}; results go to their index. Index 0xffffffff: no seed.
extern "C" __global__ void __launch_bounds__(128)
trace_sorted(const __grid_constant__ GridData<RW_REAL> data, const GridStep<RW_REAL>* __restrict__ steps, RW_REAL h, double gap, Verdict verdict,
             const float4* __restrict__ sorted, uint32_t n, Outputs out) {
    const uint32_t i = blockIdx.x * 128u + threadIdx.x;
    if (i >= n) return;
    const float4 s = __ldg(sorted + i);
    if (__float_as_uint(s.w) == 0xffffffffu) return;
    const float seed[3] = {s.x, s.y, s.z};
    one(Flow{data, steps}, h, gap, verdict, seed, __float_as_uint(s.w), out);
}
