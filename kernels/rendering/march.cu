// Marching kernels. Per window, light and transfer function: march_bricks, then march_columns or march_points. Per pass: march_pixels.
// The volumes are larger than L2 but each value is used by several rays, so that loads of cached lines are the limit, not memory.
#include "rendering/march.cuh"

using namespace rw;

// Unit coordinates of nodes `first` to `first + n`, for a predictor that lays out a network on nodes.
extern "C" __global__ void __launch_bounds__(256) node_points(const Table nodes, uint64_t first, uint32_t n, float* __restrict__ points) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    const uint64_t index = first + i;
    const uint64_t row = uint64_t(nodes.nodes[0]), layer = row * uint64_t(nodes.nodes[1]);
    const uint32_t node[3] = {uint32_t(index % row), uint32_t(index % layer / row), uint32_t(index / layer)};
    for (int k = 0; k < 3; ++k) points[3 * size_t(i) + k] = k < nodes.dimensions ? float(node[k]) / float(nodes.nodes[k] - 1) : 0.5f;
}

// A warp a brick.
extern "C" __global__ void __launch_bounds__(256) march_bricks(const Table nodes, const Bricks bricks, uint32_t n, float* __restrict__ highest) {
    const uint32_t brick = blockIdx.x * 8u + threadIdx.x / 32u;
    if (brick >= n) return;
    float most = highest_node(nodes, bricks, brick, int(threadIdx.x & 31u), 32);
    for (int apart = 16; apart > 0; apart /= 2) most = fmaxf(most, __shfl_xor_sync(0xffffffffu, most, apart));
    if ((threadIdx.x & 31u) == 0u) highest[brick] = most;
}

// A thread a column, a warp for 8 x 4 columns, so that its lookups share lines along every axis.
extern "C" __global__ void __launch_bounds__(128) march_columns(const __grid_constant__ FrameScene scene, const __grid_constant__ March march) {
    const int lane = int(threadIdx.x & 31u), warp = int(threadIdx.x / 32u);
    const int v = int(blockIdx.x) * 16 + (warp % 2) * 8 + lane % 8, w = int(blockIdx.y) * 8 + (warp / 2) * 4 + lane / 8;
    if (v >= march.light.columns[0] || w >= march.light.columns[1]) return;
    fill_column(scene, march, march.light.first[0] + v, march.light.first[1] + w);
}

// A thread a node of a point light's grid.
extern "C" __global__ void __launch_bounds__(128)
march_points(const __grid_constant__ FrameScene scene, const __grid_constant__ March march, uint32_t n) {
    const uint32_t i = blockIdx.x * 128u + threadIdx.x;
    if (i < n) fill_node(scene, march, i);
}

// `lanes` threads a pixel, 1, 2 or 4, which march its rays in turn: rays of a pixel part less than those of others, so that the threads of a warp do the
// same for longer. Warps of 4 x (8 / lanes) pixels, blocks of 16 x (16 / lanes). `fresh`: 1 on the first pass since the restart.
extern "C" __global__ void __launch_bounds__(256, 4)
march_pixels(const __grid_constant__ FrameScene scene, const __grid_constant__ March march, double* __restrict__ sums, int fresh, uint32_t lanes) {
    const uint32_t lane = threadIdx.x % lanes, place = (threadIdx.x & 31u) / lanes, warp = threadIdx.x / 32u, tall = 8u / lanes;
    const uint32_t column = blockIdx.x * 16u + (warp % 4u) * 4u + place % 4u, row = (blockIdx.y * 2u + warp / 4u) * tall + place / 4u;
    // The threads of a pixel stay or leave together.
    if (column >= scene.width || row >= scene.height) return;
    const uint32_t pixel = row * scene.width + column;
    RaySum sum = march_rays(scene, march, pixel, lane, lanes);
    const uint32_t together = ((1u << lanes) - 1u) << ((threadIdx.x & 31u) - lane);
    float* const fields[RAY_FIELDS] = {&sum.radiance[0], &sum.radiance[1], &sum.radiance[2], &sum.alpha, &sum.ftle, &sum.missing};
    for (uint32_t apart = 1u; apart < lanes; apart *= 2u) {
        RW_UNROLL
        for (int k = 0; k < RAY_FIELDS; ++k) *fields[k] += __shfl_xor_sync(together, *fields[k], apart);
    }
    if (lane == 0u) add_rays(sum, size_t(scene.width) * scene.height, pixel, sums, fresh != 0);
}

// A block a check. found: radiance and opacity of each check.
extern "C" __global__ void __launch_bounds__(1024)
march_checks(const __grid_constant__ FrameScene scene, const __grid_constant__ March march, const Check* __restrict__ checks,
             float* __restrict__ found) {
    __shared__ float memory[CHECK_MEMORY];
    const Check check = checks[blockIdx.x];
    check_ray(Block{}, scene, march, check.pixel, check.ray, check.step, check.shadow_step, NO_DRAW, found + 4 * blockIdx.x, memory);
}
