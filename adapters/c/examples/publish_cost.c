/* Measures the cost of a step: rw_publish_f32 of nodes^3 x 3 f32 alternates with one memcpy of the same bytes in one run.
 *
 * Arguments: nodes (256), steps (500). Prints milliseconds and the ratio at the median and the 99th percentile. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <ridgewatch.h>

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1e3 + t.tv_nsec * 1e-6;
}

static int by_size(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv) {
    const long n = argc > 1 ? strtol(argv[1], NULL, 10) : 256, steps = argc > 2 ? strtol(argv[2], NULL, 10) : 500;
    if (n < 4 || n > 1024 || steps < 10) return 2;
    const size_t plane = (size_t)n * n * n;
    float *source = malloc(plane * 3 * sizeof(float)), *target = malloc(plane * 3 * sizeof(float));
    double *copies = malloc(sizeof(double) * steps), *publishes = malloc(sizeof(double) * steps);
    if (!source || !target || !copies || !publishes) return 1;
    for (size_t i = 0; i < 3 * plane; i++) source[i] = (float)i;
    memset(target, 1, plane * 3 * sizeof(float));
    rw_description *grid = rw_describe(3);
    for (uint32_t axis = 0; axis < 3; axis++) rw_describe_uniform(grid, axis, 0.0, 1.0, n, 0.0);
    rw_field *field = NULL;
    const rw_status opened = rw_open(NULL, grid, &field);
    rw_free_description(grid);
    if (opened != RW_OK) {
        fprintf(stderr, "publish_cost: %s\n", opened == RW_OFF ? "RIDGEWATCH_RING is not set" : rw_error());
        return 1;
    }
    for (long step = 0; step < steps; step++) {
        source[step] = (float)step;
        const double begin = now();
        memcpy(target, source, plane * 3 * sizeof(float));
        const double between = now();
        if (rw_publish_f32(field, step, step, source, source + plane, source + 2 * plane) != RW_OK) {
            fprintf(stderr, "publish_cost: %s\n", rw_error());
            return 1;
        }
        const double end = now();
        copies[step] = between - begin;
        publishes[step] = end - between;
        /* Keeps the compiler from removing a copy. */
        if (target[step] != (float)step) return 1;
    }
    rw_close(field);
    qsort(copies, steps, sizeof(double), by_size);
    qsort(publishes, steps, sizeof(double), by_size);
    const long p99 = steps * 99 / 100;
    printf("%ld^3 x 3 f32 (%.1f MB), %ld steps\n", n, plane * 12 / 1e6, steps);
    printf("memcpy  median %.3f ms, 99th percentile %.3f ms\n", copies[steps / 2], copies[p99]);
    printf("publish median %.3f ms, 99th percentile %.3f ms\n", publishes[steps / 2], publishes[p99]);
    printf("ratio   median %.3f, 99th percentile %.3f\n", publishes[steps / 2] / copies[steps / 2], publishes[p99] / copies[p99]);
    return 0;
}
