//! Pages of the documentation, compared with the program that they describe.
#![allow(clippy::unwrap_used)] // Tests: a panic is the report.

mod maps;
#[path = "../network_support/mod.rs"]
mod network_support;
mod protocol;
mod scene;
mod security;

/// Text of a page in `docs`.
fn page(name: &str) -> String {
    std::fs::read_to_string(std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs").join(name)).unwrap()
}
