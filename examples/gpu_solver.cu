// A solver on the GPU, as far as sharing the device goes: a loop of steps bound by arithmetic or by memory.
//
//     nvcc -O3 -arch=native gpu_solver.cu -o gpu_solver
//
// Reads lines "compute STEPS" or "memory STEPS" and answers each with the word, the mean and the 99th percentile of a step in ms. A step is some 5 ms of
// kernels on an H200 and ends with a synchronisation, as a solver's time step does.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

static void check(cudaError_t status, const char *what) {
    if (status == cudaSuccess) return;
    std::fprintf(stderr, "gpu_solver: %s: %s\n", what, cudaGetErrorString(status));
    std::exit(1);
}

// Four independent chains a thread, so that the multiply-adds follow one another.
__global__ void arithmetic(float *out, int rounds, float a, float b) {
    float x0 = threadIdx.x, x1 = x0 + 1, x2 = x0 + 2, x3 = x0 + 3;
    for (int i = 0; i < rounds; i++) {
        x0 = fmaf(x0, a, b);
        x1 = fmaf(x1, a, b);
        x2 = fmaf(x2, a, b);
        x3 = fmaf(x3, a, b);
    }
    out[blockIdx.x * blockDim.x + threadIdx.x] = x0 + x1 + x2 + x3;
}

// STREAM's triad.
__global__ void triad(float4 *to, const float4 *from, const float4 *other, size_t count) {
    for (size_t i = blockIdx.x * (size_t)blockDim.x + threadIdx.x; i < count; i += (size_t)gridDim.x * blockDim.x) {
        const float4 p = from[i], q = other[i];
        to[i] = make_float4(p.x + 0.5f * q.x, p.y + 0.5f * q.y, p.z + 0.5f * q.z, p.w + 0.5f * q.w);
    }
}

int main() {
    cudaDeviceProp about;
    check(cudaGetDeviceProperties(&about, 0), "device");
    const int blocks = about.multiProcessorCount * 8, threads = 256;
    const size_t count = size_t(1) << 26;  // 1 GiB each
    float4 *p, *q, *r;
    check(cudaMalloc(&p, count * sizeof *p), "memory");
    check(cudaMalloc(&q, count * sizeof *q), "memory");
    check(cudaMalloc(&r, count * sizeof *r), "memory");
    check(cudaMemset(q, 0, count * sizeof *q), "memory");
    check(cudaMemset(r, 0, count * sizeof *r), "memory");
    char line[64];
    while (std::fgets(line, sizeof line, stdin)) {
        char what[16];
        int steps = 0;
        if (std::sscanf(line, "%15s %d", what, &steps) != 2 || steps < 1 || steps > 1000000) return 2;
        const bool memory = !std::strcmp(what, "memory");
        std::vector<double> times;
        for (int step = 0; step < steps; step++) {
            const auto begin = std::chrono::steady_clock::now();
            if (memory) {
                for (int k = 0; k < 6; k++) triad<<<blocks, threads>>>(p, q, r, count);
            } else {
                for (int k = 0; k < 6; k++) arithmetic<<<blocks, threads>>>(reinterpret_cast<float *>(p), 25000, 0.999f, 0.001f);
            }
            check(cudaGetLastError(), "launch");
            check(cudaDeviceSynchronize(), "step");
            times.push_back(std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - begin).count());
        }
        double sum = 0;
        for (const double time : times) sum += time;
        std::sort(times.begin(), times.end());
        std::printf("%s %.4f %.4f\n", what, sum / times.size(), times[times.size() * 99 / 100]);
        std::fflush(stdout);
    }
    return 0;
}
