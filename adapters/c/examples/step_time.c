/* How long a solver's step takes, publishing with it: a seven-point diffusion of three components, the part of a solver that memory bounds.
 *
 * Arguments: nodes along each axis (96), steps (300), microseconds of rest after each, which are not counted (0). Prints the median and 99th percentile of a whole step and of publishing alone, in ms. */
#include <stdio.h>
#include <stdlib.h>
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
    const long n = argc > 1 ? strtol(argv[1], NULL, 10) : 96, steps = argc > 2 ? strtol(argv[2], NULL, 10) : 300;
    const long rest = argc > 3 ? strtol(argv[3], NULL, 10) : 0;
    if (rest < 0 || rest > 999999 || n < 8 || n > 512 || steps < 10) return 2;
    const size_t plane = (size_t)n * n * n;
    float *from = malloc(3 * plane * sizeof *from), *to = malloc(3 * plane * sizeof *to);
    double *whole = malloc(steps * sizeof *whole), *publishing = malloc(steps * sizeof *publishing);
    if (!from || !to || !whole || !publishing) return 1;
    for (size_t i = 0; i < 3 * plane; i++) from[i] = to[i] = (float)(i * 2654435761u % 1000) / 1000 - 0.5f;
    rw_description *grid = rw_describe(3);
    for (uint32_t axis = 0; axis < 3; axis++) rw_describe_uniform(grid, axis, 0.0, 1.0, n, 0.0);
    rw_field *field = NULL;
    if (rw_open(NULL, grid, &field) > RW_OFF) fprintf(stderr, "step_time: %s\n", rw_error());
    rw_free_description(grid);
    for (long step = 0; step < steps; step++) {
        const double begin = now();
        for (int c = 0; c < 3; c++)
            for (long k = 1; k < n - 1; k++)
                for (long j = 1; j < n - 1; j++) {
                    const size_t row = c * plane + (k * n + j) * n;
                    for (long i = 1; i < n - 1; i++) {
                        const size_t at = row + i;
                        to[at] = 0.4f * from[at] + 0.1f * (from[at - 1] + from[at + 1] + from[at - n] + from[at + n] + from[at - n * n] + from[at + n * n]);
                    }
                }
        float *next = from;
        from = to;
        to = next;
        const double computed = now();
        rw_publish_f32(field, step, step * 0.01, from, from + plane, from + 2 * plane);
        const double end = now();
        whole[step] = end - begin;
        publishing[step] = end - computed;
        const struct timespec nap = {0, rest * 1000};
        if (rest) nanosleep(&nap, NULL);
    }
    rw_close(field);
    qsort(whole, steps, sizeof *whole, by_size);
    qsort(publishing, steps, sizeof *publishing, by_size);
    printf("step %.3f %.3f publish %.3f %.3f\n", whole[steps / 2], whole[steps * 99 / 100], publishing[steps / 2], publishing[steps * 99 / 100]);
    return from[plane / 2] > 1e9f;
}
