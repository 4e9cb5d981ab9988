// Log-stretch of seeds in a window of snapshots: RK4 of the path and its variational equation, or central differences (Shadden et al. 2005).
#include "tracing/grid_variant.cuh"

#if RW_DIFFERENCES
// As `trace_sorted`, with one particle per lane. A warp traces as many seeds as it has room for all their particles.
extern "C" __global__ void __launch_bounds__(BLOCK)
trace_particles(const __grid_constant__ FlowData data, const FlowTimes* __restrict__ times, RW_REAL h, double difference_step, ResultPolicy policy,
                const float4* __restrict__ sorted, uint32_t n, Outputs out) {
    constexpr uint32_t PARTICLES = 2 * Flow::C, SEEDS = 32 / PARTICLES;
    const uint32_t lane = threadIdx.x % 32, mine = lane / PARTICLES, first = mine < SEEDS ? mine * PARTICLES : 0;
    const uint32_t i = (blockIdx.x * 4 + threadIdx.x / 32) * SEEDS + mine;
    const float4 s = mine < SEEDS && i < n ? __ldg(sorted + i) : make_float4(0, 0, 0, __uint_as_float(0xffffffffu));
    const uint32_t at = __float_as_uint(s.w), group = at == 0xffffffffu ? 0 : ((1u << PARTICLES) - 1) << first;
    const double from[3] = {s.x, s.y, s.z};
    const float seed[3] = {s.x, s.y, s.z};
    const Flow flow(data, times, seed);
    const auto path = trace_differences_lanes(flow, policy.steps, h, difference_step, from, int(lane - first) % int(PARTICLES), int(first), group);
    if (group != 0 && lane == first) write_results(flow, path, policy, seed, at, out);
}
#endif
