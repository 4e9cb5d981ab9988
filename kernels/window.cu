// Snapshots on their way into the window.
#include "base.cuh"

using namespace rw;

// Nodes in half precision: velocity / scale, and the mark. 8 bytes a node.
extern "C" __global__ void __launch_bounds__(256)
to_half_nodes(const float4* __restrict__ nodes, uint64_t n, float inverse_scale, uint2* __restrict__ out) {
    const uint64_t i = blockIdx.x * uint64_t(256) + threadIdx.x;
    if (i >= n) return;
    const float4 v = nodes[i];
    const uint32_t mark = v.w != v.w ? 0x7e00u : 0u;
    out[i] = make_uint2(to_half(v.x * inverse_scale) | uint32_t(to_half(v.y * inverse_scale)) << 16, to_half(v.z * inverse_scale) | mark << 16);
}
