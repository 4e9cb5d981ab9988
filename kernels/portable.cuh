// What lets the numerics compile three ways: by NVRTC, by nvcc, and as host C++ for the tests.
#pragma once

#ifdef __CUDACC__
#define RW_HD __device__
#define RW_UNROLL _Pragma("unroll")
#define RW_INFINITY __int_as_float(0x7f800000)
#define RW_NAN __int_as_float(0x7fc00000)
#else
#include <math.h>
#include <string.h>
#define RW_HD
#define RW_UNROLL
#define RW_INFINITY INFINITY
#define RW_NAN NAN
#endif

namespace rw {

typedef unsigned int u32;
typedef unsigned long long u64;

#ifdef __CUDACC__
__device__ inline u32 float_bits(float value) { return __float_as_uint(value); }
__device__ inline float bits_float(u32 bits) { return __uint_as_float(bits); }
__device__ inline void atomic_add(u32* at, u32 value) { atomicAdd(at, value); }
__device__ inline void atomic_max(u32* at, u32 value) { atomicMax(at, value); }
__device__ inline u32 relaxed_load(const u32* at) { return *(const volatile u32*)at; }
// The next free index of a queue: one atomic for all threads of a warp that come here together.
__device__ inline u32 reserve(u32* length) {
    const u32 together = __activemask();
    const u32 lane = threadIdx.x & 31u, leader = (u32)__ffs((int)together) - 1u;
    u32 base = 0;
    if (lane == leader) base = atomicAdd(length, (u32)__popc(together));
    return __shfl_sync(together, base, (int)leader) + (u32)__popc(together & ((1u << lane) - 1u));
}
#else
inline u32 float_bits(float value) {
    u32 bits;
    memcpy(&bits, &value, 4);
    return bits;
}
inline float bits_float(u32 bits) {
    float value;
    memcpy(&value, &bits, 4);
    return value;
}
inline void atomic_add(u32* at, u32 value) { *at += value; }
inline void atomic_max(u32* at, u32 value) { *at = *at > value ? *at : value; }
inline u32 relaxed_load(const u32* at) { return *at; }
inline u32 reserve(u32* length) { return (*length)++; }
#endif

// Sixteen bytes that move in one access.
struct alignas(16) Vec4 {
    float x, y, z, w;
};
struct alignas(16) UVec4 {
    u32 x, y, z, w;
};
struct alignas(8) Vec2 {
    float x, y;
};

RW_HD inline bool is_finite(float value) { return (float_bits(value) & 0x7f800000u) != 0x7f800000u; }

}  // namespace rw
