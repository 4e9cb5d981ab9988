// Portability layer of all kernels: function attributes, math overloads, read-only loads and half precision. The same source compiles for the
// device (NVRTC) and as host C++, which tests compare with the Rust reference.
#pragma once

#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
#define RW_FN __device__ __forceinline__
#define RW_DEVICE 1
#define RW_UNROLL _Pragma("unroll")
#else
#include <cmath>
#include <cstdint>
#include <cstring>
#define RW_FN inline
#define RW_DEVICE 0
#define RW_UNROLL
#endif

#if defined(__CUDACC_RTC__)
typedef unsigned char uint8_t;
typedef unsigned short uint16_t;
typedef unsigned int uint32_t;
typedef unsigned long long uint64_t;
typedef int int32_t;
#elif defined(__CUDACC__)
#include <cstdint>
#endif

namespace rw {

template <class R> struct Limits;
template <> struct Limits<float> {
    static RW_FN float tiny() { return 1e-30f; }
};
template <> struct Limits<double> {
    static RW_FN double tiny() { return 1e-30; }
};

// a * b + c, rounded once.
RW_FN float fma_(float a, float b, float c) { return fmaf(a, b, c); }
RW_FN double fma_(double a, double b, double c) { return fma(a, b, c); }
RW_FN float sqrt_(float a) { return sqrtf(a); }
RW_FN double sqrt_(double a) { return sqrt(a); }
RW_FN float abs_(float a) { return fabsf(a); }
RW_FN double abs_(double a) { return fabs(a); }
RW_FN float floor_(float a) { return floorf(a); }
RW_FN double floor_(double a) { return floor(a); }
RW_FN float log_(float a) { return logf(a); }
RW_FN double log_(double a) { return log(a); }
RW_FN float atan2_(float y, float x) { return atan2f(y, x); }
RW_FN double atan2_(double y, double x) { return atan2(y, x); }
// If one argument is NaN, min_ and max_ of floats return the other one.
RW_FN float min_(float a, float b) { return fminf(a, b); }
RW_FN double min_(double a, double b) { return fmin(a, b); }
RW_FN float max_(float a, float b) { return fmaxf(a, b); }
RW_FN double max_(double a, double b) { return fmax(a, b); }
RW_FN int min_(int a, int b) { return a < b ? a : b; }
RW_FN int max_(int a, int b) { return a > b ? a : b; }

// Product and sum that the compiler never fuses, since the CPU's are not fused.
RW_FN double times(double a, double b) {
#if RW_DEVICE
    return __dmul_rn(a, b);
#else
    return a * b;
#endif
}
RW_FN double plus(double a, double b) {
#if RW_DEVICE
    return __dadd_rn(a, b);
#else
    return a + b;
#endif
}

RW_FN bool is_nan(float a) { return a != a; }
RW_FN bool is_nan(double a) { return a != a; }

// Vectors that one 16-byte access reads or writes.
struct alignas(16) Float4 {
    float x, y, z, w;
};
struct alignas(16) Uint4 {
    uint32_t x, y, z, w;
};

// Loads through the read-only data cache.
#if RW_DEVICE
template <class T> RW_FN T load(const T* p) { return __ldg(p); }
RW_FN Float4 load(const Float4* p) {
    float4 v = __ldg(reinterpret_cast<const float4*>(p));
    return {v.x, v.y, v.z, v.w};
}
RW_FN Uint4 load(const Uint4* p) {
    uint4 v = __ldg(reinterpret_cast<const uint4*>(p));
    return {v.x, v.y, v.z, v.w};
}
#else
// Features of a table are read in pairs, which host memory need not align.
template <class T> RW_FN T load(const T* p) {
    T value;
    std::memcpy(&value, p, sizeof(T));
    return value;
}
#endif

// IEEE half precision. cuda_fp16.h is not used because NVRTC finds it only if the CUDA toolkit is installed.
RW_FN float from_half(uint16_t h) {
#if RW_DEVICE
    float f;
    asm("cvt.f32.f16 %0, %1;" : "=f"(f) : "h"(h));
    return f;
#else
    uint32_t sign = uint32_t(h & 0x8000u) << 16, exponent = (h >> 10) & 31u, mantissa = h & 1023u, bits;
    if (exponent == 31u) bits = sign | 0x7f800000u | (mantissa << 13);
    else if (exponent != 0u) bits = sign | ((exponent + 112u) << 23) | (mantissa << 13);
    else {
        float f = std::ldexp(float(mantissa), -24);
        return sign ? -f : f;
    }
    float f;
    std::memcpy(&f, &bits, 4);
    return f;
#endif
}
RW_FN uint16_t to_half(float f) {
#if RW_DEVICE
    uint16_t h;
    asm("cvt.rn.f16.f32 %0, %1;" : "=h"(h) : "f"(f));
    return h;
#else
    uint32_t bits;
    std::memcpy(&bits, &f, 4);
    uint16_t sign = uint16_t((bits >> 16) & 0x8000u);
    if (f != f) return uint16_t(sign | 0x7fffu);
    float a = std::fabs(f);
    if (a >= 65520.0f) return uint16_t(sign | 0x7c00u);
    // Rounds to nearest even at the spacing of the binade; below 2^-14 at that of the subnormals.
    int exponent = a < 6.103515625e-5f ? -14 : std::ilogb(a);
    float spacing = std::ldexp(1.0f, exponent - 10);
    uint32_t steps = uint32_t(std::nearbyint(a / spacing));
    uint32_t h = a < 6.103515625e-5f ? steps : ((uint32_t(exponent + 15) << 10) + (steps - 1024u));
    return uint16_t(sign | h);
#endif
}

}  // namespace rw
