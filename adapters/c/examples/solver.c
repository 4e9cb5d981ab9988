/* A small solver that publishes: a decaying, drifting 2-D vortex lattice, in closed form on a periodic box.
 *
 *     cc solver.c $(pkg-config --cflags --libs ridgewatch) -lm -o solver
 *     RIDGEWATCH_RING=/dev/shm/ridgewatch-$(id -u)/demo ./solver 200
 *
 * Arguments: steps (100), nodes along each axis (64), milliseconds per step (20), wait limit in milliseconds (0). */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include <ridgewatch.h>

static long argument(int argc, char **argv, int at, long otherwise) {
    return argc > at ? strtol(argv[at], NULL, 10) : otherwise;
}

int main(int argc, char **argv) {
    const long steps = argument(argc, argv, 1, 100), n = argument(argc, argv, 2, 64);
    const long pause = argument(argc, argv, 3, 20), wait = argument(argc, argv, 4, 0);
    if (steps < 1 || n < 4 || n > 4096 || pause < 0 || wait < 0) {
        fprintf(stderr, "solver [STEPS [NODES [MILLISECONDS A STEP [WAIT LIMIT]]]]\n");
        return 2;
    }
    if (rw_version() != RW_VERSION) {
        fprintf(stderr, "another version of libridgewatch_adapter\n");
        return 1;
    }
    const double box = 6.283185307179586, dt = 0.05;
    rw_description *grid = rw_describe(2);
    rw_describe_uniform(grid, 0, 0.0, box * (n - 1) / n, n, box);
    rw_describe_uniform(grid, 1, 0.0, box * (n - 1) / n, n, box);
    rw_describe_wait(grid, (uint32_t)wait);
    rw_field *field = NULL;
    rw_status opened = rw_open(NULL, grid, &field);
    rw_free_description(grid);
    if (opened > RW_OFF) fprintf(stderr, "solver: not published: %s\n", rw_error());
    if (opened == RW_OFF) fprintf(stderr, "solver: RIDGEWATCH_RING is not set: nothing is published\n");

    double *u = malloc(sizeof *u * n * n), *v = malloc(sizeof *v * n * n);
    if (!u || !v) return 1;
    for (long step = 0; step < steps; step++) {
        const double t = step * dt, drift = 0.4 * t;
        for (long j = 0; j < n; j++)
            for (long i = 0; i < n; i++) {
                const double x = box * i / n - drift, y = box * j / n + 0.6 * sin(0.3 * t);
                u[j * n + i] = 0.4 + sin(2 * x) * cos(y) + 0.3 * cos(3 * y);
                v[j * n + i] = -2 * cos(2 * x) * sin(y) + 0.3 * sin(2 * x + t);
            }
        rw_status published = rw_publish_f64(field, step, t, u, v, NULL);
        if (published > RW_OFF) fprintf(stderr, "solver: step %ld: %s\n", step, rw_error());
        const struct timespec nap = {pause / 1000, pause % 1000 * 1000000};
        nanosleep(&nap, NULL);
    }
    uint64_t published = 0, overwrote = 0;
    rw_statistics(field, &published, &overwrote);
    printf("%llu steps published, %llu of them before ridgewatch had taken an older one\n", (unsigned long long)published,
           (unsigned long long)overwrote);
    rw_close(field);
    free(u);
    free(v);
    return 0;
}
