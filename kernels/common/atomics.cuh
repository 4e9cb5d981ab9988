// Bit casts of floats and atomic operations. As host C++ these are plain operations on one thread.
#pragma once
#include "common/base.cuh"

namespace rw {

// Two floats that one 8-byte access reads or writes.
struct alignas(8) Float2 {
    float x, y;
};

#if RW_DEVICE
RW_FN float infinity() { return __uint_as_float(0x7f800000u); }
RW_FN float not_a_number() { return __uint_as_float(0x7fc00000u); }
RW_FN uint32_t float_bits(float value) { return __float_as_uint(value); }
RW_FN float bits_float(uint32_t bits) { return __uint_as_float(bits); }
RW_FN void atomic_add(uint32_t* at, uint32_t value) { atomicAdd(at, value); }
RW_FN void atomic_max(uint32_t* at, uint32_t value) { atomicMax(at, value); }
RW_FN uint32_t relaxed_load(const uint32_t* at) { return *(const volatile uint32_t*)at; }
// Sum over the lanes of a warp, in every lane. All of them must call it.
template <class T> RW_FN T warp_sum(T value) {
    for (int apart = 16; apart > 0; apart /= 2) value += __shfl_xor_sync(0xffffffffu, value, apart);
    return value;
}
// Appends to a queue and returns the new entry's index. One atomic serves all active threads of a warp (warp-aggregated atomics).
RW_FN uint32_t reserve(uint32_t* length) {
    const uint32_t together = __activemask();
    const uint32_t lane = threadIdx.x & 31u, leader = uint32_t(__ffs(int(together))) - 1u;
    uint32_t base = 0;
    if (lane == leader) base = atomicAdd(length, uint32_t(__popc(together)));
    return __shfl_sync(together, base, int(leader)) + uint32_t(__popc(together & ((1u << lane) - 1u)));
}
#else
RW_FN float infinity() { return INFINITY; }
RW_FN float not_a_number() { return NAN; }
RW_FN uint32_t float_bits(float value) {
    uint32_t bits;
    std::memcpy(&bits, &value, 4);
    return bits;
}
RW_FN float bits_float(uint32_t bits) {
    float value;
    std::memcpy(&value, &bits, 4);
    return value;
}
RW_FN void atomic_add(uint32_t* at, uint32_t value) { *at += value; }
RW_FN void atomic_max(uint32_t* at, uint32_t value) { *at = *at > value ? *at : value; }
RW_FN uint32_t relaxed_load(const uint32_t* at) { return *at; }
RW_FN uint32_t reserve(uint32_t* length) { return (*length)++; }
#endif

RW_FN bool is_finite(float value) { return (float_bits(value) & 0x7f800000u) != 0x7f800000u; }

}  // namespace rw
