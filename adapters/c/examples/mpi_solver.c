/* A decomposed solver: each MPI rank publishes its block of a 3-D field, and strides exclude the ghost cells.
 *
 *     mpicc mpi_solver.c $(pkg-config --cflags --libs ridgewatch) -lm -o mpi_solver
 *     RIDGEWATCH_RING=/dev/shm/ridgewatch-$(id -u)/mpi mpirun -n 4 ./mpi_solver 200
 *
 * The field is the ABC flow with a drifting phase, so that every rank computes its values alone. The ghost exchange of a real solver does
 * not affect publishing. Arguments: steps (100), nodes along each axis (48), milliseconds per step (20), wait limit in ms (0). */
#include <math.h>
#include <mpi.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include <ridgewatch.h>

static long argument(int argc, char **argv, int at, long otherwise) {
    return argc > at ? strtol(argv[at], NULL, 10) : otherwise;
}

int main(int argc, char **argv) {
    MPI_Init(&argc, &argv);
    int rank, ranks, places[2] = {0, 0};
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    MPI_Comm_size(MPI_COMM_WORLD, &ranks);
    /* Pencils along x: ranks in y and z. */
    MPI_Dims_create(ranks, 2, places);
    const long steps = argument(argc, argv, 1, 100), n = argument(argc, argv, 2, 48);
    const long pause = argument(argc, argv, 3, 20), wait = argument(argc, argv, 4, 0);
    if (steps < 1 || n < 8 || n > 1024 || pause < 0 || wait < 0 || places[0] > n || places[1] > n) {
        if (rank == 0) fprintf(stderr, "mpi_solver [STEPS [NODES [MILLISECONDS A STEP [WAIT LIMIT]]]]\n");
        MPI_Abort(MPI_COMM_WORLD, 2);
    }
    const long py = rank % places[0], pz = rank / places[0];
    const uint64_t offset[3] = {0, n * py / places[0], n * pz / places[1]};
    const uint64_t extent[3] = {n, n * (py + 1) / places[0] - offset[1], n * (pz + 1) / places[1] - offset[2]};
    const double box = 6.283185307179586, dt = 0.05;

    rw_description *grid = rw_describe(3);
    for (uint32_t axis = 0; axis < 3; axis++) rw_describe_uniform(grid, axis, 0.0, box * (n - 1) / n, n, box);
    rw_describe_block(grid, (uint32_t)rank, (uint32_t)ranks, offset, extent);
    /* One number for this start distinguishes it from a restart with more or fewer ranks. */
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    uint64_t start = (uint64_t)now.tv_sec * 1000000000 + (uint64_t)now.tv_nsec;
    MPI_Bcast(&start, 1, MPI_UINT64_T, 0, MPI_COMM_WORLD);
    rw_describe_start(grid, start);
    rw_describe_wait(grid, (uint32_t)wait);
    rw_field *field = NULL;
    if (rw_open(NULL, grid, &field) > RW_OFF) fprintf(stderr, "rank %d: not published: %s\n", rank, rw_error());
    rw_free_description(grid);

    /* One ghost cell around the block. */
    const int64_t strides[3] = {1, (int64_t)extent[0] + 2, (int64_t)((extent[0] + 2) * (extent[1] + 2))};
    const size_t size = (extent[0] + 2) * (extent[1] + 2) * (extent[2] + 2), first = 1 + strides[1] + strides[2];
    float *u = calloc(3 * size, sizeof *u), *v = u + size, *w = v + size;
    if (!u) MPI_Abort(MPI_COMM_WORLD, 1);
    for (long step = 0; step < steps; step++) {
        const double t = step * dt, a = sqrt(3.0) + 0.5 * sin(0.7 * t), b = sqrt(2.0), c = 1.0;
        for (uint64_t k = 0; k < extent[2]; k++)
            for (uint64_t j = 0; j < extent[1]; j++)
                for (uint64_t i = 0; i < extent[0]; i++) {
                    const double x = box * (i + offset[0]) / n, y = box * (j + offset[1]) / n, z = box * (k + offset[2]) / n;
                    const size_t at = first + i + strides[1] * j + strides[2] * k;
                    u[at] = (float)(a * sin(z) + c * cos(y));
                    v[at] = (float)(b * sin(x) + a * cos(z));
                    w[at] = (float)(c * sin(y) + b * cos(x));
                }
        /* All ranks begin a step together, as in any solver. */
        MPI_Barrier(MPI_COMM_WORLD);
        if (rw_publish_strided_f32(field, step, t, u + first, v + first, w + first, strides) > RW_OFF)
            fprintf(stderr, "rank %d, step %ld: %s\n", rank, step, rw_error());
        const struct timespec nap = {pause / 1000, pause % 1000 * 1000000};
        nanosleep(&nap, NULL);
    }
    rw_close(field);
    free(u);
    MPI_Finalize();
    return 0;
}
