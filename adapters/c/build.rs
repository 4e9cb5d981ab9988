//! Gives the shared library its SONAME, so that a solver asks for the version of the interface that it was linked with.

/// Text before the version in the library's source.
const VERSION: &str = "pub const RW_VERSION: u32 = ";

#[allow(clippy::print_stdout)] // Speaks to cargo.
fn main() {
    let source = include_str!("src/lib.rs");
    let version: String = source.split(VERSION).nth(1).into_iter().flat_map(str::chars).take_while(char::is_ascii_digit).collect();
    assert!(!version.is_empty(), "src/lib.rs has no `{VERSION}`");
    println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libridgewatch_adapter.so.{version}");
    println!("cargo:rerun-if-changed=src/lib.rs");
}
