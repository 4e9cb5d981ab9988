//! The library as C sees it: the header against the exported functions, a C solver compiled and run, and what is read behind it.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use ridgewatch_wire::{Following, Limits, Read, RingReader};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The folder where cargo puts the shared library beside the tests.
fn library_folder() -> PathBuf {
    let folder = std::env::current_exe().unwrap().parent().unwrap().to_owned();
    assert!(folder.join("libridgewatch_adapter.so").exists(), "no library in {}", folder.display());
    folder
}

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

/// Compiles a C program against the header and the library.
fn compile(source: &Path, to: &Path, extra: &[&str]) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut cc = Command::new("cc");
    cc.args(["-std=c99", "-D_POSIX_C_SOURCE=200809L", "-O2", "-Wall", "-Wextra", "-Werror", "-I"]).arg(root.join("include"));
    cc.arg(source).arg("-o").arg(to).arg("-L").arg(library_folder()).args(["-lridgewatch_adapter", "-lm"]).args(extra);
    let out = cc.output().expect("a C compiler");
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
}

/// A function as C declares it: its return type and those of its parameters, without blanks at stars.
type Signature = (String, Vec<String>);

/// Splits `const float *u` into its type and its name.
fn type_and_name(declared: &str) -> (String, String) {
    let declared = declared.split_whitespace().collect::<Vec<_>>().join(" ");
    let begin = declared.rfind(|c: char| !c.is_ascii_alphanumeric() && c != '_').map_or(0, |at| at + 1);
    (declared[..begin].trim_end().replace(" *", "*"), declared[begin..].to_owned())
}

/// Functions that a header without comments declares.
fn declared(header: &str) -> BTreeMap<String, Signature> {
    let lines: Vec<_> = header.lines().filter(|line| !line.starts_with('#')).collect();
    let mut found = BTreeMap::new();
    for statement in lines.join("\n").split(';') {
        let Some((head, parameters)) = statement.split_once('(') else { continue };
        let (returned, name) = type_and_name(head.rsplit_once('{').map_or(head, |(_, head)| head));
        let parameters = parameters.trim_end().strip_suffix(')').unwrap();
        let parameters = parameters.split(',').filter(|p| p.trim() != "void").map(|p| type_and_name(p).0).collect();
        assert!(found.insert(name.clone(), (returned, parameters)).is_none(), "{name} twice");
    }
    found
}

/// A type of the library as C writes it.
fn in_c(rust: &str) -> String {
    if let Some(pointee) = rust.strip_prefix("*const ") {
        assert!(!pointee.starts_with('*'), "{rust}");
        return format!("const {}*", in_c(pointee));
    }
    if let Some(pointee) = rust.strip_prefix("*mut ") {
        return format!("{}*", in_c(pointee));
    }
    let c = match rust {
        "()" => "void",
        "u32" => "uint32_t",
        "u64" => "uint64_t",
        "i64" => "int64_t",
        "f32" => "float",
        "f64" => "double",
        "c_char" => "char",
        "Status" => "rw_status",
        "RwDescription" => "rw_description",
        "RwField" => "rw_field",
        other => panic!("{other}: a type without a counterpart in C"),
    };
    c.to_owned()
}

/// Functions that the library exports, as C would declare them.
fn exported(library: &str) -> BTreeMap<String, Signature> {
    let function = |text: &str| {
        let (name, rest) = text.split_once('(').unwrap();
        let (parameters, rest) = rest.split_once(')').unwrap();
        let returned = rest.split_once('{').unwrap().0.trim().strip_prefix("->").unwrap_or("()");
        let types = parameters.split(',').filter_map(|p| Some(in_c(p.split_once(':')?.1.trim()))).collect();
        (name.to_owned(), (in_c(returned.trim()), types))
    };
    library.split("extern \"C\" fn ").skip(1).map(function).collect()
}

#[test]
fn the_header_and_the_library_agree() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let header = std::fs::read_to_string(root.join("include/ridgewatch.h")).unwrap();
    let library = std::fs::read_to_string(root.join("src/lib.rs")).unwrap();
    // Without comments: examples stand there.
    let mut plain = String::new();
    let mut rest = header.as_str();
    while let Some((before, after)) = rest.split_once("/*") {
        plain.push_str(before);
        rest = after.split_once("*/").unwrap().1;
    }
    plain.push_str(rest);
    let declared = declared(&plain);
    assert_eq!(declared, exported(&library));
    assert!(declared.len() >= 17, "{declared:?}");
    // Status numbers.
    let number = |text: &str, name: &str| -> Option<u32> {
        let rest = text.split_once(&format!("{name} = "))?.1;
        rest.chars().take_while(char::is_ascii_digit).collect::<String>().parse().ok()
    };
    for (c, rust) in [
        ("RW_OK", "    Ok"),
        ("RW_OFF", "    Off"),
        ("RW_ARGUMENT", "    Argument"),
        ("RW_IN_USE", "    InUse"),
        ("RW_NO_SPACE", "    NoSpace"),
        ("RW_FOREIGN", "    Foreign"),
        ("RW_SYSTEM", "    System"),
        ("RW_FORKED", "    Forked"),
        ("RW_INTERNAL", "    Internal"),
    ] {
        assert!(number(&plain, c).is_some() && number(&plain, c) == number(&library, rust), "{c}");
    }
    assert_eq!(plain.split_once("#define RW_VERSION ").unwrap().1.trim_start().split('\n').next(), Some("2"));
}

#[test]
fn a_c_solver_is_followed_and_needs_nobody() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let build = tempfile("solver");
    let program = build.0.join("solver");
    compile(&root.join("examples/solver.c"), &program, &[]);
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
    assert!(!ring.0.exists(), "nothing stays behind");
    // Refused, and the solver goes on.
    let (good, said, told) = run(Some(Path::new("/proc/nowhere")), &["3", "8", "0"]);
    assert!(good && said.starts_with("0 steps published") && told.contains("not published"), "{said}{told}");
}

/// Faults that C can make, in one program: each has its status, none ends it.
#[test]
fn faults_of_the_caller_are_statuses() {
    let build = tempfile("faults");
    let source = build.0.join("faults.c");
    std::fs::write(&source, FAULTS).unwrap();
    let program = build.0.join("faults");
    compile(&source, &program, &["-std=c11", "-lpthread"]);
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
#include <sys/wait.h>
#include <unistd.h>
#include <ridgewatch.h>
#define WANT(x) do { if (!(x)) { fprintf(stderr, "line %d: %s (%s)\n", __LINE__, #x, rw_error()); exit(1); } } while (0)

/* Every request for memory of this process, the library's with them. */
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
    WANT(!rw_describe(1) && strstr(rw_error(), "2 or 3"));
    rw_description *d = rw_describe(2);
    WANT(d);
    WANT(rw_describe_uniform(NULL, 0, 0, 1, 8, 0) == RW_ARGUMENT);
    WANT(rw_describe_uniform(d, 2, 0, 1, 8, 0) == RW_ARGUMENT);
    WANT(rw_describe_rectilinear(d, 0, NULL, 8, 0) == RW_ARGUMENT);
    WANT(rw_describe_time_unit(d, NULL) == RW_ARGUMENT);
    WANT(rw_describe_start(NULL, 1) == RW_ARGUMENT && rw_describe_start(d, UINT64_MAX) == RW_OK);
    WANT(rw_describe_block(d, 0, 1, NULL, NULL) == RW_ARGUMENT);
    WANT(rw_open(argv[1], d, &field) == RW_ARGUMENT && strstr(rw_error(), "axis is missing") && !field);
    WANT(rw_open(argv[1], NULL, &field) == RW_ARGUMENT);
    WANT(rw_open(argv[1], d, NULL) == RW_ARGUMENT);
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
    /* No memory is taken after open, not even for a moment. That the library's requests are counted shows the second ring. */
    unsigned long before = atomic_load(&requests);
    for (int n = 0; n < 1000; n++) WANT(rw_publish_f32(field, n, n, plane, plane, NULL) == RW_OK);
    WANT(rw_statistics(field, &published, NULL) == RW_OK);
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
    WANT(rw_publish_f32(field, 1, 1, plane, plane, NULL) == RW_OK);
    WANT(rw_close(field) == RW_OK);
    WANT(rw_close(NULL) == RW_OFF);
    rw_free_description(d);
    rw_free_description(NULL);
    return 0;
}
"#;

fn tempfile(name: &str) -> Folder {
    let folder = Folder(std::env::temp_dir().join(format!("rw-c-{name}-{}", std::process::id())));
    std::fs::create_dir_all(&folder.0).unwrap();
    folder
}
