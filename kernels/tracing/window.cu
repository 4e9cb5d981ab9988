// Encodes snapshots of the window in half precision. RW_STORAGE as in grid.cuh.
#include "tracing/grid.cuh"

using namespace rw;

// Distance from one node to the next, in 8-byte groups of four halves.
constexpr int STRIDE = RW_STORAGE == F16_PAIRS ? 2 : 1;

RW_FN uint32_t pack(float low, float high) { return to_half(low) | uint32_t(to_half(high)) << 16; }
// NaN, which marks a missing node, stays NaN.
RW_FN uint2 encoded(float x, float y, float z, float w) { return make_uint2(pack(x, y), pack(z, w)); }
RW_FN float4 decoded(uint2 w) {
    return make_float4(from_half(uint16_t(w.x)), from_half(uint16_t(w.x >> 16)), from_half(uint16_t(w.y)), from_half(uint16_t(w.y >> 16)));
}

// Encodes nodes: velocity * factor, and the missing mark (or the vertical velocity) in the fourth place.
extern "C" __global__ void __launch_bounds__(256)
encode_nodes(const float4* __restrict__ nodes, uint64_t n, float factor, uint2* __restrict__ out) {
    const uint64_t i = blockIdx.x * uint64_t(256) + threadIdx.x;
    if (i >= n) return;
    const float4 v = nodes[i];
    out[i * STRIDE] = encoded(v.x * factor, v.y * factor, v.z * factor, v.w * factor);
}

// Writes behind each node its change to the same node of the next snapshot, from the encoded values of both. The change is marked missing if the
// next node is.
extern "C" __global__ void __launch_bounds__(256)
pair_nodes(uint2* __restrict__ nodes, const uint2* __restrict__ next, uint64_t n) {
    const uint64_t i = blockIdx.x * uint64_t(256) + threadIdx.x;
    if (i >= n) return;
    const float4 a = decoded(nodes[i * STRIDE]), b = decoded(next[i * STRIDE]);
    // The mark of the first node counts as 0 (see grid.cuh) and does not carry over to the change.
    nodes[i * STRIDE + 1] = encoded(b.x - a.x, b.y - a.y, b.z - a.z, is_nan(a.w) ? b.w : b.w - a.w);
}
