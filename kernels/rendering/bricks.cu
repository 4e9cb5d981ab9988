// Nodes of a laid out network that are traced instead, brick by brick. Mirrors src/backend/bricks.rs.
#include "common/domain.cuh"
#include "rendering/march.cuh"

using namespace rw;

// Nodes that belong to a brick alone: without its upper faces, unless the grid ends there.
static __device__ void own_nodes(const Table& nodes, uint32_t brick, int (&from)[3], int (&count)[3]) {
    for (int k = 0; k < 3; ++k) {
        const int bricks = max_((nodes.nodes[k] - 1 + BRICK - 1) / BRICK, 1);
        const int index = int(brick % uint32_t(bricks));
        brick /= uint32_t(bricks);
        from[k] = index * BRICK;
        count[k] = (index + 1 == bricks ? nodes.nodes[k] : from[k] + BRICK) - from[k];
    }
}

// Calls `each` with the place among a brick's own nodes and the node's indices, a block a brick.
template <typename Each>
static __device__ void for_nodes(const Table& nodes, uint32_t brick, Each each) {
    int from[3], count[3];
    own_nodes(nodes, brick, from, count);
    for (int i = int(threadIdx.x); i < count[0] * count[1] * count[2]; i += int(blockDim.x)) {
        const int node[3] = {from[0] + i % count[0], from[1] + i / count[0] % count[1], from[2] + i / (count[0] * count[1])};
        each(uint32_t(i), node);
    }
}

// `list`: number of each brick, and of its first node among the points.
extern "C" __global__ void __launch_bounds__(256)
brick_points(const Table nodes, const __grid_constant__ UnitBox domain, const uint2* __restrict__ list, float* __restrict__ points) {
    const uint2 brick = list[blockIdx.x];
    for_nodes(nodes, brick.x, [&](uint32_t i, const int (&node)[3]) {
        float unit[3], point[3];
        for (int k = 0; k < 3; ++k) unit[k] = k < nodes.dimensions ? float(node[k]) / float(nodes.nodes[k] - 1) : 0.5f;
        from_unit(domain, unit, point);
        for (int k = 0; k < 3; ++k) points[3 * (size_t(brick.y) + i) + k] = point[k];
    });
}

// Values that are not finite become 0, as in tables.
extern "C" __global__ void __launch_bounds__(256)
brick_store(const Table nodes, const uint2* __restrict__ list, const float* __restrict__ traced, float* __restrict__ values) {
    const uint2 brick = list[blockIdx.x];
    for_nodes(nodes, brick.x, [&](uint32_t i, const int (&node)[3]) {
        const float value = traced[size_t(brick.y) + i];
        values[(size_t(node[2]) * nodes.nodes[1] + node[1]) * nodes.nodes[0] + node[0]] = isfinite(value) ? value : 0.0f;
    });
}
