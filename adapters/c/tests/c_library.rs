//! Tests of the C library: the header against the exported functions, and C programs that are compiled, run and followed.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use ridgewatch_wire::{Following, Geometry, Limits, Read, RingReader};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The folder in which cargo puts the shared library and the tests.
fn library_folder() -> PathBuf {
    let folder = std::env::current_exe().unwrap().parent().unwrap().to_owned();
    assert!(folder.join("libridgewatch_adapter.so").exists(), "no library in {}", folder.display());
    // The name that programs ask for; `make install-adapters` makes the same link. Tests of other processes may have made it.
    let _ = std::os::unix::fs::symlink("libridgewatch_adapter.so", folder.join(SONAME));
    folder
}

/// With the version of the header.
const SONAME: &str = "libridgewatch_adapter.so.2";

struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = PathBuf::from("/dev/shm").join(format!("rw-c-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        Self(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Kind of linking.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Link {
    Shared,
    Static,
}

/// Compiles a C program against the header and the library.
fn compile(source: &Path, to: &Path, link: Link, extra: &[&str]) {
    let (root, libraries) = (Path::new(env!("CARGO_MANIFEST_DIR")), library_folder());
    let mut cc = Command::new("cc");
    cc.args(["-std=c99", "-D_POSIX_C_SOURCE=200809L", "-O2", "-Wall", "-Wextra", "-Werror", "-I"]).arg(root.join("include"));
    cc.arg(source).arg("-o").arg(to);
    match link {
        Link::Shared => cc.arg("-L").arg(libraries).arg("-lridgewatch_adapter"),
        // As in Libs.private of ridgewatch.pc.
        Link::Static => cc.arg(libraries.join("libridgewatch_adapter.a")).args(["-lpthread", "-ldl"]),
    };
    let out = cc.arg("-lm").args(extra).output().expect("a C compiler");
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
}

/// Programs ask for the version that they were linked with, wherever the library is.
#[test]
fn the_library_is_known_by_its_version() {
    let build = tempfile("soname");
    let program = build.0.join("solver");
    compile(&Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/solver.c"), &program, Link::Shared, &[]);
    let out = Command::new("ldd").arg(&program).output().unwrap();
    let asked = String::from_utf8_lossy(&out.stdout).into_owned();
    assert!(asked.contains(&format!("{SONAME} =>")), "{asked}");
}

/// Writes the header if `RIDGEWATCH_WRITE_HEADER` is set (`make header`).
#[test]
fn the_header_is_that_of_the_library() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let config = cbindgen::Config::from_file(root.join("cbindgen.toml")).unwrap();
    let mut bytes = Vec::new();
    cbindgen::Builder::new().with_src(root.join("src/lib.rs")).with_config(config).generate().unwrap().write(&mut bytes);
    let (path, generated) = (root.join("include/ridgewatch.h"), String::from_utf8(bytes).unwrap());
    if std::env::var_os("RIDGEWATCH_WRITE_HEADER").is_some() {
        std::fs::write(&path, &generated).unwrap();
    }
    assert!(std::fs::read_to_string(&path).unwrap() == generated, "include/ridgewatch.h differs from src/lib.rs: run make header");
}

#[test]
fn a_c_solver_is_followed_and_needs_nobody() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let build = tempfile("solver");
    let program = build.0.join("solver");
    compile(&root.join("examples/solver.c"), &program, Link::Shared, &[]);
    let run = |ring: Option<&Path>, arguments: &[&str]| {
        let mut solver = Command::new(&program);
        solver.args(arguments).env("LD_LIBRARY_PATH", library_folder()).env_remove("RIDGEWATCH_RING");
        if let Some(ring) = ring {
            solver.env("RIDGEWATCH_RING", ring);
        }
        let out = solver.output().unwrap();
        (out.status.success(), String::from_utf8(out.stdout).unwrap(), String::from_utf8(out.stderr).unwrap())
    };
    // Switched off.
    let (good, said, told) = run(None, &["3", "8", "0"]);
    assert!(good && said.starts_with("0 steps published") && told.contains("is not set"), "{said}{told}");
    // Followed.
    let ring = Folder::new("solver");
    let following = Following::begin(&ring.0).unwrap();
    let (good, said, told) = run(Some(&ring.0), &["3", "8", "0"]);
    assert!(good && said.starts_with("3 steps published, 0 of them") && told.is_empty(), "{said}{told}");
    let mut reader = RingReader::open(&ring.0, 0, &Limits::default()).unwrap();
    let description = &reader.header().description;
    assert_eq!(description.shape(), [8, 8, 1]);
    assert!((description.axes[0].period.unwrap() - std::f64::consts::TAU).abs() < 1e-12);
    let mut values = Vec::new();
    for step in 0..3 {
        let Read::Step(info) = reader.read(&mut values).unwrap() else { panic!("step {step} is not there") };
        let (t, at) = (step as f64 * 0.05, |k: usize| std::f64::consts::TAU * k as f64 / 8.0);
        assert_eq!((info.step, info.time), (step, t));
        for (i, j) in (0..64).map(|n| (n % 8, n / 8)) {
            let (x, y) = (at(i) - 0.4 * t, at(j) + 0.6 * (0.3 * t).sin());
            let u = 0.4 + (2.0 * x).sin() * y.cos() + 0.3 * (3.0 * y).cos();
            assert!((f64::from(values[j * 8 + i]) - u).abs() < 1e-6);
        }
    }
    assert_eq!(reader.read(&mut values).unwrap(), Read::Ended);
    drop(following);
    assert!(!ring.0.exists(), "nothing is left behind");
    // Refused, and the solver goes on.
    let (good, said, told) = run(Some(Path::new("/proc/nowhere")), &["3", "8", "0"]);
    assert!(good && said.starts_with("0 steps published") && told.contains("not published"), "{said}{told}");
}

/// Longitude, latitude and height in two blocks of interleaved doubles, with the shared and with the static library.
#[test]
fn a_globe_in_blocks_arrives_from_either_library() {
    let build = tempfile("globe");
    let source = build.0.join("globe.c");
    std::fs::write(&source, GLOBE).unwrap();
    for link in [Link::Shared, Link::Static] {
        let program = build.0.join(format!("{link:?}"));
        compile(&source, &program, link, &[]);
        let ring = Folder::new("globe");
        let following = Following::begin(&ring.0).unwrap();
        let mut command = Command::new(&program);
        command.arg(&ring.0).env_remove("LD_LIBRARY_PATH");
        if link == Link::Shared {
            command.env("LD_LIBRARY_PATH", library_folder());
        }
        let out = command.output().unwrap();
        assert!(out.status.success(), "{link:?}: line {:?}: {}", out.status.code(), String::from_utf8_lossy(&out.stderr));
        for block in 0..2 {
            let mut reader = RingReader::open(&ring.0, block, &Limits::default()).unwrap();
            let description = reader.header().description.clone();
            assert_eq!(description.geometry, Geometry::Sphere { radius: 6.371e6 });
            assert_eq!((description.shape(), description.start, description.time_unit.as_str()), ([6, 4, 2], 7, "h"));
            assert_eq!(description.axes[0].coordinates, [0.0, 60.0, 120.0, 180.0, 240.0, 300.0]);
            assert_eq!((description.axes[0].period, description.axes[1].period), (Some(360.0), None));
            assert_eq!(description.axes[1].coordinates, [-80.0, -20.0, 10.0, 85.0]);
            assert_eq!((description.block.offset, description.block.extent), ([3 * u64::from(block), 0, 0], [3, 4, 2]));
            let mut values = Vec::new();
            let Read::Step(info) = reader.read(&mut values).unwrap() else { panic!("no step of block {block}") };
            assert_eq!((info.step, info.time), (5, 1.5));
            for (n, value) in values.iter().enumerate() {
                let (c, i, j, k) = (n / 24, n % 3, n / 3 % 4, n % 24 / 12);
                let longitude = 60.0 * (i + 3 * block as usize) as f32;
                assert_eq!(*value, longitude + 1000.0 * c as f32 + 10.0 * j as f32 + k as f32, "block {block}, {c} {i} {j} {k}");
            }
            assert_eq!(reader.read(&mut values).unwrap(), Read::Ended);
        }
        drop(following);
        assert!(!ring.0.exists(), "nothing is left behind");
    }
}

const GLOBE: &str = r#"
#include <ridgewatch.h>
#include <stdio.h>
#define WANT(x) do { if (!(x)) { fprintf(stderr, "%s (%s)\n", #x, rw_error()); return __LINE__; } } while (0)

int main(int argc, char **argv) {
    WANT(argc == 2 && rw_version() == RW_VERSION);
    const double latitudes[4] = {-80, -20, 10, 85}, heights[2] = {0, 1e4};
    rw_description *d = rw_describe(3);
    WANT(rw_describe_sphere(d, -1) == RW_OK && rw_describe_uniform(d, 0, 0, 300, 6, 360) == RW_OK);
    WANT(rw_describe_rectilinear(d, 1, latitudes, 4, 0) == RW_OK && rw_describe_rectilinear(d, 2, heights, 2, 0) == RW_OK);
    WANT(rw_describe_time_unit(d, "h") == RW_OK && rw_describe_start(d, 7) == RW_OK && rw_describe_slots(d, 2) == RW_OK);
    rw_field *fields[2] = {NULL, NULL};
    WANT(rw_open(argv[1], d, &fields[0]) == RW_ARGUMENT && !fields[0]);   /* the radius */
    WANT(rw_describe_sphere(d, 6.371e6) == RW_OK && rw_describe_wait(d, 1) == RW_OK);
    static double air[6 * 4 * 2][3];
    for (int n = 0; n < 48; n++)
        for (int c = 0; c < 3; c++) air[n][c] = 60 * (n % 6) + 1000 * c + 10 * (n / 6 % 4) + n / 24;
    const int64_t strides[3] = {3, 18, 72};
    for (uint32_t b = 0; b < 2; b++) {
        const uint64_t offset[3] = {3 * b, 0, 0}, extent[3] = {3, 4, 2};
        WANT(rw_describe_block(d, b, 2, offset, extent) == RW_OK);
        WANT(rw_open(argv[1], d, &fields[b]) == RW_OK);
        const double *u = air[3 * b];
        WANT(rw_publish_strided_f64(fields[b], 5, 1.5, u, u + 1, u + 2, strides) == RW_OK);
    }
    rw_free_description(d);
    WANT(rw_close(fields[0]) == RW_OK && rw_close(fields[1]) == RW_OK);
    return 0;
}
"#;

/// Errors that a C program can make: each returns its status, and none ends the program.
#[test]
fn faults_of_the_caller_are_statuses() {
    let build = tempfile("faults");
    let source = build.0.join("faults.c");
    std::fs::write(&source, FAULTS).unwrap();
    let program = build.0.join("faults");
    compile(&source, &program, Link::Shared, &["-std=c11", "-lpthread"]);
    let ring = Folder::new("faults");
    let out = Command::new(&program).arg(&ring.0).env("LD_LIBRARY_PATH", library_folder()).env_remove("RIDGEWATCH_RING").output().unwrap();
    assert!(out.status.success(), "line {:?} failed: {}", out.status.code(), String::from_utf8_lossy(&out.stderr));
    assert!(!ring.0.exists());
}

const FAULTS: &str = r#"
#include <errno.h>
#include <math.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>
#include <ridgewatch.h>
#define WANT(x) do { if (!(x)) { fprintf(stderr, "line %d: %s (%s)\n", __LINE__, #x, rw_error()); exit(1); } } while (0)

#define WANT_WORDS(x, words) WANT((x) == RW_ARGUMENT && !strcmp(rw_error(), words))

/* Counts all allocations of this process, including the library's. */
static atomic_ulong requests;
extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t), *__libc_memalign(size_t, size_t);
void *malloc(size_t n) { atomic_fetch_add(&requests, 1); return __libc_malloc(n); }
void *calloc(size_t n, size_t m) { atomic_fetch_add(&requests, 1); return __libc_calloc(n, m); }
void *realloc(void *p, size_t n) { atomic_fetch_add(&requests, 1); return __libc_realloc(p, n); }
void *memalign(size_t a, size_t n) { atomic_fetch_add(&requests, 1); return __libc_memalign(a, n); }
void *aligned_alloc(size_t a, size_t n) { return memalign(a, n); }
int posix_memalign(void **p, size_t a, size_t n) { return (*p = memalign(a, n)) ? 0 : ENOMEM; }

static float plane[64];
static rw_field *field;

static void *publish(void *name) {
    for (int n = 0; n < 100; n++)
        if (rw_publish_f32(field, n, n, plane, plane, NULL) != RW_OK) return name;
    return NULL;
}

int main(int argc, char **argv) {
    WANT(argc == 2);
    WANT(!rw_describe(1) && !strcmp(rw_error(), "`dimensions` is 1; accepted: 2 or 3"));
    rw_description *d = rw_describe(2);
    WANT(d);
    const uint64_t ones[2] = {1, 1};
    WANT_WORDS(rw_describe_uniform(NULL, 0, 0, 1, 8, 0), "`description` is null; accepted: a result of rw_describe");
    WANT_WORDS(rw_describe_uniform(d, 2, 0, 1, 8, 0), "`axis` is 2; accepted: 0 to 1, in 2 dimensions");
    WANT_WORDS(rw_describe_rectilinear(d, 0, NULL, 8, 0), "`coordinates` is null; accepted: the address of 8 numbers");
    WANT_WORDS(rw_describe_rectilinear(d, 0, &(double){0}, 1 << 21, 0), "`nodes` is 2097152; accepted: 2 to 1048576");
    WANT_WORDS(rw_describe_time_unit(d, NULL), "`unit` is null; accepted: a text");
    WANT_WORDS(rw_describe_time_unit(d, "h\xff"), "`unit` is \"h\\xff\"; accepted: UTF-8");
    static char long_text[5000];
    memset(long_text, '/', sizeof long_text - 1);
    WANT_WORDS(rw_describe_time_unit(d, long_text), "`unit` is 4999 bytes long; accepted: at most 64 bytes");
    WANT(rw_describe_start(NULL, 1) == RW_ARGUMENT && rw_describe_start(d, UINT64_MAX) == RW_OK);
    WANT_WORDS(rw_describe_block(d, 0, 1, NULL, ones), "`offset` is null; accepted: the address of 2 numbers");
    WANT_WORDS(rw_describe_block(d, 0, 1, ones, NULL), "`extent` is null; accepted: the address of 2 numbers");
    WANT_WORDS(rw_open(argv[1], d, &field), "`description` is without axis 0; accepted: all of its 2 axes");
    WANT_WORDS(rw_open(argv[1], NULL, &field), "`description` is null; accepted: a result of rw_describe");
    WANT_WORDS(rw_open(argv[1], d, NULL), "`field` is null; accepted: the address of a pointer");
    WANT_WORDS(rw_open(long_text, d, &field), "`ring` is a path of 4999 bytes; accepted: at most 4095 bytes");
    WANT(!field);
    WANT(rw_describe_uniform(d, 0, 0, 1, 8, 0) == RW_OK && !*rw_error());
    WANT(rw_describe_uniform(d, 1, 1, 0, 8, 0) == RW_OK);
    WANT(rw_open(argv[1], d, &field) == RW_ARGUMENT && strstr(rw_error(), "ascending"));
    WANT(rw_describe_uniform(d, 1, 0, NAN, 8, 0) == RW_OK);
    WANT(rw_open(argv[1], d, &field) == RW_ARGUMENT);
    WANT(rw_describe_uniform(d, 1, 0, 1, UINT64_MAX, 0) == RW_OK);
    WANT(rw_open(argv[1], d, &field) == RW_ARGUMENT);
    WANT(rw_describe_uniform(d, 1, 0, 1, 8, 0) == RW_OK);
    WANT(rw_describe_slots(d, 1) == RW_OK && rw_open(argv[1], d, &field) == RW_ARGUMENT);
    WANT(rw_describe_slots(d, 3) == RW_OK);
    WANT(rw_open(NULL, d, &field) == RW_OFF && !field && !*rw_error());
    setenv("RIDGEWATCH_RING", argv[1], 1);
    WANT(rw_open(NULL, d, &field) == RW_OK && field);
    rw_field *second = field;
    WANT(rw_open(argv[1], d, &second) == RW_IN_USE && !second);
    WANT(rw_publish_f32(NULL, 0, 0, plane, plane, NULL) == RW_OFF);
    WANT(rw_publish_f32(field, 0, 0, plane, NULL, NULL) == RW_ARGUMENT);
    WANT(rw_publish_f32(field, 0, INFINITY, plane, plane, NULL) == RW_ARGUMENT);
    WANT(rw_publish_f32(field, 0, 0, (float *)((char *)plane + 1), plane, NULL) == RW_ARGUMENT);
    WANT(rw_publish_strided_f32(field, 0, 0, plane, plane, NULL, NULL) == RW_ARGUMENT);
    uint64_t published = 9, overwrote = 9;
    WANT(rw_statistics(field, &published, &overwrote) == RW_OK && published == 0 && overwrote == 0);
    /* Nothing is allocated after open, not even temporarily. The second ring shows that the library's allocations are counted. */
    unsigned long before = atomic_load(&requests);
    for (int n = 0; n < 1000; n++) WANT(rw_publish_f32(field, n, n, plane, plane, NULL) == RW_OK);
    WANT(rw_statistics(field, &published, NULL) == RW_OK);
    WANT(rw_publish_f32(field, 0, NAN, plane, plane, NULL) == RW_ARGUMENT && strstr(rw_error(), "NaN; accepted: a finite number"));
    WANT(rw_publish_f32(field, 0, 0, NULL, plane, NULL) == RW_ARGUMENT && strstr(rw_error(), "not null"));
    WANT(rw_publish_f32(field, 0, 0, (float *)((char *)plane + 2), plane, NULL) == RW_ARGUMENT && strstr(rw_error(), "divisible by 4"));
    WANT_WORDS(rw_publish_strided_f32(field, 0, 0, plane, plane, NULL, NULL), "`strides` is null; accepted: the address of 2 numbers");
    WANT(atomic_load(&requests) == before);
    WANT(rw_open(argv[1], d, &second) == RW_IN_USE && atomic_load(&requests) > before);
    pthread_t threads[4];
    for (int t = 0; t < 4; t++) WANT(!pthread_create(&threads[t], NULL, publish, argv));
    for (int t = 0; t < 4; t++) {
        void *failed;
        WANT(!pthread_join(threads[t], &failed) && !failed);
    }
    WANT(rw_statistics(field, &published, NULL) == RW_OK && published == 1400);
    pid_t child = fork();
    if (!child) {
        int good = rw_publish_f32(field, 0, 0, plane, plane, NULL) == RW_FORKED && rw_close(field) == RW_OK;
        _exit(good ? 0 : 1);
    }
    int status;
    WANT(waitpid(child, &status, 0) == child && status == 0);
    /* A file above the process limit: no SIGXFSZ, and nothing is left of it. */
    child = fork();
    if (!child) {
        const struct rlimit most = {10000, 10000};
        const uint64_t offset[2] = {0, 0}, extent[2] = {8, 4};
        const int limited = !setrlimit(RLIMIT_FSIZE, &most) && rw_describe_block(d, 1, 2, offset, extent) == RW_OK;
        rw_field *long_one;
        const int good = rw_open(argv[1], d, &long_one) == RW_NO_SPACE && strstr(rw_error(), "(10000 bytes: ulimit -f, RLIMIT_FSIZE)") && !long_one;
        _exit(limited && good ? 0 : 1);
    }
    WANT(waitpid(child, &status, 0) == child && status == 0);
    WANT(rw_publish_f32(field, 1, 1, plane, plane, NULL) == RW_OK);
    /* A ring whose lock was removed by hand still belongs to its solver; one that was removed itself is told, without an allocation. */
    char path[5000];
    snprintf(path, sizeof path, "%s/block-00000.lock", argv[1]);
    WANT(!unlink(path) && rw_open(argv[1], d, &second) == RW_IN_USE && !second);
    WANT(rw_publish_f32(field, 2, 2, plane, plane, NULL) == RW_OK);
    snprintf(path, sizeof path, "%s/block-00000.ring", argv[1]);
    WANT(!unlink(path));
    before = atomic_load(&requests);
    WANT(rw_publish_f32(field, 3, 3, plane, plane, NULL) == RW_REMOVED && strstr(rw_error(), "was removed"));
    WANT(rw_statistics(field, &published, NULL) == RW_OK && published == 1402 && atomic_load(&requests) == before);
    /* Closing the old handle takes nothing from a new one. */
    WANT(rw_open(argv[1], d, &second) == RW_OK && rw_close(field) == RW_OK);
    WANT(rw_publish_f32(second, 4, 4, plane, plane, NULL) == RW_OK && rw_close(second) == RW_OK);
    WANT(rw_close(NULL) == RW_OFF);
    rw_free_description(d);
    rw_free_description(NULL);
    return 0;
}
"#;

/// With any amount of memory, each call returns a status. In child processes, so that a limit holds for one of them and a signal is noticed.
#[test]
fn where_memory_is_out_calls_fail_and_nothing_is_aborted() {
    let build = tempfile("memory");
    let source = build.0.join("memory.c");
    std::fs::write(&source, OUT_OF_MEMORY).unwrap();
    let program = build.0.join("memory");
    compile(&source, &program, Link::Shared, &[]);
    let ring = Folder::new("memory");
    let out = Command::new(&program).arg(&ring.0).env("LD_LIBRARY_PATH", library_folder()).env_remove("RIDGEWATCH_RING").output().unwrap();
    let (said, told) = (String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr));
    assert!(out.status.success(), "{said}{told}");
    println!("{said}");
    assert!(!ring.0.exists(), "nothing is left behind");
}

const OUT_OF_MEMORY: &str = r#"
#define _DEFAULT_SOURCE
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>
#include <ridgewatch.h>
enum { NODES = 1 << 18, PIECES = 1 << 14, DESCRIBED = 10, AXIS = 11, OPENED = 12, CLOSED = 13, ODD = 20 };
static double coordinates[NODES];
static void *pieces[PIECES];

static void limit_to(long room) {
    long pages = 0;
    FILE *about = fopen("/proc/self/statm", "r");
    if (!about || fscanf(about, "%ld", &pages) != 1) _exit(ODD);
    fclose(about);
    const rlim_t most = pages * 4096 + room;
    const struct rlimit limit = {most, most};
    if (setrlimit(RLIMIT_AS, &limit)) _exit(ODD);
}

/* Allocates all of the memory, in large and small pieces. */
static void fill(void) {
    for (int i = 0; i < PIECES; i++) pieces[i] = malloc(8000);
    for (int crumb = 4096; crumb >= 16; crumb /= 2) while (malloc(crumb)) {}
}

/* Publishes an invalid step without any memory left. */
static int refused(const char *ring) {
    static float plane[9];
    rw_description *d = rw_describe(2);
    rw_field *field;
    if (!d || rw_describe_uniform(d, 0, 0, 1, 2, 0) || rw_describe_uniform(d, 1, 0, 1, 4, 0) || rw_open(ring, d, &field)) return ODD;
    limit_to(32 << 20);
    fill();
    if (malloc(16)) return ODD + 1;
    if (rw_publish_f32(field, 0, NAN, plane, plane, NULL) != RW_ARGUMENT || !strstr(rw_error(), "finite")) return ODD + 2;
    if (rw_publish_f32(field, 0, 0, (float *)((char *)plane + 1), plane, NULL) != RW_ARGUMENT || !strstr(rw_error(), "divisible")) return ODD + 3;
    if (rw_publish_f32(field, 0, 0, plane, plane, NULL) != RW_OK) return ODD + 4;
    for (int i = 0; i < PIECES; i++) free(pieces[i]);
    return rw_close(field) == RW_OK ? 0 : ODD + 5;
}

/* Opens a ring without room in a folder with the locks of many ended producers, all of which are examined. */
static int huge(const char *ring, int others) {
    char path[300];
    snprintf(path, sizeof path, "%s", ring);
    if (mkdir(path, 0700)) return ODD;
    for (int block = 1; block <= others; block++) {
        snprintf(path, sizeof path, "%s/block-%05d.lock", ring, block);
        const int file = open(path, O_CREAT | O_WRONLY, 0600);
        if (file < 0 || close(file)) return ODD + 1;
    }
    rw_description *d = rw_describe(3);
    rw_field *field;
    for (int axis = 0; axis < 3; axis++) if (!d || rw_describe_uniform(d, axis, 0, 1, 1 << 13, 0)) return ODD + 2;
    /* Then some pieces are freed. */
    limit_to(32 << 20);
    fill();
    for (int i = 0; i < 160; i++) free(pieces[i]);
    const int status = rw_open(ring, d, &field);
    for (int block = 1; block <= others; block++) {
        snprintf(path, sizeof path, "%s/block-%05d.lock", ring, block);
        remove(path);
    }
    snprintf(path, sizeof path, "%s/followers.lock", ring);
    remove(path);
    rmdir(ring);
    return status == RW_NO_SPACE && !field ? 0 : ODD + 3 + status;
}

/* A description of 4 MiB, a block of 8 nodes. */
static int attempt(const char *ring) {
    rw_description *d = rw_describe(3);
    if (!d) return strstr(rw_error(), "no memory") ? DESCRIBED : ODD;
    const uint64_t offset[3] = {0, 0, 0}, extent[3] = {2, 2, 2};
    if (rw_describe_uniform(d, 0, 0, 1, NODES, 0) || rw_describe_rectilinear(d, 1, coordinates, NODES, 0) || rw_describe_uniform(d, 2, 0, 1, 2, 0)
        || rw_describe_block(d, 0, 2, offset, extent)) return strstr(rw_error(), "no memory") ? AXIS : ODD;
    rw_field *field;
    const int status = rw_open(ring, d, &field);
    if (status) return status == RW_SYSTEM && !field && *rw_error() ? OPENED : ODD + status;
    const float plane[8] = {0};
    if (rw_publish_f32(field, 0, 0, plane, plane, plane)) return ODD;
    const int closed = rw_close(field);
    return closed == RW_OK ? 0 : closed == RW_SYSTEM ? CLOSED : ODD;
}

int main(int argc, char **argv) {
    if (argc != 2) return 1;
    for (long i = 0; i < NODES; i++) coordinates[i] = i;
    int ends[64] = {0}, end;
    const pid_t first = fork();
    if (!first) _exit(refused(argv[1]));
    if (first < 0 || waitpid(first, &end, 0) != first || end) {
        fprintf(stderr, "a step that was refused without memory: status %x\n", end);
        return 5;
    }
    const pid_t second = fork();
    if (!second) _exit(huge(argv[1], 40000));
    if (second < 0 || waitpid(second, &end, 0) != second || end) {
        fprintf(stderr, "no room among 40000 blocks, little memory: status %x\n", end);
        return 6;
    }
    for (int filled = 0; filled < 2; filled++)
        for (long room = 0; room < 24L << 20; room += filled ? (room < 1 << 20 ? 8 << 10 : 1 << 20) : 128 << 10) {
            const pid_t child = fork();
            if (!child) {
                limit_to(filled ? 32 << 20 : room);
                if (filled) {
                    /* Frees `room` bytes. */
                    fill();
                    for (long i = 0; i < room / 8000; i++) free(pieces[i]);
                }
                _exit(attempt(argv[1]));
            }
            int status;
            if (child < 0 || waitpid(child, &status, 0) != child) return 2;
            if (!WIFEXITED(status) || WEXITSTATUS(status) >= ODD) {
                fprintf(stderr, "with %ld bytes (filled: %d): status %x\n", room, filled, status);
                return 3;
            }
            ends[WEXITSTATUS(status)]++;
        }
    printf("no description %d, no axis %d, not opened %d, not closed %d, published %d\n", ends[DESCRIBED], ends[AXIS], ends[OPENED], ends[CLOSED], ends[0]);
    return ends[DESCRIBED] && ends[AXIS] && ends[OPENED] && ends[0] ? 0 : 4;
}
"#;

fn tempfile(name: &str) -> Folder {
    let folder = Folder(std::env::temp_dir().join(format!("rw-c-{name}-{}", std::process::id())));
    std::fs::create_dir_all(&folder.0).unwrap();
    folder
}
