// Snapshots on their way into the window.
#include "base.cuh"

using namespace rw;

// Nodes in half precision: velocity / scale, and the mark (or the vertical velocity). 8 bytes a node.
extern "C" __global__ void __launch_bounds__(256)
to_half_nodes(const float4* __restrict__ nodes, uint64_t n, float inverse_scale, uint2* __restrict__ out) {
    const uint64_t i = blockIdx.x * uint64_t(256) + threadIdx.x;
    if (i >= n) return;
    const float4 v = nodes[i];
    // What is not a number stays so: the mark of a missing node.
    const uint32_t last = v.w != v.w ? 0x7e00u : to_half(v.w * inverse_scale);
    out[i] = make_uint2(to_half(v.x * inverse_scale) | uint32_t(to_half(v.y * inverse_scale)) << 16, to_half(v.z * inverse_scale) | last << 16);
}
