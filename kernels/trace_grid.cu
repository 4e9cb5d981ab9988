// Log-stretch of seeds in a window of snapshots.
#include "grid_variant.cuh"

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

#if RW_DIFFERENCES
// As `trace_sorted`, with a particle a lane: a warp has as many seeds as their particles have room.
extern "C" __global__ void __launch_bounds__(128)
trace_particles(const __grid_constant__ GridData<RW_REAL> data, const GridStep<RW_REAL>* __restrict__ steps, RW_REAL h, double gap, Verdict verdict,
                const float4* __restrict__ sorted, uint32_t n, Outputs out) {
    constexpr uint32_t PARTICLES = 2 * Flow::C, SEEDS = 32 / PARTICLES;
    const uint32_t lane = threadIdx.x % 32, mine = lane / PARTICLES, first = mine < SEEDS ? mine * PARTICLES : 0;
    const uint32_t i = (blockIdx.x * 4 + threadIdx.x / 32) * SEEDS + mine;
    const float4 s = mine < SEEDS && i < n ? __ldg(sorted + i) : make_float4(0, 0, 0, __uint_as_float(0xffffffffu));
    const uint32_t at = __float_as_uint(s.w), group = at == 0xffffffffu ? 0 : ((1u << PARTICLES) - 1) << first;
    const double from[3] = {s.x, s.y, s.z};
    const Flow flow{data, steps};
    const auto path = trace_differences_lanes(flow, verdict.steps, h, gap, from, int(lane - first) % int(PARTICLES), int(first), group);
    const float seed[3] = {s.x, s.y, s.z};
    if (group != 0 && lane == first) give(flow, path, verdict, seed, at, out);
}
#endif
