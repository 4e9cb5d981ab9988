// The table surrogate: seeds at its nodes, repair of values that are not finite, and multilinear lookups.
#include "common/domain.cuh"
#include "tracing/table.cuh"

using namespace rw;

struct TableFrame {
    int nodes[3];
    int dimensions;
    UnitBox domain;
};
static_assert(sizeof(TableFrame) == 88, "layout");

// Seeds at the nodes, {x, y, z, node index}. Bricks of 8x8x8 nodes (8x8 in the plane), each in
// Morton order, keep neighbours together without a sort. Nodes beyond the table get the index 0xffffffff. `first`: number of the first seed in
// the sequence of all bricks' nodes.
extern "C" __global__ void __launch_bounds__(256)
table_bricks(const TableFrame frame, uint32_t bricks_x, uint32_t bricks_y, uint64_t first, uint32_t n, float4* __restrict__ sorted) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    const uint64_t g = first + i;
    const uint32_t size = frame.dimensions == 3 ? 512u : 64u, in = uint32_t(g % size);
    const uint64_t brick = g / size;
    uint32_t node[3];
    // Morton order within the brick.
    if (frame.dimensions == 3) {
        node[0] = (in & 1u) | (in >> 2 & 2u) | (in >> 4 & 4u);
        node[1] = (in >> 1 & 1u) | (in >> 3 & 2u) | (in >> 5 & 4u);
        node[2] = (in >> 2 & 1u) | (in >> 4 & 2u) | (in >> 6 & 4u);
    } else {
        node[0] = (in & 1u) | (in >> 1 & 2u) | (in >> 2 & 4u);
        node[1] = (in >> 1 & 1u) | (in >> 2 & 2u) | (in >> 3 & 4u);
        node[2] = 0;
    }
    node[0] += uint32_t(brick % bricks_x) * 8;
    node[1] += uint32_t(brick / bricks_x % bricks_y) * 8;
    node[2] += frame.dimensions == 3 ? uint32_t(brick / (uint64_t(bricks_x) * bricks_y)) * 8 : 0;
    bool in_table = true;
    float unit[3], p[3];
#pragma unroll
    for (int k = 0; k < 3; k++) {
        in_table = in_table && node[k] < uint32_t(frame.nodes[k]);
        unit[k] = k < frame.dimensions ? float(node[k]) / float(frame.nodes[k] - 1) : 0.5f;
    }
    from_unit(frame.domain, unit, p);
    const uint32_t index = (node[2] * uint32_t(frame.nodes[1]) + node[1]) * uint32_t(frame.nodes[0]) + node[0];
    sorted[i] = make_float4(p[0], p[1], p[2], __uint_as_float(in_table ? index : 0xffffffffu));
}

// Replaces values that are not finite by 0, since interpolation would spread them to all adjacent cells, and counts them.
extern "C" __global__ void __launch_bounds__(256) table_mend(float* values, uint64_t n, uint32_t* not_finite) {
    const uint64_t i = blockIdx.x * uint64_t(256) + threadIdx.x;
    const bool odd = i < n && !isfinite(values[i]);
    if (odd) values[i] = 0.0f;
    const uint32_t ballot = __ballot_sync(0xffffffffu, odd);
    if ((threadIdx.x & 31u) == 0 && ballot) atomicAdd(not_finite, __popc(ballot));
}

// points: 3 floats each, unit coordinates; they are clamped to the unit cube.
extern "C" __global__ void __launch_bounds__(256)
table_lookup(const Table table, const float* __restrict__ points, uint32_t n, float* __restrict__ out) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    const float unit[3] = {points[3 * size_t(i)], points[3 * size_t(i) + 1], points[3 * size_t(i) + 2]};
    out[i] = look_up(table, unit);
}
