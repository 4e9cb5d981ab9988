/* Measures a solver's step including publishing: a seven-point diffusion of three components, which is limited by memory bandwidth.
 *
 * Arguments: nodes along each axis (96), steps, microseconds of pause after each, which are not counted (0). Prints the median and 99th percentile of a
 * whole step and the median of publishing alone, in ms. Without steps it reads commands and answers each with a line: "open RING" ("-": none), "run STEPS", "close", and
 * "spin MILLISECONDS": rounds of pure arithmetic per microsecond, which distinguish threads of one core from cores. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <ridgewatch.h>

static long n;
static size_t plane;
static float *from, *to;
static rw_field *field;
static long number;

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1e3 + t.tv_nsec * 1e-6;
}

static int by_size(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* `ring` NULL: the ring that RIDGEWATCH_RING names. */
static void open_ring(const char *ring) {
    rw_description *grid = rw_describe(3);
    for (uint32_t axis = 0; axis < 3; axis++) rw_describe_uniform(grid, axis, 0.0, 1.0, n, 0.0);
    if (rw_open(ring, grid, &field) > RW_OFF) printf("error %s\n", rw_error());
    rw_free_description(grid);
}

/* Prints `word` and the times. */
static void run(const char *word, long steps, long rest) {
    double *whole = malloc(steps * sizeof *whole), *publishing = malloc(steps * sizeof *publishing);
    if (!whole || !publishing) exit(1);
    for (long step = 0; step < steps; step++, number++) {
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
        rw_publish_f32(field, number, number * 0.01, from, from + plane, from + 2 * plane);
        const double end = now();
        whole[step] = end - begin;
        publishing[step] = end - computed;
        const struct timespec nap = {0, rest * 1000};
        if (rest) nanosleep(&nap, NULL);
    }
    qsort(whole, steps, sizeof *whole, by_size);
    qsort(publishing, steps, sizeof *publishing, by_size);
    printf("%s %.3f %.3f %.3f\n", word, whole[steps / 2], whole[steps * 99 / 100], publishing[steps / 2]);
    free(whole);
    free(publishing);
}

/* Independent sums in registers, which only another thread of the same core can slow down. */
static void spin(long milliseconds) {
    double sums[8] = {1, 2, 3, 4, 5, 6, 7, 8}, rounds = 0;
    const double begin = now();
    do {
        for (long i = 0; i < 10000; i++)
            for (int k = 0; k < 8; k++) sums[k] = sums[k] * 0.999 + 1e-3;
        rounds += 1e4;
    } while (now() - begin < milliseconds);
    for (int k = 1; k < 8; k++) sums[0] += sums[k];
    printf("spin %.3f %g\n", rounds / (now() - begin) * 1e-3, sums[0]);
}

static void close_ring(void) {
    rw_close(field);
    field = NULL;
}

int main(int argc, char **argv) {
    n = argc > 1 ? strtol(argv[1], NULL, 10) : 96;
    const long steps = argc > 2 ? strtol(argv[2], NULL, 10) : 0, rest = argc > 3 ? strtol(argv[3], NULL, 10) : 0;
    if (rest < 0 || rest > 999999 || n < 8 || n > 512 || steps < 0) return 2;
    plane = (size_t)n * n * n;
    from = malloc(3 * plane * sizeof *from);
    to = malloc(3 * plane * sizeof *to);
    if (!from || !to) return 1;
    for (size_t i = 0; i < 3 * plane; i++) from[i] = to[i] = (float)(i * 2654435761u % 1000) / 1000 - 0.5f;
    setvbuf(stdout, NULL, _IOLBF, 0);
    if (steps > 0) {
        open_ring(NULL);
        run("step", steps, rest);
        close_ring();
        return from[plane / 2] > 1e9f;
    }
    char line[4096];
    while (fgets(line, sizeof line, stdin)) {
        line[strcspn(line, "\n")] = 0;
        if (!strncmp(line, "open ", 5)) {
            close_ring();
            if (strcmp(line + 5, "-")) open_ring(line + 5);
            puts("open");
        } else if (!strncmp(line, "run ", 4)) {
            const long count = strtol(line + 4, NULL, 10);
            if (count < 1 || count > 1000000) return 2;
            run("run", count, 0);
        } else if (!strncmp(line, "spin ", 5)) {
            const long milliseconds = strtol(line + 5, NULL, 10);
            if (milliseconds < 1 || milliseconds > 60000) return 2;
            spin(milliseconds);
        } else if (!strcmp(line, "close")) {
            close_ring();
            puts("close");
        } else {
            return 2;
        }
    }
    return from[plane / 2] > 1e9f;
}
